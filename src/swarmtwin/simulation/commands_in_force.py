"""Commands that act late and gradually on a vehicle with momentum: what is in force is their mean over each period.

A dynamics model that looks at velocity is asked for a mean of the settings that its actuators pass through, after one
of those of the period before. Where momentum is large, settings accelerate: v̄ = v₀ + ∫ (1 − s) a(s) ds over a period
of length 1, so early ones count more in how far it leads; and v₁ = v̄ + ∫ s a(s) ds, so late ones of the period before
do in what its mean velocity says of its end. What steers acts at once, and counts alike. Times are in periods.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Self

import torch
from torch import Tensor

from swarmtwin.robot import Robot
from swarmtwin.simulation.mechanism import Mechanism
from swarmtwin.simulation.relaxation import left_over


class Delays(NamedTuple):
    """When a command begins to act, and the time constant with which actuators follow it."""

    latency: float
    lag: float

    @classmethod
    def of(cls, mechanisms: Sequence[Mechanism], period_s: float) -> Self:
        """Sum up what mechanisms delay."""
        latency_s = sum(mechanism.latency_s() for mechanism in mechanisms)
        return cls(min(latency_s / period_s, 1.0), sum(mechanism.added_lag_s() for mechanism in mechanisms) / period_s)


class InForce(NamedTuple):
    """Settings (N, m) of the actuators in a period: their mean, early ones or late ones counting more, and the last."""

    mean: Tensor
    early: Tensor
    late: Tensor
    end: Tensor

    @classmethod
    def at_rest(cls, command: Tensor) -> Self:
        """Return what a command (N, m) that is held for long leaves."""
        return cls(command, command, command, command)

    @classmethod
    def after_two(cls, previous: Tensor, earlier: Tensor, delays: Delays) -> Self:
        """Return what one command (N, m) leaves after another that was held for long."""
        return cls.at_rest(earlier).followed_by(previous, earlier, delays)

    def followed_by(self, command: Tensor, previous: Tensor, delays: Delays) -> Self:
        """Return the period after, in which a command (N, m) is sent, and the previous one acts until then."""
        mean, early, late, setting = *(torch.zeros_like(command) for _ in range(3)), self.end
        pieces = ((previous, 0.0, delays.latency), (command, delays.latency, 1.0))
        for target, begins, ends in pieces:
            share, middle = ends - begins, (begins + ends) / 2
            if share > 0:
                on_average, at_last = left_over(share, delays.lag)
                piece = share * (target + (setting - target) * on_average)
                mean, early, late = mean + piece, early + 2 * (1 - middle) * piece, late + 2 * middle * piece
                setting = target + (setting - target) * at_last
        return type(self)(mean, early, late, setting)

    @classmethod
    def of_memory(cls, memory: Mapping[str, Tensor]) -> Self | None:
        """Return what `memory` of it holds, if anything."""
        names = [f"setting: {name}" for name in cls._fields]
        return cls(*(memory[name] for name in names)) if names[0] in memory else None

    def memory(self) -> dict[str, Tensor]:
        """Return it by names."""
        return {f"setting: {name}": values for name, values in self._asdict().items()}


def late_or_gradual(mechanisms: Sequence[Mechanism]) -> list[Mechanism]:
    """Return the mechanisms that say when commands act."""
    return [mechanism for mechanism in mechanisms if mechanism.latency_s() > 0 or mechanism.added_lag_s() > 0]


def commands_for(robot: Robot, before: InForce, now: InForce) -> tuple[Tensor, Tensor, Tensor]:
    """Return the commands (N, m) to ask a model with momentum for: of this period, and twice of the one before."""
    steers = torch.tensor([name == robot.actuation.steering for name in robot.command_columns])
    previous = torch.where(steers, before.mean, before.late)
    return torch.where(steers, now.mean, now.early), previous, previous
