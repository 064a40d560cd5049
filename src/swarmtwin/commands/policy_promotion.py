"""The policies' part of `swarmtwin promote`: candidate and champion drive the same stand-ins from the same starts."""

from typing import Annotated

from pydantic import Field

from swarmtwin import gate, registry
from swarmtwin.commands.rolling_out import on_stand_ins, other_vehicles
from swarmtwin.commands.sources import Vehicles
from swarmtwin.errors import UserError
from swarmtwin.policies.scenes import draw_scenes
from swarmtwin.policies.store import StoredPolicy, load_policy
from swarmtwin.robot import Robot, Seed, StrictModel
from swarmtwin.world.rollout import NEVER, Rollout

Share = Annotated[float, Field(ge=0, le=1)]


class PolicyGate(StrictModel):
    """What a policy must show; the values stand in conf/promote.yaml."""

    vehicles: Vehicles
    rollouts: Annotated[int, Field(ge=1)]
    seed: Seed
    least_success: Share
    most_collisions: Share
    margin: Share
    other_task: bool

    @property
    def demands(self) -> gate.Demands:
        """The limits, as the gate takes them."""
        return gate.Demands(self.least_success, self.most_collisions, self.margin)


def judge_policies(
    candidate: registry.Version, incumbent: registry.Version | None, robot: Robot, asked: PolicyGate
) -> gate.PolicyVerdict:
    """Roll out both on stand-ins from the same starts, and judge.

    Raises:
        UserError: the champion is for another task, or there are too few roll-outs.
    """
    policy = load_policy(candidate.folder(), robot)
    rival = load_policy(incumbent.folder(), robot) if incumbent else None
    if rival and incumbent and rival.task != policy.task:
        if not asked.other_task:
            theirs = _task_text(rival, policy)
            raise UserError(
                f"{candidate} is for task {policy.task.name!r}, {incumbent}, the champion, for {theirs}: "
                "add policy_gate.other_task=true to replace it all the same"
            )
        rival = None
    return gate.judge_policy(_trials(policy, asked), _trials(rival, asked) if rival else None, asked.demands)


def _task_text(rival: StoredPolicy, policy: StoredPolicy) -> str:
    """Name the champion's task; where the name is the same, say which of its settings differs."""
    if rival.task.name != policy.task.name:
        return repr(rival.task.name)
    theirs, ours = rival.task.model_dump(), policy.task.model_dump()
    setting = next(name for name in ours if ours[name] != theirs.get(name))
    return f"the same with {setting} {theirs.get(setting)!r} in place of {ours[setting]!r}"


def _trials(policy: StoredPolicy, asked: PolicyGate) -> gate.Trials:
    task = policy.build_task()
    vehicles = other_vehicles(asked.vehicles, task)
    scene = draw_scenes(task, asked.rollouts, "gate", asked.seed)
    rollout: Rollout = on_stand_ins(policy, vehicles, scene, asked.seed)
    return gate.Trials(rollout.success, rollout.collided_step != NEVER)
