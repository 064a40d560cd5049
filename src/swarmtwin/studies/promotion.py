"""Promotion: a registered model becomes champion if it is measurably better, or for policies safe enough, than before.

Dynamics models are compared by their one-step errors on runs that neither has seen: with the champion, and where there
is none yet with the robot's kinematic model, fitted to what the candidate learned from. Policies are compared by what
they do on stand-ins from the same starts, each with the champion of its own task. The statistics of both gates stand in
`tracking/gate.py`.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from swarmtwin.diagnosis.measured_ranges import chosen_randomisation
from swarmtwin.dynamics.evaluation import one_step_errors
from swarmtwin.dynamics.model_folder import load_evidence, model_name
from swarmtwin.dynamics.plain_baseline import fit_kinematics
from swarmtwin.dynamics.predictor import OneStepModel
from swarmtwin.dynamics.provenance import Provenance
from swarmtwin.errors import RefusedError, UserError
from swarmtwin.policies.policy_folder import StoredPolicy, load_policy
from swarmtwin.policies.rollout_comparison import draw_scenarios
from swarmtwin.recordings.recognition import recognised
from swarmtwin.recordings.recording import Recording
from swarmtwin.robot import Robot, Seed, StrictModel
from swarmtwin.simulation.evaluation import load_simulation
from swarmtwin.studies.deployed_trials import deployed_trials
from swarmtwin.studies.rollout_runner import in_simulation, on_stand_ins, other_vehicles, simulation_of
from swarmtwin.studies.tracked_inputs import model_input
from swarmtwin.tracking import gate, registry
from swarmtwin.tracking.champion_page import Evidence, champion_page, code
from swarmtwin.tracking.model_source import model_folder
from swarmtwin.tracking.models import ModelKind
from swarmtwin.tracking.runs import tracked_run
from swarmtwin.transitions import Transitions, from_recording, load_preparation
from swarmtwin.transitions.inputs import Vehicles, prepared_transitions, read_vehicles
from swarmtwin.world.rollout import NEVER

Share = Annotated[float, Field(ge=0, le=1)]


class PolicyGate(StrictModel):
    """What a policy must show; the values stand in conf/promote.yaml.

    Attributes:
        vehicles: ids of the stand-ins, as many as the task has vehicles; None: those after the one recorded.
        rollouts: how many starts.
        seed: of the starts.
        least_success: share of the roll-outs that must succeed.
        most_collisions: the share in which vehicles collide must be below this.
        margin: how much less success than the champion's can be put up with, as a share of the roll-outs.
        other_settings: whether the champion may be one for the same task with other settings, not compared with.
        deployments: folders that `deploy` left, by which policies are judged instead of stand-ins: each by its own.
        fewest_deployments: of the candidate, and of a champion that it is compared with.
        randomisation: what differs from roll-out to roll-out, mechanisms with ranges or the folder of a diagnosis:
            policies are judged in the candidate's simulation, randomised so, instead of on stand-ins; None: on these.
        draws: how many of the roll-outs differ, at most.
    """

    vehicles: Vehicles
    rollouts: Annotated[int, Field(ge=1)]
    seed: Seed
    least_success: Share
    most_collisions: Share
    margin: Share
    other_settings: bool
    deployments: tuple[Path, ...] | None = None
    fewest_deployments: Annotated[int, Field(ge=1)] = 20
    randomisation: dict[str, Any] | str | None = None
    draws: Annotated[int, Field(ge=1)] = 16


def promote(
    kind: ModelKind,
    candidate: str,
    robot: Robot,
    recording: Path,
    baseline: Path | None,
    task: str | None,
    policy_gate: PolicyGate,
    command: str | None = None,
) -> str:
    """Make a model the champion if it passes its gate; return what was found, as a sentence.

    Args:
        kind: a dynamics model or a policy.
        candidate: `challenger`, a version's number, `models:/NAME/VERSION`, or a model folder, which is registered.
        robot: whose model it is.
        recording: what dynamics models are measured on.
        baseline: transitions that the plain rival of a first champion is fitted to; None: those that it learned from.
        task: of a policy; None: whatever the candidate is for.
        policy_gate: what a policy must show.
        command: that asked for it, as the champion's page in MLflow says; None: it does not.

    Raises:
        RefusedError: the gate refuses it.
        UserError: there is no such candidate, or nothing to measure it on.
    """
    version = _find_candidate(kind, candidate, robot, task)
    champion = registry.holder(version.name, "champion", version.task)
    if champion and champion.number == version.number:
        return f"{version} is the champion already"
    verdict: gate.DynamicsVerdict | gate.PolicyVerdict
    if kind == "dynamics":
        verdict, rival, evidence = judge_dynamics(version, champion, robot, recording, baseline)
        reason = f"{verdict} than {rival}{'' if champion else ' (there is no champion yet)'} on {recording}"
    else:
        verdict, evidence = judge_policies(version, champion, robot, policy_gate)
        reason = str(verdict)
    if not verdict.passed:
        stays = f"; {champion} stays champion" if champion else ""
        raise RefusedError(f"{version} is not promoted: {reason}{stays}")
    registry.promote(version, reason, champion, champion_page(version, evidence, command))
    return f"{version} is champion: {reason}"


def roll_back(kind: ModelKind, robot: Robot, task: str | None) -> str:
    """Make the champion before champion again, of a policy that of its task; return what was done.

    Raises:
        UserError: there is no champion or none before it, or several tasks have one and none is named.
    """
    name = f"{robot.name}-{kind}"
    champion = _only_holder(name, "champion", task)
    demoted, restored = registry.roll_back(name, champion.task if champion else task)
    return f"{name}: version {restored} is champion again, version {demoted} no longer"


def _only_holder(name: str, role: registry.Role, task: str | None) -> registry.Version | None:
    """Return the challenger or champion of a task, or, where none is named, of the only task that has one."""
    if task is not None:
        return registry.holder(name, role, task)
    found = registry.holders(name, role)
    if len(found) > 1:
        tasks = " or ".join(f"task={version.task}" for version in found)
        raise UserError(f"{name} has a {role} for each of {len(found)} tasks: add {tasks}")
    return found[0] if found else None


def _find_candidate(kind: ModelKind, candidate: str, robot: Robot, task: str | None) -> registry.Version:
    """Return the version meant; a folder that is no version yet is registered first."""
    name = f"{robot.name}-{kind}"
    if candidate == "challenger":
        return _only_holder(name, "challenger", task) or registry.find_version(f"models:/{name}@{candidate}", task)
    if candidate.isdigit():
        return registry.find_version(f"models:/{name}/{candidate}", task)
    if candidate.startswith("models:"):
        version = registry.find_version(candidate, task)
        if version.name != name:
            noun = {"dynamics": "dynamics model", "policy": "policy"}[kind]
            raise UserError(f"{candidate} is no {noun} of robot {robot.name!r}: add robot=... or what=...")
        return version
    folder = model_folder(candidate)
    if kind == "dynamics":
        _, provenance = load_simulation(folder, robot)
        tags, seed = provenance.tags(model_name(folder)), provenance.seed
    else:
        policy = load_policy(folder, robot, task)
        tags, seed = policy.provenance.tags(policy.task.name), policy.provenance.seed
    if known := registry.version_of(name, folder):
        return known
    given = [model_input(folder, kind)]
    with tracked_run(kind, f"register {folder}", {"candidate": candidate}, given, seed) as tracked:
        source = tracked.model(folder, kind)
    return registry.register(name, folder, source, tracked.run_id, tags)


def judge_dynamics(
    candidate: registry.Version,
    champion: registry.Version | None,
    robot: Robot,
    recording: Path,
    baseline: Path | None,
) -> tuple[gate.DynamicsVerdict, str, Evidence]:
    """Compare both on what neither has seen, or, without a champion, with the plain baseline.

    Returns:
        what the gate says, the rival's name, and the same for the champion's page.

    Raises:
        UserError: the recording is at fault, no run of it is unseen by both, or there is nothing to fit a baseline to.
    """
    measured = read_vehicles(recording, robot, None)
    folder = candidate.folder()
    simulation, provenance = load_simulation(folder, robot)
    unseen = provenance.unseen_part(measured)
    rival: OneStepModel
    if champion:
        rival, rival_provenance = load_simulation(champion.folder(), robot)
        unseen, name = _common(unseen, rival_provenance.unseen_part(measured)), str(champion)
        compared_with = f"{champion}, the champion before it"
        if not unseen.tracks:
            raise UserError(
                f"{candidate} and {champion} were trained on recording {provenance.recording!r}, and no run of it is "
                "unseen by both: add recording=... with another one"
            )
    else:
        fitted_to, where = _baseline_transitions(folder, provenance, robot, baseline, unseen)
        rival = fit_kinematics(fitted_to)
        name = f"the kinematic model fitted to {where}"
        compared_with = f"{name}: there was no champion before it"
    transitions, _ = from_recording(unseen)
    errors = [gate.Errors.by_run(one_step_errors(model, transitions), transitions.run) for model in (simulation, rival)]
    verdict = gate.judge_dynamics(*errors)
    evidence = Evidence(
        because=f"its one-step error is {verdict.gain} than that of {name}",
        measured_on=f"{len(errors[0].transitions)} runs, {len(transitions)} transitions, of the recording "
        f"{code(recording)}, of which neither model has seen any (its source: {measured.header.source})",
        compared_with=compared_with,
    )
    return verdict, name, evidence


def _baseline_transitions(
    folder: Path, provenance: Provenance, robot: Robot, chosen: Path | None, judged: Recording
) -> tuple[Transitions, str]:
    """Return what the plain baseline is fitted to, and its name: nothing of it is judged on.

    That is the training split of `chosen`, or of the pipeline's transitions where the candidate's recording is theirs;
    or else the validation runs that lie beside the candidate.
    """
    prepared = chosen or Path("artifacts/transitions") / robot.name
    if chosen or (prepared.is_dir() and load_preparation(prepared).digest == provenance.digest):
        transitions, preparation = prepared_transitions(prepared, robot)
        if any(recognised(judged.tracks, set(preparation.learned))):
            raise UserError(f"baseline {prepared} holds runs that are judged on: add recording=... with another one")
        return transitions.part("train"), f"{prepared}"
    evidence = load_evidence(folder)
    if evidence is None or not len(evidence.part("validation")):
        raise UserError(
            f"{folder} carries no measured transitions to fit the kinematic model to, the rival of a first champion: "
            "add baseline=DIR, what swarmtwin prepare made of the recording that it learned from"
        )
    return evidence.part("validation"), "its validation runs"


def _common(first: Recording, second: Recording) -> Recording:
    kept = {(track.run, track.vehicle) for track in second.tracks}
    return first.where(lambda track: (track.run, track.vehicle) in kept)


def judge_policies(
    candidate: registry.Version, champion: registry.Version | None, robot: Robot, asked: PolicyGate
) -> tuple[gate.PolicyVerdict, Evidence]:
    """Roll out both from the same starts, on stand-ins or in a randomised simulation, or look at deployments; judge.

    A champion that was never deployed is not compared with.

    Returns:
        what the gate says, and the same for the champion's page.

    Raises:
        RefusedError: the champion's task has other settings.
        UserError: there are too few roll-outs or deployments, what differs cannot in the candidate's simulation, or
            policies are to be judged by two things at once.
    """
    if asked.deployments is not None and asked.randomisation is not None:
        raise UserError("policies are judged by deployments or in a randomised simulation: leave one of the two out")
    policy = load_policy(candidate.folder(), robot)
    rival = load_policy(champion.folder(), robot) if champion else None
    if rival and rival.task != policy.task:
        if not asked.other_settings:
            raise RefusedError(
                f"{candidate} is not promoted: it cannot be compared with {champion}, the champion for task "
                f"{policy.task.name!r}, which has {_task_difference(rival, policy)}: add "
                "policy_gate.other_settings=true to replace it without a comparison"
            )
        rival = None
    if asked.deployments is None:
        trials = _trials([one for one in (policy, rival) if one], asked)
    else:
        trials = _trials_deployed([one for one in (policy, rival) if one], robot, asked)
    verdict = gate.judge_policy(
        trials[0],
        trials[1] if len(trials) > 1 else None,
        least_success=asked.least_success,
        most_collisions=asked.most_collisions,
        margin=asked.margin,
        fewest_rollouts=100 if asked.deployments is None else asked.fewest_deployments,
    )
    demands = f"at least {asked.least_success:.0%} success, less than {asked.most_collisions:.0%} collisions"
    evidence = Evidence(
        because=f"it meets every demand ({demands}): {verdict.found}",
        measured_on=f"{len(trials[0].succeeded)} {_judged_in(policy, asked)}",
        compared_with=_compared_with(champion, rival, trials),
    )
    return verdict, evidence


def _judged_in(policy: StoredPolicy, asked: PolicyGate) -> str:
    """Say what policies are judged by, as it follows a number."""
    if asked.deployments is not None:
        return "deployments"
    if asked.randomisation is not None:
        return f"roll-outs in the simulation that it was learned in, in which {code(asked.randomisation)} differs"
    return f"roll-outs on stand-ins, vehicles {', '.join(other_vehicles(asked.vehicles, policy.build_task()))}"


def _compared_with(champion: registry.Version | None, rival: StoredPolicy | None, trials: Sequence[gate.Trials]) -> str:
    """Say which policy the candidate was compared with, or why with none."""
    if champion is None:
        return "no other policy: it is the first champion for its task"
    if rival is None:
        return f"no other policy: the task of {champion}, the champion before it, had other settings"
    if len(trials) == 1:
        return f"no other policy: {champion}, the champion before it, was not deployed"
    starts = "from the same starts" if trials[0].paired else "in deployments of its own"
    return f"{champion}, the champion before it, {starts}"


def _task_difference(rival: StoredPolicy, policy: StoredPolicy) -> str:
    """Say which setting of the champion's task is another."""
    theirs, ours = rival.task.model_dump(), policy.task.model_dump()
    setting = next(name for name in ours if ours[name] != theirs.get(name))
    return f"{setting} {theirs.get(setting)!r} in place of {ours[setting]!r}"


def _trials_deployed(policies: Sequence[StoredPolicy], robot: Robot, asked: PolicyGate) -> list[gate.Trials]:
    """Return the deployments of the candidate, and of the champion where it was deployed."""
    found = deployed_trials(asked.deployments or (), robot)
    trials: list[gate.Trials] = []
    for policy in policies:
        own = found.get(registry.folder_digest(policy.folder))
        if own is None and not trials:
            raise UserError(
                f"none of the {len(asked.deployments or ())} deployments is one of {policy.folder}: deploy it, and "
                "name the folders, policy_gate.deployments=[...]"
            )
        if own is not None:
            trials.append(own)
    if len(trials) > 1 and (count := len(trials[1].succeeded)) < asked.fewest_deployments:
        raise UserError(
            f"{count} deployments of the champion are too few to compare with: name {asked.fewest_deployments} or "
            "more, or none"
        )
    return trials


def _trials(policies: Sequence[StoredPolicy], asked: PolicyGate) -> list[gate.Trials]:
    """Return the roll-outs of the candidate, and of the champion, from the same starts and with the same chances."""
    task = policies[0].build_task()
    scenario = draw_scenarios(task, asked.rollouts, "gate", asked.seed)
    if asked.randomisation is None:
        what, vehicles = "roll-outs on stand-ins", other_vehicles(asked.vehicles, task)
        rollouts = [on_stand_ins(policy, vehicles, scenario, asked.seed) for policy in policies]
    else:
        what, simulation = "roll-outs in a randomised simulation", simulation_of(policies[0], None, task.robot)
        differing = chosen_randomisation(asked.randomisation, simulation, asked.draws)
        rollouts = [in_simulation(one, simulation, scenario, None, asked.seed, differing) for one in policies]
    return [gate.Trials(one.success, one.collided_step != NEVER, one.mean_reward, what) for one in rollouts]
