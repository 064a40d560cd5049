"""`swarmtwin promote`: the gate that a registered model passes to become the champion, and the way back."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from rich.console import Console

from swarmtwin import gate, registry
from swarmtwin.commands.measurement import load_simulation
from swarmtwin.commands.policy_promotion import PolicyGate, judge_policies
from swarmtwin.commands.sources import read_vehicles
from swarmtwin.dynamics.evaluation import predict
from swarmtwin.errors import UserError
from swarmtwin.geometry import orientation_error_rad, position_error_mm
from swarmtwin.policies.store import load_policy
from swarmtwin.recordings.recording import Recording
from swarmtwin.robot import Robot, StrictModel
from swarmtwin.tracking import Experiment, tracked_run
from swarmtwin.transitions import Transitions, from_recording

What = Literal["dynamics", "policy"]


class Options(StrictModel):
    """Options of `swarmtwin promote`; their defaults stand in conf/promote.yaml."""

    robot: Robot
    what: What
    candidate: Annotated[str, Field(coerce_numbers_to_str=True)]
    recording: Path
    policy_gate: PolicyGate
    rollback: bool


@dataclass(frozen=True)
class Kind:
    """A kind of registered model.

    Attributes:
        noun: what people call it.
        experiment: of MLflow, that keeps those registered on the way.
        subfolder: under which its run keeps it.
        describe: returns the tags and the seed of the model in a folder; refuses what is no such model.
    """

    noun: str
    experiment: Experiment
    subfolder: str
    describe: Callable[[Path, Robot], tuple[dict[str, str], int]]


def run(options: Options) -> None:
    """Promote the candidate or refuse it, saying why; or roll back.

    Raises:
        UserError: the gate refuses, there is no such candidate, or nothing to measure it on.
    """
    name = f"{options.robot.name}-{options.what}"
    if options.rollback:
        deposed, restored = registry.roll_back(name)
        Console().print(f"{name}: version {restored} is champion again, version {deposed} no longer", highlight=False)
        return
    candidate = _find(name, options.candidate, options.robot, KINDS[options.what])
    incumbent = registry.champion(name)
    if incumbent and incumbent.number == candidate.number:
        Console().print(f"{candidate} is the champion already", highlight=False)
        return
    passed, reason = GATES[options.what](candidate, incumbent, options)
    if not passed:
        stays = f"; {incumbent} stays champion" if incumbent else ""
        raise UserError(f"{candidate} is not promoted: {reason}{stays}")
    registry.crown(candidate, reason)
    Console().print(f"{candidate} is champion: {reason}", highlight=False)


def _find(name: str, candidate: str, robot: Robot, kind: Kind) -> registry.Version:
    """Return the version meant; a folder that is no version yet is registered first."""
    if candidate == registry.CHALLENGER:
        return registry.find_version(f"models:/{name}@{candidate}")
    if candidate.isdigit():
        return registry.find_version(f"models:/{name}/{candidate}")
    if candidate.startswith("models:"):
        version = registry.find_version(candidate)
        if version.name != name:
            raise UserError(f"{candidate} is no {kind.noun} of robot {robot.name!r}: add robot=... or what=...")
        return version
    folder = registry.model_folder(candidate)
    tags, seed = kind.describe(folder, robot)
    if known := registry.version_of(name, folder):
        return known
    with tracked_run(kind.experiment, f"register {folder}", {"candidate": candidate}, [folder], seed) as tracked:
        kept = tracked.folder(folder, kind.subfolder)
    return registry.register(name, folder, kept, tracked.run_id, tags)


def _describe_dynamics(folder: Path, robot: Robot) -> tuple[dict[str, str], int]:
    dynamics, provenance = load_simulation(folder, robot)
    return provenance.tags(dynamics.config.name), provenance.seed


def _describe_policy(folder: Path, robot: Robot) -> tuple[dict[str, str], int]:
    policy = load_policy(folder, robot)
    return policy.provenance.tags(policy.task.name), policy.provenance.seed


def _judge_dynamics(
    candidate: registry.Version, incumbent: registry.Version | None, options: Options
) -> tuple[bool, str]:
    recording = read_vehicles(options.recording, options.robot, None)
    verdict = _compare_dynamics(candidate, incumbent, options.robot, recording)
    rival = f"than {incumbent}" if incumbent else "than predicting the mean displacement (there is no champion yet)"
    return verdict.passed, f"{verdict} {rival} on {options.recording}"


def _judge_policy(
    candidate: registry.Version, incumbent: registry.Version | None, options: Options
) -> tuple[bool, str]:
    verdict = judge_policies(candidate, incumbent, options.robot, options.policy_gate)
    return verdict.passed, str(verdict)


def _compare_dynamics(
    candidate: registry.Version, incumbent: registry.Version | None, robot: Robot, recording: Recording
) -> gate.Verdict:
    """Compare both on what neither has seen; without a champion, compare with always predicting the mean."""
    simulation, provenance = load_simulation(candidate.folder(), robot)
    unseen = provenance.unseen_part(recording)
    rival, rival_provenance = load_simulation(incumbent.folder(), robot) if incumbent else (None, provenance)
    common = _common(unseen, rival_provenance.unseen_part(recording))
    if not common.tracks:
        raise UserError(
            f"{candidate} and {incumbent} were trained on recording {provenance.recording!r}, and no run of it is "
            "unseen by both: add recording=... with another one"
        )
    transitions, _ = from_recording(common)
    usual = np.broadcast_to(transitions.displacement.mean(axis=0), (len(transitions), 3))
    rival_errors = _errors(predict(rival, transitions) if rival else usual, transitions)
    return gate.judge(_errors(predict(simulation, transitions), transitions), rival_errors, transitions.run)


def _common(first: Recording, second: Recording) -> Recording:
    kept = {(track.run, track.vehicle) for track in second.tracks}
    return first.where(lambda track: (track.run, track.vehicle) in kept)


def _errors(predicted: np.ndarray, transitions: Transitions) -> gate.Errors:
    return gate.Errors(
        position_error_mm(predicted, transitions.displacement),
        np.degrees(orientation_error_rad(predicted, transitions.displacement)),
    )


KINDS = {
    "dynamics": Kind("dynamics model", "dynamics", "model", _describe_dynamics),
    "policy": Kind("policy", "policy", "policy", _describe_policy),
}
GATES = {"dynamics": _judge_dynamics, "policy": _judge_policy}
