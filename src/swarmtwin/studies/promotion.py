"""Promotion: a registered model becomes champion if it is measurably better, or for policies safe enough, than before.

Dynamics models are compared by their one-step errors on runs that neither has seen; policies by what they do on
stand-ins from the same starts. The statistics of both gates stand in `tracking/gate.py`.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from swarmtwin.dynamics.evaluation import predict
from swarmtwin.dynamics.model_folder import model_name
from swarmtwin.errors import RefusedError, UserError
from swarmtwin.geometry import orientation_error_rad, position_error_mm
from swarmtwin.policies.policy_folder import StoredPolicy, load_policy
from swarmtwin.policies.rollout_comparison import draw_scenarios
from swarmtwin.recordings.recording import Recording
from swarmtwin.robot import Robot, Seed, StrictModel
from swarmtwin.simulation.evaluation import load_simulation
from swarmtwin.studies.rollout_runner import on_stand_ins, other_vehicles
from swarmtwin.studies.tracked_inputs import model_input
from swarmtwin.tracking import gate, registry
from swarmtwin.tracking.models import ModelKind
from swarmtwin.tracking.runs import tracked_run
from swarmtwin.transitions import Transitions, from_recording
from swarmtwin.transitions.inputs import Vehicles, read_vehicles
from swarmtwin.world.rollout import NEVER

Share = Annotated[float, Field(ge=0, le=1)]


class PolicyGate(StrictModel):
    """What a policy must show; the values stand in conf/promote.yaml.

    Attributes:
        vehicles: ids of the stand-ins, as many as the task has vehicles; None: those after the one recorded.
        rollouts: how many starts.
        seed: of the starts.
        least_success: share of the roll-outs that must succeed.
        most_collisions: largest share in which vehicles may collide.
        margin: how much less success than the champion's can be put up with, as a share of the roll-outs.
        other_task: whether the champion may be one for another task.
    """

    vehicles: Vehicles
    rollouts: Annotated[int, Field(ge=1)]
    seed: Seed
    least_success: Share
    most_collisions: Share
    margin: Share
    other_task: bool


def promote(kind: ModelKind, candidate: str, robot: Robot, recording: Path, policy_gate: PolicyGate) -> str:
    """Make a model the champion if it passes its gate; return what was found, as a sentence.

    Args:
        kind: a dynamics model or a policy.
        candidate: `challenger`, a version's number, `models:/NAME/VERSION`, or a model folder, which is registered.
        robot: whose model it is.
        recording: what dynamics models are measured on.
        policy_gate: what a policy must show.

    Raises:
        RefusedError: the gate refuses it.
        UserError: there is no such candidate, or nothing to measure it on.
    """
    version = _find_candidate(kind, candidate, robot)
    champion = registry.champion(version.name)
    if champion and champion.number == version.number:
        return f"{version} is the champion already"
    if kind == "dynamics":
        verdict: gate.DynamicsVerdict | gate.PolicyVerdict = judge_dynamics(version, champion, robot, recording)
        rival = f"than {champion}" if champion else "than predicting the mean displacement (there is no champion yet)"
        reason = f"{verdict} {rival} on {recording}"
    else:
        verdict = judge_policies(version, champion, robot, policy_gate)
        reason = str(verdict)
    if not verdict.passed:
        stays = f"; {champion} stays champion" if champion else ""
        raise RefusedError(f"{version} is not promoted: {reason}{stays}")
    registry.promote(version, reason, champion)
    return f"{version} is champion: {reason}"


def _find_candidate(kind: ModelKind, candidate: str, robot: Robot) -> registry.Version:
    """Return the version meant; a folder that is no version yet is registered first."""
    name = f"{robot.name}-{kind}"
    if candidate == registry.CHALLENGER:
        return registry.find_version(f"models:/{name}@{candidate}")
    if candidate.isdigit():
        return registry.find_version(f"models:/{name}/{candidate}")
    if candidate.startswith("models:"):
        version = registry.find_version(candidate)
        if version.name != name:
            noun = {"dynamics": "dynamics model", "policy": "policy"}[kind]
            raise UserError(f"{candidate} is no {noun} of robot {robot.name!r}: add robot=... or what=...")
        return version
    folder = registry.model_folder(candidate)
    if kind == "dynamics":
        _, provenance = load_simulation(folder, robot)
        tags, seed = provenance.tags(model_name(folder)), provenance.seed
    else:
        policy = load_policy(folder, robot)
        tags, seed = policy.provenance.tags(policy.task.name), policy.provenance.seed
    if known := registry.version_of(name, folder):
        return known
    given = [model_input(folder, kind)]
    with tracked_run(kind, f"register {folder}", {"candidate": candidate}, given, seed) as tracked:
        source = tracked.model(folder, kind)
    return registry.register(name, folder, source, tracked.run_id, tags)


def judge_dynamics(
    candidate: registry.Version, champion: registry.Version | None, robot: Robot, recording: Path
) -> gate.DynamicsVerdict:
    """Compare both on what neither has seen; without a champion, compare with always predicting the mean.

    Raises:
        UserError: the recording is at fault, or no run of it is unseen by both.
    """
    measured = read_vehicles(recording, robot, None)
    simulation, provenance = load_simulation(candidate.folder(), robot)
    unseen = provenance.unseen_part(measured)
    if champion:
        rival, rival_provenance = load_simulation(champion.folder(), robot)
        unseen = _common(unseen, rival_provenance.unseen_part(measured))
        if not unseen.tracks:
            raise UserError(
                f"{candidate} and {champion} were trained on recording {provenance.recording!r}, and no run of it is "
                "unseen by both: add recording=... with another one"
            )
    transitions, _ = from_recording(unseen)
    if champion:
        usual = predict(rival, transitions)
    else:
        usual = np.broadcast_to(transitions.displacement.mean(axis=0), (len(transitions), 3))
    candidate_errors = _errors(predict(simulation, transitions), transitions)
    return gate.judge_dynamics(candidate_errors, _errors(usual, transitions), transitions.run)


def _common(first: Recording, second: Recording) -> Recording:
    kept = {(track.run, track.vehicle) for track in second.tracks}
    return first.where(lambda track: (track.run, track.vehicle) in kept)


def _errors(predicted: np.ndarray, transitions: Transitions) -> gate.Errors:
    return gate.Errors(
        position_error_mm(predicted, transitions.displacement),
        np.degrees(orientation_error_rad(predicted, transitions.displacement)),
    )


def judge_policies(
    candidate: registry.Version, champion: registry.Version | None, robot: Robot, asked: PolicyGate
) -> gate.PolicyVerdict:
    """Roll out both on stand-ins from the same starts, and judge.

    Raises:
        UserError: the champion is for another task, or there are too few roll-outs.
    """
    policy = load_policy(candidate.folder(), robot)
    rival = load_policy(champion.folder(), robot) if champion else None
    if rival and rival.task != policy.task:
        if not asked.other_task:
            raise UserError(
                f"{candidate} is for task {policy.task.name!r}, {champion}, the champion, for "
                f"{_task_difference(rival, policy)}: add policy_gate.other_task=true to replace it all the same"
            )
        rival = None
    return gate.judge_policy(
        _trials(policy, asked),
        _trials(rival, asked) if rival else None,
        least_success=asked.least_success,
        most_collisions=asked.most_collisions,
        margin=asked.margin,
    )


def _task_difference(rival: StoredPolicy, policy: StoredPolicy) -> str:
    """Name the champion's task; where the name is the same, say which of its settings differs."""
    if rival.task.name != policy.task.name:
        return repr(rival.task.name)
    theirs, ours = rival.task.model_dump(), policy.task.model_dump()
    setting = next(name for name in ours if ours[name] != theirs.get(name))
    return f"the same with {setting} {theirs.get(setting)!r} in place of {ours[setting]!r}"


def _trials(policy: StoredPolicy, asked: PolicyGate) -> gate.Trials:
    task = policy.build_task()
    vehicles = other_vehicles(asked.vehicles, task)
    scenario = draw_scenarios(task, asked.rollouts, "gate", asked.seed)
    rollout = on_stand_ins(policy, vehicles, scenario, asked.seed)
    return gate.Trials(rollout.success, rollout.collided_step != NEVER)
