"""Actuators that follow a command late and gradually, within one control period.

Twists are per nominal period: (N, 3) forward_mm, left_mm, turn_rad. Times are in periods.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from swarmtwin.simulation.arcs import exp_map, log_map, moved_along
from swarmtwin.simulation.base_twists import BaseTwists
from swarmtwin.simulation.relaxation import followed, left_at_last, left_over
from swarmtwin.simulation.supply import Supply
from swarmtwin.simulation.transient import Transient


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
        for share, end in zip(self.shares, self.ends, strict=True):
            twist = followed(twist, old if end <= self.latency else new, share, moment, self.added_lag)[1]
            undisturbed = followed(undisturbed, new, share, moment)[1]
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
            twist = target + (twist - target) * left_at_last(share, own_lags)
        for change in whole._setting_changes(twists, setting):
            setting = change.end
        steady = supply(twists.steady(self.place))
        return setting, ActuatorTwists(twist, steady + (undisturbed - steady) * left_at_last(1.0, own_lags))

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
            mean, twist = followed(twist, target, share, twists.moment, added_lag)
            reference_mean, reference = followed(reference, new, share, twists.moment)
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
        mean, _ = followed(start, target, 1.0, twists.moment)
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
        known = [steady, *self._on_the_way(twists, [float(point) for point in points[1:]])]
        weights = np.linalg.solve(np.vander(points).T, np.vander(self.left, len(points)).T).T
        return [
            sum((float(one) * twist for one, twist in zip(row, known, strict=True)), torch.zeros_like(steady))
            for row in weights
        ]

    def _on_the_way(self, twists: BaseTwists, left: Sequence[float], near: float = 0.01) -> list[Tensor]:
        """Return the twists (N, 3) under settings held for long, with shares of their way left, the last one all of it.

        By the end of a period little is left of the way to its command, as a rule. Then the new way begins `near` that
        command's own setting, as a share of the longest way, and is asked for from there, which is the same whatever
        lags; by what else is left the twists change in proportion.
        """
        before = self.following.place + 1
        target, ahead = twists.setting(self.towards), twists.setting(before)
        longest = (twists.setting(before - 1) - ahead).abs().amax(dim=0).clamp(min=1e-9)
        beyond = float(((self.start - ahead).abs() / longest).amax())
        if beyond > near:
            return [self._asked(twists, target, share) for share in left]
        more = self._asked(twists, target, 1.0) - twists.steady(before) if beyond else 0.0
        return [twists.between(before, self.towards, share) + share * more for share in left]

    def _asked(self, twists: BaseTwists, target: Tensor, left: float) -> Tensor:
        period = self.following
        way = (period.place, self.towards, left)
        return twists.at_setting(target + left * (self.start - target), way, (period.latency, period.added_lag))


def composed(pieces: Iterable[tuple[float, Tensor]]) -> Tensor:
    """Return the displacements (N, 3) of twists one after the other, each over its share of the period."""
    (share, twist), *others = pieces
    moved = exp_map(twist * share)
    for share, twist in others:
        moved = moved_along(moved, twist, share)
    return moved
