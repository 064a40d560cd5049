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
from swarmtwin.recordings.recognition import known_by, recognised, row_hashes
from swarmtwin.recordings.recording import Recording
from swarmtwin.robot import Robot, SituationPart
from swarmtwin.simulation.evaluation import load_simulation
from swarmtwin.transitions import Transitions, from_recording


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
    """Return what to compare a measured recording with, and the marks of the tracks that it was learned from.

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
        learned = known_by(reference.tracks)
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
    _refuse_overlap(known_by(reference.tracks), measured, name)
    transitions, _ = from_recording(_not_fitted(reference, folder, provenance))
    return Reference.of_simulation(dynamics, transitions, seed, settings), provenance.learned


def _not_fitted(reference: Recording, folder: Path, provenance: Provenance) -> Recording:
    """Return the part of a recording that a simulation has not seen, with the runs that it was only chosen by.

    Raises:
        UserError: nothing is left.
    """
    seen = recognised(reference.tracks, set(provenance.learned))
    evidence = load_evidence(folder) if any(seen) else None
    if evidence is not None:
        chosen_by = _made_of(reference, evidence)
        seen = [
            one and (track.run, track.vehicle) not in chosen_by
            for one, track in zip(seen, reference.tracks, strict=True)
        ]
    part = reference.without(seen)
    return part if part.tracks else provenance.unseen_part(reference)


def _made_of(recording: Recording, evidence: Transitions, least: float = 0.9) -> set[tuple[str, str]]:
    """Return the runs and vehicles of tracks of which `least` of the transitions, or more, are among some evidence.

    Names of runs do not tell that: copies are numbered anew, and runs of several recordings are called by these.
    Transitions that lead from one block into the next are in no recording that is cut there.
    """
    transitions, _ = from_recording(recording)
    is_known = np.isin(_starts(transitions), _starts(evidence))
    track, number = np.unique(np.column_stack([transitions.run, transitions.vehicle]), axis=0, return_inverse=True)
    share = np.bincount(number.ravel(), is_known) / np.bincount(number.ravel())
    return {(transitions.runs[run], transitions.vehicles[vehicle]) for run, vehicle in track[share >= least].tolist()}


def _starts(transitions: Transitions) -> np.ndarray:
    """Return (N,) hashes of when, by which command and where transitions start."""
    return row_hashes(transitions.time_s, transitions.command, transitions.pose)


def _refuse_overlap(learned: tuple[str, ...], measured: Recording, what: str) -> None:
    is_known = recognised(measured.tracks, set(learned))
    if shared := sorted({track.run for track, known in zip(measured.tracks, is_known, strict=True) if known}):
        raise UserError(
            f"{len(shared)} measured runs, such as {shared[0]}, are also in {what}: what a simulation was learned from "
            "cannot show what it gets wrong; measure other runs"
        )
