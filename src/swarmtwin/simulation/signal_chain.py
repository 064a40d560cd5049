"""One control period of N vehicles, stage by stage: link, controller, supply, actuators, ground, body, clock.

A dynamics model answers for one command held over one period. What changes within a period (a late command, actuators
that follow gradually, another ground) is integrated piece by piece over the model's steady twists; where nothing does,
the model's own answer stands. Twists are per nominal period: (N, 3) forward_mm, left_mm, turn_rad.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from swarmtwin.geometry import compose, displacement_between, rotate
from swarmtwin.simulation.arcs import exp_map, log_map, moved_along
from swarmtwin.simulation.base_twists import BaseTwists
from swarmtwin.simulation.efforts import by_effort, slowed
from swarmtwin.simulation.following_actuators import ActuatorTwists, Following, composed
from swarmtwin.simulation.mechanism import Mechanism, Moment
from swarmtwin.simulation.supply import Supply
from swarmtwin.simulation.transient import Transient

Memory = Mapping[str, Tensor]
TWIST, REFERENCE_TWIST, SETTING = "actuator twist", "reference's actuator twist", "actuator setting"
FOLLOWING = frozenset({TWIST, REFERENCE_TWIST, SETTING})
"""Memory of what follows a command, whatever else acts."""


class ActuatorMotion(NamedTuple):
    """How actuators move N vehicles over one nominal period.

    Attributes:
        pieces: shares of the period and the constant twists (N, 3) over them, in order.
        correction: (N, 3) to be added to the twist of the whole period; None: nothing.
        end: (N, 3) twist at the period's end, with which motion goes on where a mechanism follows the clock.
        memory: what is carried to the next period.
    """

    pieces: list[tuple[float, Tensor]]
    correction: Tensor | None
    end: Tensor
    memory: dict[str, Tensor]


class PeriodMotion(NamedTuple):
    """Where a control period brings N vehicles: displacements (N, 3) in their own frames, and what they remember."""

    displacement: Tensor
    memory: dict[str, Tensor]


def remembered_after_long(mechanisms: Sequence[Mechanism], twists: BaseTwists, place: int) -> dict[str, Tensor]:
    """Return what actuators remember that have long been given the command in a place."""
    moment = twists.moment
    with_memory = [one for one in mechanisms if one.initial_memory(torch.zeros(1, 3), moment) is not None]
    if not with_memory and all(one.latency_s() <= 0 and one.added_lag_s() <= 0 for one in mechanisms):
        return {}
    memory = _at_rest_in(mechanisms, twists, place)
    for mechanism in with_memory:
        own = mechanism.initial_memory(memory[TWIST], moment)
        assert own is not None
        memory[mechanism.name] = own
    return memory


def remembered_after_two(mechanisms: Sequence[Mechanism], twists: BaseTwists) -> dict[str, Tensor]:
    """Return what actuators remember that have long been given the command in place 2, and then that in place 1."""
    memory = remembered_after_long(mechanisms, twists, 2)
    return end_memory(mechanisms, twists, memory, 1) if memory else {}


def end_memory(
    mechanisms: Sequence[Mechanism], twists: BaseTwists, memory: Memory, place: int = 0
) -> dict[str, Tensor]:
    """Return what actuators remember at the end of the period of the command in a place, from what they did before."""
    if not FOLLOWING.issuperset(memory):
        followed = following_motion(mechanisms, twists, place, memory)
        return with_own_memory(mechanisms, followed, twists, place, memory).memory
    moment = _given(twists, place)
    following, supply = _following(mechanisms, moment, place), Supply.of(mechanisms, moment)
    if SETTING in memory:
        return _settings_at_end(following, twists, supply, memory)
    moving = following.wheels_at_end(twists, supply, ActuatorTwists(memory[TWIST], memory[REFERENCE_TWIST]))
    return {TWIST: moving.now, REFERENCE_TWIST: moving.undisturbed}


def _settings_at_end(following: Following, twists: BaseTwists, supply: Supply, memory: Memory) -> dict[str, Tensor]:
    """Return what settings of fins or propellers have come to at the period's end, whatever else acts on them."""
    moving = ActuatorTwists(memory[TWIST], memory[REFERENCE_TWIST])
    setting, moving = following.settings_at_end(twists, supply, memory[SETTING], moving)
    return {SETTING: setting, TWIST: moving.now, REFERENCE_TWIST: moving.undisturbed}


def following_motion(mechanisms: Sequence[Mechanism], twists: BaseTwists, place: int, memory: Memory) -> ActuatorMotion:
    """Let the actuators follow the command in a place, whatever mechanisms with a memory of their own make of it."""
    moment = _given(twists, place)
    supply = Supply.of(mechanisms, moment)
    following = _following(mechanisms, moment, place)
    followed = {name: memory[name] for name in memory if name in FOLLOWING}
    correction = None
    if not followed:  # nothing late, gradual or with memory: the model's own answer
        response = supply(twists.response(place))
        pieces = [response] * len(following.ends)
        goes_on = "previous_command" in twists.dynamics.inputs and _follow_clock(mechanisms)
        end = supply(twists.steady(place)) if goes_on else response
    else:
        moving = ActuatorTwists(followed[TWIST], followed[REFERENCE_TWIST])
        if moment.robot.actuation.kind == "thrust":
            pieces, correction, moving = following.settings(twists, supply, followed[SETTING], moving)
            followed = _settings_at_end(following, twists, supply, followed)
        else:
            pieces, correction, moving = following.wheels(twists, supply, moving)
            followed = {TWIST: moving.now, REFERENCE_TWIST: moving.undisturbed}
        end = moving.now
    return ActuatorMotion(list(zip(following.shares, pieces, strict=True)), correction, end, followed)


def with_own_memory(
    mechanisms: Sequence[Mechanism], motion: ActuatorMotion, twists: BaseTwists, place: int, memory: Memory
) -> ActuatorMotion:
    """Return a motion of actuators with what mechanisms make of it that have a memory of their own."""
    acting = [mechanism for mechanism in mechanisms if mechanism.name in memory]
    if not acting:
        return motion
    moment, pieces, carried = _given(twists, place), [], dict(memory) | motion.memory
    for share, twist in motion.pieces:
        for mechanism in acting:
            twist, carried[mechanism.name] = mechanism.actuator_response(twist, carried[mechanism.name], share, moment)
        pieces.append((share, twist))
    return motion._replace(pieces=pieces, memory=carried)


def _given(twists: BaseTwists, place: int) -> Moment:
    """Return the moment in which vehicles are given the command in a place."""
    return replace(twists.moment, given=twists.setting(place))


def period_motion(
    mechanisms: Sequence[Mechanism], twists: BaseTwists, memory: Memory, followed: ActuatorMotion | None = None
) -> PeriodMotion:
    """Move N vehicles through one control period under the present command, without chance.

    Args:
        mechanisms: in the order of the signal.
        twists: what the dynamics model answers.
        memory: what actuators remember at the start.
        followed: what `following_motion` says of the same, where that is known already.
    """
    moment = twists.moment
    followed = followed or following_motion(mechanisms, twists, 0, memory)
    motion = with_own_memory(mechanisms, followed, twists, 0, memory)
    displacement, end = _on_the_ground(mechanisms, motion, moment)
    if motion.correction is not None:
        displacement = exp_map(log_map(displacement) + motion.correction)
    if _follow_clock(mechanisms):
        more = moment.duration_s / moment.robot.period_s - 1
        displacement = moved_along(displacement, end * more[:, None])
    return PeriodMotion(_carried_along(mechanisms, displacement, twists), motion.memory)


def _follow_clock(mechanisms: Sequence[Mechanism]) -> bool:
    return any(mechanism.follows_clock() for mechanism in mechanisms)


def _following(mechanisms: Sequence[Mechanism], moment: Moment, place: int) -> Following:
    """Return how actuators follow the command in a place: how late, how gradually, and in which pieces."""
    robot = moment.robot
    latency = min(sum(mechanism.latency_s() for mechanism in mechanisms) / robot.period_s, 1.0)
    added_lag = sum(mechanism.added_lag_s() for mechanism in mechanisms) / robot.period_s
    inner = {share for mechanism in mechanisms for share in mechanism.breakpoints(robot)}
    ends = (*sorted(share for share in {*inner, latency} if 0.0 < share < 1.0), 1.0)
    transient = Transient.combined(mechanism.transient() for mechanism in mechanisms)
    if transient.lag_s:  # a change that itself takes longer brings things about for longer
        transient = transient._replace(lag_s=transient.lag_s + added_lag * robot.period_s)
    return Following(place, ends, latency, added_lag, transient)


def _at_rest_in(mechanisms: Sequence[Mechanism], twists: BaseTwists, place: int) -> dict[str, Tensor]:
    """Return what actuators remember that have come to rest in the command of a place: twists, and thrust's setting."""
    twist = Supply.of(mechanisms, twists.moment)(twists.steady(place))
    setting = {SETTING: twists.setting(place)} if twists.moment.robot.actuation.kind == "thrust" else {}
    return {**setting, TWIST: twist, REFERENCE_TWIST: twist}


def _on_the_ground(mechanisms: Sequence[Mechanism], motion: ActuatorMotion, moment: Moment) -> tuple[Tensor, Tensor]:
    """Return the displacements (N, 3) that actuators bring about on their ground, and the twists (N, 3) at the end."""
    gripping = [mechanism for mechanism in mechanisms if mechanism.stage == "ground"]
    if not gripping:
        return composed(motion.pieces), motion.end
    pose, end, factor = moment.pose, motion.end, _tractions(gripping, moment.pose, moment)
    for share, twist in motion.pieces:
        middle = moved_along(pose, slowed(twist, factor, moment.track_mm), share / 2)  # as slow as in the piece before
        factor = _tractions(gripping, middle, moment)
        pose = moved_along(pose, slowed(twist, factor, moment.track_mm), share)
    moved = displacement_between(moment.pose, pose)
    return moved, slowed(end, factor, moment.track_mm)


def _tractions(mechanisms: Sequence[Mechanism], pose: Tensor, moment: Moment) -> Tensor:
    """Return the factor on how far mechanisms let vehicles at poses (N, 3) come, as `slowed` takes it."""
    factor = torch.ones(len(pose), 1, dtype=torch.float64)
    for mechanism in mechanisms:
        traction = _traction(mechanism, pose, moment)
        factor = factor if traction is None else factor * traction
    return factor


def _traction(mechanism: Mechanism, pose: Tensor, moment: Moment) -> Tensor | None:
    """Return the factor on how far a mechanism lets vehicles at poses (N, 3) come, as `slowed` takes it."""
    if (what := mechanism.what_traction_slows()) != "wheels":
        traction = mechanism.traction(pose[:, :2], moment)
        if traction is None:
            return None
        return by_effort(traction[:, None], moment) if what == "thrust" else traction[:, None]
    half = torch.tensor([[0.0, moment.track_mm / 2]], dtype=pose.dtype).expand(len(pose), 2)
    aside = rotate(half, pose[:, 2])
    sides = [mechanism.traction(pose[:, :2] + side * aside, moment) for side in (1, -1)]
    return torch.stack([one for one in sides if one is not None], dim=-1)


def _carried_along(mechanisms: Sequence[Mechanism], displacement: Tensor, twists: BaseTwists) -> Tensor:
    """Add what slopes, currents and other vehicles do to displacements (N, 3), as far as walls let them."""
    moving = [mechanism for mechanism in mechanisms if mechanism.stage == "body"]
    if not moving:
        return displacement
    moment, halfway = twists.moment, exp_map(log_map(displacement) / 2)
    for mechanism in moving:
        velocity_mm_s = mechanism.drift_velocity(halfway, moment)
        if velocity_mm_s is not None:
            carried, came_to = velocity_mm_s * moment.duration_s[:, None], compose(moment.pose, displacement)
            carried = moment.conditions.stopped_mm(came_to, carried, twists.held_back_mm())
            along = rotate(carried, -moment.pose[:, 2])
            displacement = torch.cat([displacement[:, :2] + along, displacement[:, 2:]], dim=-1)
    return displacement


def passed_on(mechanism: Mechanism, commands: Sequence[Tensor], moment: Moment) -> list[Tensor]:
    """Return the commands (N, m) that a mechanism makes of some, the present ones first; the last were held before."""
    given = [mechanism.transform_command(command, moment) for command in commands]
    befores = [*given[1:], given[-1]]
    return [mechanism.mean_command(command, before, moment) for command, before in zip(given, befores, strict=True)]
