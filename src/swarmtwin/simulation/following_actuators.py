"""Actuators that follow a command late and gradually, within one control period.

Twists are per nominal period: (N, 3) forward_mm, left_mm, turn_rad. Times are in periods.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from swarmtwin.simulation.arcs import exp_map, log_map, moved_along
from swarmtwin.simulation.base_twists import BaseTwists
from swarmtwin.simulation.efforts import twist_of_wheels, wheel_travel
from swarmtwin.simulation.mechanism import Moment
from swarmtwin.simulation.transient import Transient

Supply = Callable[[Tensor], Tensor]
"""What becomes of twists (N, 3) of actuators with their supply as it is."""


class ActuatorTwists(NamedTuple):
    """Twists (N, 3) that actuators bring about, and those that they would with no lag but their own."""

    now: Tensor
    undisturbed: Tensor


class Following(NamedTuple):
    """How actuators follow a command through the pieces of a period.

    Attributes:
        place: of the command in `BaseTwists`; the one before it acts first.
        ends: shares of the period at which its pieces end; the last is 1.
        latency: when the command begins to act.
        added_lag: time constant with which actuators follow it, beyond the lag that they have by themselves.
        transient: what is left of what a sudden change of a setting brings about beyond steady motion.
    """

    place: int
    ends: tuple[float, ...]
    latency: float
    added_lag: float
    transient: Transient = Transient()

    @property
    def shares(self) -> list[float]:
        """Return the share of the period that each piece takes."""
        return [end - start for start, end in pairwise((0.0, *self.ends))]

    def wheels(
        self, twists: BaseTwists, supply: Supply, wheels: ActuatorTwists
    ) -> tuple[list[Tensor], Tensor | None, ActuatorTwists]:
        """Let wheels' speeds follow: the mean twist of each piece, a correction to that of all, twists at the end."""
        new, old = supply(twists.steady(self.place)), supply(twists.steady(self.place + 1))
        targets = [old if end <= self.latency else new for end in self.ends]
        return self._relaxed(twists, supply, wheels, targets, self.added_lag)

    def wheels_at_end(self, twists: BaseTwists, supply: Supply, wheels: ActuatorTwists) -> ActuatorTwists:
        """Return the twists of wheels at the period's end alone: those that `wheels` comes to."""
        new, old = supply(twists.steady(self.place)), supply(twists.steady(self.place + 1))
        moment, (twist, undisturbed) = twists.moment, wheels
        own_lags = moment.conditions.own_lags
        for share, end in zip(self.shares, self.ends, strict=True):
            target = old if end <= self.latency else new
            late = target + (twist - target) * _left_at_last(share, own_lags, self.added_lag)
            twist = late + _by_friction(twist, target, share, moment, self.added_lag)[1]
            late = new + (undisturbed - new) * _left_at_last(share, own_lags)
            undisturbed = late + _by_friction(undisturbed, new, share, moment)[1]
        return ActuatorTwists(twist, undisturbed)

    def settings(
        self, twists: BaseTwists, supply: Supply, setting: Tensor, moving: ActuatorTwists
    ) -> tuple[list[Tensor], Tensor | None, ActuatorTwists]:
        """Let the setting (N, m) of fins or propellers follow, and the motion follow that; returned as by `wheels`."""
        targets: list[Tensor] = []
        for change in self._setting_changes(twists, setting):
            targets += [supply(piece) for piece in change.twists(twists)]
        return self._relaxed(twists, supply, moving, targets, 0.0)

    def settings_at_end(
        self, twists: BaseTwists, supply: Supply, setting: Tensor, moving: ActuatorTwists
    ) -> tuple[Tensor, ActuatorTwists]:
        """Return where the setting (N, m) of fins or propellers has come to at the period's end, and the motion.

        What is between two settings is taken for linear: by then little of the way is left, and nothing new is asked.
        """
        whole = self._replace(ends=(self.latency, 1.0) if 0 < self.latency < 1 else (1.0,))
        own_lags = twists.moment.conditions.own_lags
        twist, undisturbed = moving
        for share, target in zip(whole.shares, whole._targets_between(twists, supply), strict=True):
            twist = target + (twist - target) * _left_at_last(share, own_lags)
        for change in whole._setting_changes(twists, setting):
            setting = change.end
        steady = supply(twists.steady(self.place))
        return setting, ActuatorTwists(twist, steady + (undisturbed - steady) * _left_at_last(1.0, own_lags))

    def _targets_between(self, twists: BaseTwists, supply: Supply) -> Iterator[Tensor]:
        """Yield for each piece the twist (N, 3) of what is left on average of the way from one command to the next."""
        new, old = supply(twists.steady(self.place)), supply(twists.steady(self.place + 1))
        rest = 1.0
        for share, end in zip(self.shares, self.ends, strict=True):
            if end <= self.latency:
                yield old
                continue
            on_average, at_last = left_over(share, self.added_lag)
            yield new + rest * on_average * (old - new)
            rest *= at_last

    def _relaxed(
        self, twists: BaseTwists, supply: Supply, moving: ActuatorTwists, targets: Sequence[Tensor], added_lag: float
    ) -> tuple[list[Tensor], Tensor | None, ActuatorTwists]:
        """Let twists follow targets (N, 3), one a piece, with the actuators' own lag and more.

        The dynamics model's response holds the lag that the actuators have by themselves. It stands where nothing is
        added: the pieces are shifted by what it differs from a lag of first order (and friction, of wheels), or by the
        share of this that is left where settings no longer change suddenly, and what their product lacks is corrected.
        """
        response, new = supply(twists.response(self.place)), supply(twists.steady(self.place))
        twist, reference = moving
        pieces, references = [], []
        for share, target in zip(self.shares, targets, strict=True):
            mean, twist = _followed(twist, target, share, twists.moment, added_lag)
            reference_mean, reference = _followed(reference, new, share, twists.moment)
            pieces.append(mean)
            references.append(reference_mean)
        learned = response - sum(share * piece for share, piece in zip(self.shares, references, strict=True))
        correction = None
        if any(twists.moment.conditions.own_lags):
            undisturbed = composed(zip(self.shares, (piece + learned for piece in references), strict=True))
            correction = response - log_map(undisturbed)
        shares = learned.new_tensor(self.transient.shares)
        acting, going_on = self._when_transients_act(twists.moment.robot.period_s)
        pieces = [piece + shares * act * learned for piece, act in zip(pieces, acting, strict=True)]
        late = self.transient.goes_on * (1 - shares)
        knows_before = self.place + 2 < len(twists.roles)  # of the command before that nothing is known
        if knows_before and (any(going_on) or bool(late.any())):
            before = self._learned_before(twists, supply)
            pieces = [piece + (shares * act + late) * before for piece, act in zip(pieces, going_on, strict=True)]
        return pieces, correction, ActuatorTwists(twist, reference)

    def _when_transients_act(self, period_s: float) -> tuple[list[float], list[float]]:
        """Return how strong over each piece is what a change of command brings about: of the last one, of that before.

        Over a period from when the command begins to act on they average to 1. They fade from then on; or, where they
        die away at once, act over what the period has left.
        """
        starts, lag = [0.0, *self.ends[:-1]], self.transient.lag_s / period_s
        if not lag:
            after = [float(end > self.latency) for end in self.ends] if self.latency < 1 else [1.0] * len(self.ends)
            held = sum(share * acts for share, acts in zip(self.shares, after, strict=True))
            return [acts / held for acts in after], [0.0] * len(after)

        def acted(since: float) -> float:
            since = min(max(since, 0.0), 1.0)
            return math.expm1(-since / lag) / math.expm1(-1 / lag)

        def strengths(begins: float) -> list[float]:
            pieces = zip(starts, self.ends, self.shares, strict=True)
            return [(acted(end - begins) - acted(start - begins)) / share for start, end, share in pieces]

        return strengths(self.latency), strengths(self.latency - 1)

    def _learned_before(self, twists: BaseTwists, supply: Supply) -> Tensor:
        """Return (N, 3) what the change to the command before brought about beyond a lag and friction."""
        start, target = (supply(twists.steady(self.place + back)) for back in (2, 1))
        mean, _ = _followed(start, target, 1.0, twists.moment)
        return supply(twists.response(self.place + 1)) - mean

    def _setting_changes(self, twists: BaseTwists, setting: Tensor) -> Iterator["SettingChange"]:
        """Yield how settings change: towards the command before until the new one acts, then towards that."""
        for at in (self.place + 1, self.place):
            before = at == self.place + 1
            shares = [
                share for share, end in zip(self.shares, self.ends, strict=True) if (end <= self.latency) == before
            ]
            left, rest = [], 1.0
            for share in shares:
                on_average, at_last = left_over(share, self.added_lag)
                left.append(rest * on_average)
                rest *= at_last
            if shares:
                start, target = setting, twists.setting(at)
                setting = target + rest * (start - target)
                yield SettingChange(self, at, start, left, setting)


class SettingChange(NamedTuple):
    """Settings on their way from `start` (N, m) towards the command in a place.

    Attributes:
        following: the period in which they are.
        towards: the place of the command towards which they go.
        start: (N, m) at first.
        left: mean share of the way that is left, over each piece.
        end: (N, m) at last.
    """

    following: Following
    towards: int
    start: Tensor
    left: list[float]
    end: Tensor

    def twists(self, twists: BaseTwists) -> list[Tensor]:
        """Return the mean twist (N, 3) of each piece, of fourth degree in what is left of the way.

        A twist changes smoothly along the way: five settings are asked for, at the Chebyshev points, however many
        pieces there are.
        """
        steady = twists.steady(self.towards)
        if not any(self.left) or torch.equal(self.start, twists.setting(self.towards)):
            return [steady] * len(self.left)
        points = (1 - np.cos(np.linspace(0, np.pi, 5))) / 2
        known = [steady, *(self._on_the_way(twists, float(point)) for point in points[1:])]
        weights = np.linalg.solve(np.vander(points).T, np.vander(self.left, len(points)).T).T
        return [
            sum((float(one) * twist for one, twist in zip(row, known, strict=True)), torch.zeros_like(steady))
            for row in weights
        ]

    def _on_the_way(self, twists: BaseTwists, left: float) -> Tensor:
        """Return the twists (N, 3) under settings held for long, with a share of their way left."""
        period, target = self.following, twists.setting(self.towards)
        way = (period.place, self.towards, left)
        return twists.at_setting(target + left * (self.start - target), way, (period.latency, period.added_lag))


def composed(pieces: Iterable[tuple[float, Tensor]]) -> Tensor:
    """Return the displacements (N, 3) of twists one after the other, each over its share of the period."""
    (share, twist), *others = pieces
    moved = exp_map(twist * share)
    for share, twist in others:
        moved = moved_along(moved, twist, share)
    return moved


def _followed(
    start: Tensor, target: Tensor, share: float, moment: Moment, added_lag: float = 0.0
) -> tuple[Tensor, Tensor]:
    """Return as `_relaxed_twist` does the mean twist (N, 3) and that at the end, of wheels with friction as well."""
    mean, end = _relaxed_twist(start, target, share, moment.conditions.own_lags, added_lag)
    mean_change, end_change = _by_friction(start, target, share, moment, added_lag)
    return mean + mean_change, end + end_change


def _by_friction(
    start: Tensor, target: Tensor, share: float, moment: Moment, added_lag: float = 0.0
) -> tuple[Tensor, Tensor]:
    """Return what friction changes in the twists (N, 3) of wheels over a piece: on average, and at last."""
    friction = moment.conditions.gear_friction_mm_s * moment.robot.period_s
    lag = moment.conditions.own_lags[0] + added_lag
    if friction <= 0 or lag <= 0:
        nothing = torch.zeros_like(target)
        return nothing, nothing
    rolling, aimed = wheel_travel(start, moment.track_mm), wheel_travel(target, moment.track_mm)
    stopped = stopped_by_friction(rolling, aimed, friction, lag, share)
    on_average, at_last = (twist_of_wheels(change, torch.zeros_like(target), moment.track_mm) for change in stopped)
    return on_average, at_last


def _relaxed_twist(
    start: Tensor, target: Tensor, share: float, own_lags: Sequence[float], added_lag: float = 0.0
) -> tuple[Tensor, Tensor]:
    """Return the constant twist that brings vehicles as far as one that goes from `start` to `target`, and its end.

    Each axis goes with its own lag and the added one. The mean, and to second order what it matters that the old twist
    (N, 3) comes first: half the integral of the Lie bracket of earlier and later twists, as Magnus (1954) expands
    g' = g ξ.
    """
    lags = [own + added_lag for own in own_lags]
    if not any(lags):
        return target, target
    late = start - target
    ahead, aside, turn = (_Fading(lag / share, *left_over(share, lag)) for lag in lags)
    on_average, left = start.new_tensor([ahead[1:], aside[1:], turn[1:]]).T
    of_turn = share * start.new_tensor([-turn.order, turn.order])
    of_others = share * start.new_tensor([-aside.order, ahead.order])
    mixed = share * start.new_tensor([-turn.mixed(aside), turn.mixed(ahead)])
    late_others, late_turn = late[:, :2].flip(1), late[:, 2:]
    order = late_turn * (of_turn * target[:, :2].flip(1) + mixed * late_others)
    mean = target + late * on_average
    mean[:, :2] += order - target[:, 2:] * of_others * late_others
    return mean, target + late * left


class _Fading(NamedTuple):
    """How one axis of twists goes over a piece of a period, taken as the unit of time: target + late · exp(−t / lag).

    Of two of them half the integral over s < t of one at s times the other at t, less the same with s and t changed, is
    late · other target · order − target · other late · other order + late · other late · mixed.
    """

    lag: float
    on_average: float
    left: float

    @property
    def order(self) -> float:
        """Half the integral of exp(−s / lag) − exp(−t / lag) over s < t."""
        return (self.lag * (1 + self.left) - 2 * self.lag * self.on_average) / 2

    def mixed(self, other: "_Fading") -> float:
        """Half the integral of exp(−s / lag − t / other lag), less the same with s and t changed, over s < t."""
        together = self.lag * other.lag / (self.lag + other.lag) if self.lag and other.lag else 0.0
        both, _ = left_over(1.0, together)
        return (self.lag * (other.on_average - both) - other.lag * (self.on_average - both)) / 2


def stopped_by_friction(
    start: Tensor, target: Tensor, friction: float, lag: float, share: float
) -> tuple[Tensor, Tensor]:
    """Return what friction changes in how fast wheels roll, (N, 2) mm a period, over a share of a period.

    A wheel follows its motor with a lag of first order, and is slower by its gear's friction either way. Until one that
    is to stop stands, friction brakes it like a motor, and one that is to turn back as if it were to roll the other way
    by twice as much faster: it does not come to its new speed along one exponential, but stands sooner.

    A learned model lets wheels that stand roll a little either way, so that all this changes gradually with the speed
    to come: between half the friction ahead, from where on nothing brakes, and half of it back, from where on it brakes
    twice.

    Args:
        start: (N, 2) at first.
        target: (N, 2) in the long run.
        friction: by which speed it slows a wheel, > 0.
        lag: > 0.
        share: of the period.

    Returns:
        What is added to the mean of target + (start − target) · exp(−t / lag), and to its end.
    """
    direction = start.sign()
    ahead = target * direction  # in the direction in which the wheel rolls
    braked = target - direction * friction * (1 - 2 * ahead / friction).clamp(0.0, 2.0)
    until = direction * ahead.clamp(min=0.0)  # where friction brakes no more: it stands, or is as slow as it is to be
    is_braked = (start != 0) & (ahead < friction / 2) & (start.abs() > until.abs())
    braking = (lag * torch.log(((start - braked) / (until - braked)).clamp(min=1.0))).clamp(max=share)
    left, rest = torch.exp(-braking / lag), share - braking
    way = braked * braking + (start - braked) * lag * (1 - left)
    end = torch.where(rest > 0, until, braked + (start - braked) * left)
    gone_on = torch.exp(-rest / lag)
    way = way + target * rest + (end - target) * lag * (1 - gone_on)
    end = target + (end - target) * gone_on
    on_average, at_last = left_over(share, lag)
    late = start - target
    changes = way / share - target - late * on_average, end - target - late * at_last
    mean_change, end_change = (torch.where(is_braked, change, torch.zeros_like(change)) for change in changes)
    return mean_change, end_change


def _left_at_last(share: float, own_lags: Sequence[float], added_lag: float = 0.0) -> Tensor:
    """Return (3,) what is left of a change of twist at the end of a piece of a period."""
    return torch.tensor([left_over(share, own + added_lag)[1] for own in own_lags], dtype=torch.float64)


def left_over(share: float, lag: float) -> tuple[float, float]:
    """Return what is left of a change followed with a lag over a share of the period: on average, and at last."""
    if lag <= 0:
        return 0.0, 0.0
    left = math.exp(-share / lag)
    return lag / share * (1 - left), left
