"""Which simulation a measured recording is compared with: learned from a recording, or trained before."""

from pathlib import Path

import numpy as np

from swarmtwin.diagnosis.reference import Reference, enough_measured
from swarmtwin.diagnosis.settings import DiagnosisSettings
from swarmtwin.dynamics.model_folder import load_evidence
from swarmtwin.dynamics.predictor import NetworkDynamics
from swarmtwin.dynamics.provenance import Provenance
from swarmtwin.errors import UserError
from swarmtwin.learning.device import Device, torch_device
from swarmtwin.recordings.recording import Recording
from swarmtwin.robot import Robot, SituationPart
from swarmtwin.simulation.evaluation import load_simulation
from swarmtwin.transitions import from_recording


def reference_for(
    measured: Recording,
    robot: Robot,
    *,
    reference: Recording | None,
    name: str,
    folder: Path | None,
    situation: tuple[SituationPart, ...] | None,
    settings: DiagnosisSettings,
    device: Device,
    seed: int,
) -> tuple[Reference, tuple[str, ...]]:
    """Return what to compare a measured recording with, and the digests of the tracks that it was learned from.

    Args:
        measured: the recording to diagnose.
        robot: whose recording it is.
        reference: a recording in which nothing is wrong; where no simulation is given, one is learned from it. Where
            one is given, its runs count that the simulation was not fitted to.
        name: what messages call it.
        folder: a trained simulation; without a reference it is compared with its own evidence.
        situation: what a simulation learned here looks at; None: what the robot's file says, and the previous command.
        settings: of the diagnosis.
        device: where a trained simulation predicts.
        seed: of what is learned here.

    Raises:
        UserError: the simulation is an extended one, or has no evidence, or measured runs were learned from, or nothing
            can be concluded from what was measured.
    """
    enough_measured(measured, settings.reference)
    if folder is None:
        assert reference is not None
        learned = tuple(track.digest() for track in reference.tracks)
        _refuse_overlap(learned, measured, name)
        transitions, _ = from_recording(reference)
        return Reference.learn(transitions, seed, situation, settings), learned
    if situation is not None:
        raise UserError("situation=... is for a simulation learned from reference=DIR: a trained one has its own")
    simulation, provenance = load_simulation(folder, robot)
    dynamics = simulation.to(torch_device(device)).dynamics
    if simulation.is_extended or not isinstance(dynamics, NetworkDynamics):
        raise UserError(
            f"{folder} is an extended simulation, as a diagnosis leaves it: diagnose the one that it extends, or "
            "learn from a recording in which nothing is wrong, reference=DIR without simulation"
        )
    _refuse_overlap(provenance.learned, measured, f"the recording that {folder} was trained on")
    if reference is None:
        evidence = load_evidence(folder)
        if evidence is None:
            raise UserError(
                f"{folder} holds no evidence.parquet, real transitions that it was not fitted to: train it anew on "
                "real data, or add reference=DIR, a recording in which nothing is wrong"
            )
        return Reference.of_simulation(dynamics, evidence, seed, settings), provenance.learned
    _refuse_overlap(tuple(track.digest() for track in reference.tracks), measured, name)
    transitions, _ = from_recording(_not_fitted(reference, folder, provenance))
    return Reference.of_simulation(dynamics, transitions, seed, settings), provenance.learned


def _not_fitted(reference: Recording, folder: Path, provenance: Provenance) -> Recording:
    """Return the part of a recording that a simulation has not seen, with the runs that it was only chosen by.

    Raises:
        UserError: nothing is left.
    """
    learned = set(provenance.learned)
    if not any(track.digest() in learned for track in reference.tracks):
        return reference
    evidence = load_evidence(folder)
    chosen_by = {evidence.runs[run] for run in np.unique(evidence.run)} if evidence is not None else set()
    part = reference.where(lambda track: track.run in chosen_by or track.digest() not in learned)
    return part if part.tracks else provenance.unseen_part(reference)


def _refuse_overlap(learned: tuple[str, ...], measured: Recording, what: str) -> None:
    known = set(learned)
    if shared := sorted({track.run for track in measured.tracks if track.digest() in known}):
        raise UserError(
            f"{len(shared)} measured runs, such as {shared[0]}, are also in {what}: what a simulation was learned from "
            "cannot show what it gets wrong; measure other runs"
        )
