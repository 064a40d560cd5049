"""How speeds go gradually from one value to another: with a lag of first order, and as friction lets them.

Twists are per nominal period: (N, 3) forward_mm, left_mm, turn_rad. Times are in periods.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from swarmtwin.compilable import can_pass_over
from swarmtwin.simulation.efforts import twist_of_wheels, wheel_travel
from swarmtwin.simulation.mechanism import Moment


def followed(
    start: Tensor, target: Tensor, share: float, moment: Moment, added_lag: float = 0.0
) -> tuple[Tensor, Tensor]:
    """Return as `relaxed_twist` does the mean twist (N, 3) and that at the end, of wheels with friction as well."""
    mean, end = relaxed_twist(start, target, share, moment.conditions.own_lags, added_lag)
    friction = moment.conditions.gear_friction_mm_s * moment.robot.period_s
    lag = moment.conditions.own_lags[0] + added_lag
    if friction <= 0 or lag <= 0:
        return mean, end
    rolling, aimed = wheel_travel(start, moment.track_mm), wheel_travel(target, moment.track_mm)
    stopped = stopped_by_friction(rolling, aimed, friction, lag, share)
    on_average, at_last = (twist_of_wheels(change, torch.zeros_like(target), moment.track_mm) for change in stopped)
    return mean + on_average, end + at_last


def relaxed_twist(
    start: Tensor, target: Tensor, share: float, own_lags: Sequence[float], added_lag: float = 0.0
) -> tuple[Tensor, Tensor]:
    """Return the constant twist that brings vehicles as far as one that goes from `start` to `target`, and its end.

    Each axis goes with its own lag and the added one. The mean, and to second order what it matters that the old twist
    (N, 3) comes first: half the integral of the Lie bracket of earlier and later twists, as Magnus (1954) expands
    g' = g ξ.
    """
    lags = tuple(own + added_lag for own in own_lags)
    if not any(lags):
        return target, target
    course = _Course.of(share, lags)
    if can_pass_over(start, target) and start.shape == target.shape:
        from swarmtwin.simulation import compiled_relaxation

        tables = (one.contiguous().numpy() for one in (start, target))
        mean, end = compiled_relaxation.relaxed_twist(*tables, *course)
        return torch.from_numpy(mean), torch.from_numpy(end)
    on_average, left, of_turn, of_others, mixed = (start.new_tensor(part) for part in course)
    late = start - target
    late_others, late_turn = late[:, :2].flip(1), late[:, 2:]
    order = late_turn * (of_turn * target[:, :2].flip(1) + mixed * late_others)
    mean = target + late * on_average
    mean[:, :2] += order - target[:, 2:] * of_others * late_others
    return mean, target + late * left


class _Course(NamedTuple):
    """How all axes of twists go over a piece of a period, as `compiled_relaxation.relaxed_twist` takes it."""

    on_average: np.ndarray
    left: np.ndarray
    of_turn: np.ndarray
    of_others: np.ndarray
    mixed: np.ndarray

    @classmethod
    @lru_cache(maxsize=512)
    def of(cls, share: float, lags: tuple[float, float, float]) -> "_Course":
        """Return it for a share of the period and the axes' lags."""
        ahead, aside, turn = (_Fading(lag / share, *left_over(share, lag)) for lag in lags)
        return cls(
            np.array([ahead.on_average, aside.on_average, turn.on_average]),
            np.array([ahead.left, aside.left, turn.left]),
            share * np.array([-turn.order, turn.order]),
            share * np.array([-aside.order, ahead.order]),
            share * np.array([-turn.mixed(aside), turn.mixed(ahead)]),
        )


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


def left_at_last(share: float, own_lags: Sequence[float], added_lag: float = 0.0) -> Tensor:
    """Return (3,) what is left of a change of twist at the end of a piece of a period."""
    return torch.tensor([left_over(share, own + added_lag)[1] for own in own_lags], dtype=torch.float64)


def left_over(share: float, lag: float) -> tuple[float, float]:
    """Return what is left of a change followed with a lag over a share of the period: on average, and at last."""
    if lag <= 0:
        return 0.0, 0.0
    left = math.exp(-share / lag)
    return lag / share * (1 - left), left
