"""One control period of N vehicles, stage by stage: link, controller, supply, actuators, ground, body, clock.

A dynamics model answers for one command held over one period. What changes within a period (a late command, actuators
that follow gradually, another ground) is integrated piece by piece over the model's steady twists; where nothing does,
the model's own answer stands. Twists are per nominal period: (N, 3) forward_mm, left_mm, turn_rad.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from swarmtwin.dynamics.predictor import DynamicsModel
from swarmtwin.geometry import compose, exp_map, log_map, rotate
from swarmtwin.simulation.mechanism import Mechanism, Moment, scaled_by_effort

Memory = Mapping[str, Tensor]
TWIST, REFERENCE_TWIST, SETTING = "actuator twist", "reference's actuator twist", "actuator setting"


@dataclass
class Answers:
    """Twists (N, 3) that a dynamics model has answered to the same commands from the same poses.

    Attributes:
        to_commands: by the indices of the command and of the one before it.
        to_settings: to settings on their way, by the roles of the commands, the way and the share of it that is left.
        delays: lateness and lag for which these settings hold.
    """

    to_commands: dict[tuple[int, int], Tensor] = field(default_factory=dict)
    to_settings: dict[tuple[object, ...], Tensor] = field(default_factory=dict)
    delays: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class BaseTwists:
    """What a dynamics model answers to the last commands of N vehicles, each question asked once.

    Attributes:
        dynamics: the model.
        moment: where the vehicles are.
        commands: (N, m) each, as the actuators are given them: the present one, the one before, and so on.
        known: answers so far; shared between evaluations in which commands, poses and what came before are the same.
        roles: which of the commands stands in each place: (0, 1, 2), unless a command was lost and another goes on.
        clock_is_nominal: whether the model is told the nominal period whatever the measured one, since a mechanism
            accounts for the difference.
    """

    dynamics: DynamicsModel
    moment: Moment
    commands: Sequence[Tensor]
    known: Answers = field(default_factory=Answers)
    roles: Sequence[int] = (0, 1, 2)
    clock_is_nominal: bool = False

    def setting(self, place: int) -> Tensor:
        """Return the commands (N, m) in a place: 0 for the present one."""
        return self.commands[self.roles[place]]

    def response(self, place: int) -> Tensor:
        """Return the twists under the command in a place after the one before it, held over one period each."""
        return self._answer(self.roles[place], self.roles[place + 1])

    def steady(self, place: int) -> Tensor:
        """Return the twists under the command in a place, held for long."""
        return self._answer(self.roles[place], self.roles[place])

    def displacement(self) -> Tensor:
        """Return the model's own answer to the present command, displacements (N, 3), with nothing beyond it."""
        before, earlier = self.commands[1], self.commands[2]
        return self._predicted(self.commands[0], before, earlier)

    def on_the_way(self, change: "SettingChange", left: float) -> Tensor:
        """Return the twists under settings held for long, with a share of their way left."""
        if change.delays != self.known.delays:
            self.known.to_settings, self.known.delays = {}, change.delays
        key = (*self.roles, change.period, change.towards, left)
        if key not in self.known.to_settings:
            target = self.setting(change.towards)
            setting = target + left * (change.start - target)
            self.known.to_settings[key] = self._ask(setting, setting, setting)
        return self.known.to_settings[key]

    def _answer(self, now: int, before: int) -> Tensor:
        if "previous_command" not in self.dynamics.inputs:
            before = now
        known = self.known.to_commands
        if (now, before) not in known:
            earlier = before if now == before else min(before + 1, len(self.commands) - 1)
            known[now, before] = self._ask(*(self.commands[index] for index in (now, before, earlier)))
        return known[now, before]

    def _ask(self, command: Tensor, previous: Tensor, earlier: Tensor) -> Tensor:
        return log_map(self._predicted(command, previous, earlier))

    def _predicted(self, command: Tensor, previous: Tensor, earlier: Tensor) -> Tensor:
        moment = self.moment
        if self.clock_is_nominal:
            moment = replace(moment, duration_s=torch.full_like(moment.duration_s, moment.robot.period_s))
        situation = moment.situation(command, previous, earlier).only(self.dynamics.inputs)
        return self.dynamics.predict(situation).double()


class ActuatorMotion(NamedTuple):
    """How actuators move N vehicles over one nominal period.

    Attributes:
        pieces: shares of the period and the constant twists (N, 3) over them, in order.
        correction: (N, 3) to be added to the twist of the whole period; None: nothing.
        end: (N, 3) twist at the period's end.
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
        own = mechanism.initial_memory(_supplied(mechanisms, twists.steady(place), moment), moment)
        assert own is not None
        memory[mechanism.name] = own
    return memory


def remembered_after_two(mechanisms: Sequence[Mechanism], twists: BaseTwists) -> dict[str, Tensor]:
    """Return what actuators remember that have long been given the command in place 2, and then that in place 1."""
    memory = remembered_after_long(mechanisms, twists, 2)
    if set(memory) != {SETTING}:
        return actuator_motion(mechanisms, twists, 1, memory).memory if memory else {}
    latency, added_lag = _delays(mechanisms, twists.moment)  # settings change whatever they bring about
    changes = _setting_changes(
        twists, 1, memory[SETTING], (latency, 1.0) if latency > 0 else (1.0,), latency, added_lag
    )
    return {SETTING: list(changes)[-1].end}


def actuator_motion(mechanisms: Sequence[Mechanism], twists: BaseTwists, place: int, memory: Memory) -> ActuatorMotion:
    """Move the actuators through the period of the command in a place, after those before it."""
    moment = replace(twists.moment, given=twists.setting(place), given_before=twists.setting(place + 1))
    latency, added_lag = _delays(mechanisms, moment)
    ends = _ends(mechanisms, moment, latency)
    shares = [end - start for start, end in pairwise((0.0, *ends))]
    response = _supplied(mechanisms, twists.response(place), moment)
    carried = dict(memory)
    correction = None
    if latency <= 0 and added_lag <= 0:
        pieces = [response] * len(shares)
        knows_before = "previous_command" in twists.dynamics.inputs
        end = _supplied(mechanisms, twists.steady(place), moment) if knows_before else response
        if carried:
            carried |= _at_rest_in(mechanisms, twists, place)
    elif moment.robot.actuation.kind == "thrust":
        pieces, carried = _following_settings(mechanisms, twists, place, carried, ends, latency, added_lag)
        learned = response - _supplied(mechanisms, twists.steady(place), moment)
        pieces = [piece + learned for piece in pieces]
        end = pieces[-1]
    else:
        pieces, correction, carried = _following_twists(
            mechanisms, twists, place, carried, ends, latency, added_lag, response
        )
        end = carried[TWIST]
    for mechanism in mechanisms:
        if mechanism.name in carried:
            for index, share in enumerate(shares):
                pieces[index], carried[mechanism.name] = mechanism.actuator_response(
                    pieces[index], carried[mechanism.name], share, moment
                )
    return ActuatorMotion(list(zip(shares, pieces, strict=True)), correction, end, carried)


def period_motion(mechanisms: Sequence[Mechanism], twists: BaseTwists, memory: Memory) -> PeriodMotion:
    """Move N vehicles through one control period under the present command, without chance."""
    moment = twists.moment
    motion = actuator_motion(mechanisms, twists, 0, memory)
    displacement, end = _on_the_ground(mechanisms, motion, moment)
    if motion.correction is not None:
        displacement = exp_map(log_map(displacement) + motion.correction)
    if any(mechanism.follows_clock() for mechanism in mechanisms):
        more = moment.duration_s / moment.robot.period_s - 1
        displacement = compose(displacement, exp_map(end * more[:, None]))
    return PeriodMotion(_carried_along(mechanisms, displacement, moment), motion.memory)


def _delays(mechanisms: Sequence[Mechanism], moment: Moment) -> tuple[float, float]:
    """Return by how much commands come late, and with which time constant actuators follow them, both in periods."""
    period_s = moment.robot.period_s
    latency = sum(mechanism.latency_s() for mechanism in mechanisms) / period_s
    return min(latency, 1.0), sum(mechanism.added_lag_s() for mechanism in mechanisms) / period_s


def _at_rest_in(mechanisms: Sequence[Mechanism], twists: BaseTwists, place: int) -> dict[str, Tensor]:
    """Return what actuators remember that have come to rest in the command of a place: a setting, or wheels' twists."""
    if twists.moment.robot.actuation.kind == "thrust":
        return {SETTING: twists.setting(place)}
    twist = _supplied(mechanisms, twists.steady(place), twists.moment)
    return {TWIST: twist, REFERENCE_TWIST: twist}


def _ends(mechanisms: Sequence[Mechanism], moment: Moment, latency: float) -> tuple[float, ...]:
    """Return where the pieces end that a period is integrated in, as shares of it, the last one 1."""
    inner = {share for mechanism in mechanisms for share in mechanism.breakpoints(moment.robot)}
    return (*sorted(share for share in {*inner, latency} if 0.0 < share < 1.0), 1.0)


def _supplied(mechanisms: Sequence[Mechanism], twist: Tensor, moment: Moment) -> Tensor:
    """Return the twists (N, 3) of actuators with their supply as it is."""
    for mechanism in mechanisms:
        gain = mechanism.supply_gain(moment)
        if gain is not None:
            twist = scaled_by_effort(twist, gain, moment)
    return twist


def _left_over(share: float, lag: float) -> tuple[float, float]:
    """Return what is left of a change followed with a lag over a share, both in periods: on average, and at last."""
    if lag <= 0:
        return 0.0, 0.0
    left = math.exp(-share / lag)
    return lag / share * (1 - left), left


def _relaxed_twist(start: Tensor, target: Tensor, share: float, lag: float) -> tuple[Tensor, Tensor]:
    """Return the constant twist that brings vehicles as far as one that goes from `start` to `target`, and its end.

    The mean, and to second order what it matters that the old twist (N, 3) comes first: half the integral of the Lie
    bracket of earlier and later twists, as Magnus (1954) expands g' = g ξ.
    """
    late = start - target
    on_average, left = _left_over(share, lag)
    order = (lag * (1 + left) - 2 * lag * on_average) / 2
    return target + late * on_average + _bracket(late, target) * order, target + late * left


def _bracket(one: Tensor, other: Tensor) -> Tensor:
    """Return the Lie bracket (N, 3) of twists on SE(2)."""
    ahead = other[:, 2] * one[:, 1] - one[:, 2] * other[:, 1]
    left = one[:, 2] * other[:, 0] - other[:, 2] * one[:, 0]
    return torch.stack([ahead, left, torch.zeros_like(left)], dim=-1)


def _following_twists(
    mechanisms: Sequence[Mechanism],
    twists: BaseTwists,
    place: int,
    memory: dict[str, Tensor],
    ends: Sequence[float],
    latency: float,
    added_lag: float,
    response: Tensor,
) -> tuple[list[Tensor], Tensor | None, dict[str, Tensor]]:
    """Let wheels' speeds follow the command, late and gradually: each piece's mean twist, a correction, the memory.

    The dynamics model's response holds the lag that the actuators have by themselves. It stands where nothing is added:
    the pieces are shifted by what it differs from a lag of first order, and what their product lacks is corrected.
    """
    moment, own_lag = twists.moment, twists.moment.conditions.own_lag
    new, old = (_supplied(mechanisms, twists.steady(at), moment) for at in (place, place + 1))
    twist, reference = memory[TWIST], memory[REFERENCE_TWIST]
    pieces, references, shares = [], [], []
    for start, end in pairwise((0.0, *ends)):
        share = end - start
        mean, twist = _relaxed_twist(twist, old if end <= latency else new, share, own_lag + added_lag)
        reference_mean, reference = _relaxed_twist(reference, new, share, own_lag)
        pieces.append(mean)
        references.append(reference_mean)
        shares.append(share)
    learned = response - sum(share * piece for share, piece in zip(shares, references, strict=True))
    correction = None
    if own_lag > 0:
        undisturbed = _composed([(share, piece + learned) for share, piece in zip(shares, references, strict=True)])
        correction = response - log_map(undisturbed)
    carried = {**memory, TWIST: twist, REFERENCE_TWIST: reference}
    return [piece + learned for piece in pieces], correction, carried


def _following_settings(
    mechanisms: Sequence[Mechanism],
    twists: BaseTwists,
    place: int,
    memory: dict[str, Tensor],
    ends: Sequence[float],
    latency: float,
    added_lag: float,
) -> tuple[list[Tensor], dict[str, Tensor]]:
    """Let the setting of fins or propellers follow the command, late and gradually: each piece's mean twist, memory."""
    pieces: list[Tensor] = []
    for change in _setting_changes(twists, place, memory[SETTING], ends, latency, added_lag):
        pieces += [_supplied(mechanisms, piece, twists.moment) for piece in change.twists(twists)]
        setting = change.end
    return pieces, {**memory, SETTING: setting}


class SettingChange(NamedTuple):
    """Settings on their way from `start` (N, m) towards the command in a place.

    Attributes:
        period: the place of the command of the period.
        towards: the place of the command towards which they go.
        delays: lateness and lag in periods, from which and from the commands it follows where they start.
        start: (N, m) at first.
        left: mean share of the way that is left, over each piece.
        end: (N, m) at last.
    """

    period: int
    towards: int
    delays: tuple[float, float]
    start: Tensor
    left: list[float]
    end: Tensor

    def twists(self, twists: BaseTwists) -> list[Tensor]:
        """Return the mean twist (N, 3) of each piece, of fourth degree in what is left of the way.

        A twist changes smoothly along the way: five settings are asked for, at the Chebyshev points, however many
        pieces there are.
        """
        steady = twists.steady(self.towards)
        if not any(self.left):
            return [steady] * len(self.left)
        points = (1 - np.cos(np.linspace(0, np.pi, 5))) / 2
        known = [steady, *(twists.on_the_way(self, float(point)) for point in points[1:])]
        weights = np.linalg.solve(np.vander(points).T, np.vander(self.left, len(points)).T).T
        return [
            sum((float(one) * twist for one, twist in zip(row, known, strict=True)), torch.zeros_like(steady))
            for row in weights
        ]


def _setting_changes(
    twists: BaseTwists, place: int, setting: Tensor, ends: Sequence[float], latency: float, added_lag: float
) -> Iterator[SettingChange]:
    """Yield how settings change over a period: towards the command before until the new one acts, then towards that."""
    pieces = list(pairwise((0.0, *ends)))
    for at in (place + 1, place):
        shares = [end - start for start, end in pieces if (end <= latency) == (at == place + 1)]
        left, rest = [], 1.0
        for share in shares:
            on_average, at_last = _left_over(share, added_lag)
            left.append(rest * on_average)
            rest *= at_last
        if shares:
            start, target = setting, twists.setting(at)
            setting = target + rest * (start - target)
            yield SettingChange(place, at, (latency, added_lag), start, left, setting)


def _on_the_ground(mechanisms: Sequence[Mechanism], motion: ActuatorMotion, moment: Moment) -> tuple[Tensor, Tensor]:
    """Return the displacements (N, 3) that actuators bring about on their ground, and the twists (N, 3) at the end."""
    gripping = [mechanism for mechanism in mechanisms if mechanism.stage == "ground"]
    if not gripping:
        return _composed(motion.pieces), motion.end
    moved, end, factor = torch.zeros_like(motion.end), motion.end, None
    for share, twist in motion.pieces:
        middle = compose(moment.pose, compose(moved, exp_map(twist * (share / 2))))[:, :2]
        factor = torch.ones(len(middle), 1, dtype=torch.float64)
        for mechanism in gripping:
            traction = mechanism.traction(middle, moment)
            factor = factor if traction is None else factor * traction[:, None]
        moved = compose(moved, exp_map(scaled_by_effort(twist, factor, moment) * share))
    return moved, end if factor is None else scaled_by_effort(end, factor, moment)


def _composed(pieces: Sequence[tuple[float, Tensor]]) -> Tensor:
    """Return the displacements (N, 3) of twists one after the other."""
    moved = exp_map(pieces[0][1] * pieces[0][0])
    for share, twist in pieces[1:]:
        moved = compose(moved, exp_map(twist * share))
    return moved


def _carried_along(mechanisms: Sequence[Mechanism], displacement: Tensor, moment: Moment) -> Tensor:
    """Add what slopes, currents and other vehicles do to displacements (N, 3)."""
    moving = [mechanism for mechanism in mechanisms if mechanism.stage == "body"]
    if not moving:
        return displacement
    halfway = exp_map(log_map(displacement) / 2)
    for mechanism in moving:
        velocity_mm_s = mechanism.drift_velocity(halfway, moment)
        if velocity_mm_s is not None:
            along = rotate(velocity_mm_s * moment.duration_s[:, None], -moment.pose[:, 2])
            displacement = torch.cat([displacement[:, :2] + along, displacement[:, 2:]], dim=-1)
    return displacement
