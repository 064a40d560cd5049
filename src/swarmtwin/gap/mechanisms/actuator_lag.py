"""Speed follows the command gradually: tired motors, a slow controller."""

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import ClassVar, Literal

import torch
from torch import Tensor

from swarmtwin.dynamics.twist import displacement_of, twist_of
from swarmtwin.gap.mechanism import Drive, Mechanism, Quantity, Responses
from swarmtwin.geometry import compose
from swarmtwin.robot import Robot, SituationPart

STEPS = 8


class Config(Mechanism):
    """Speeds follow with an additional first-order lag: what is left of the old speed decays with `time_constant_s`.

    Wheels: their speed lags, beyond the lag that they have by themselves, which shows in the base's answer to a change
    of command; integrated in steps, and what the command before the previous one has left is taken along. Thrust: the
    setting lags, so that for a part of the period something between both commands holds.
    """

    words: ClassVar = "actuators follow with an additional time constant of {time_constant_s}"
    remedy: ClassVar = "check motors and gears for wear, or lower the controller's smoothing"
    quantities: ClassVar = {"time_constant_s": Quantity(0.0, 1.0, 0.0, "s", (0.1,))}
    needs: ClassVar[tuple[SituationPart, ...]] = ("previous_command", "earlier_command")
    uses_history: ClassVar = True
    widening: ClassVar = 1.8
    leaves: ClassVar = 0.3

    name: Literal["actuator_lag"] = "actuator_lag"
    time_constant_s: float

    @classmethod
    def quantities_of(cls, robot: Robot) -> Mapping[str, Quantity]:
        """Allow a period at most."""
        period_s = robot.period_s
        starts = (0.1 * period_s, 0.35 * period_s)
        return {"time_constant_s": Quantity(0.0, period_s, 0.0, "s", starts, 0.01 * period_s)}

    def gradual(self, drive: Drive) -> list[tuple[float, float]]:
        """Let a setting of thrust decay from the old command to the new one."""
        if drive.robot.actuation.kind == "wheel":
            return []
        lag = max(self.time_constant_s / drive.robot.period_s, 1e-9)
        ends = (0.0, 0.7 * lag, 2 * lag, 5 * lag)
        parts = []
        for start, end in pairwise(min(end, 1.0) for end in ends):
            if end > start:
                left = lag * (math.exp(-start / lag) - math.exp(-end / lag)) / (end - start)
                parts.append((end - start, left))
        return parts

    def delivered(self, responses: Responses, drive: Drive) -> Responses:
        """Let wheels go from the old speed to the new one, step by step."""
        if drive.robot.actuation.kind != "wheel":
            return responses
        own = max(drive.surroundings.own_lag, 1e-3)
        slower = self._integrated(responses, own + self.time_constant_s / drive.robot.period_s)
        return responses._replace(now=responses.now + slower - self._integrated(responses, own))

    def _integrated(self, responses: Responses, lag: float) -> Tensor:
        """Return the way (N, 3) with a lag, in periods."""
        at_start = responses.before + (responses.earlier - responses.before) * math.exp(-1 / lag)
        late = at_start - responses.settled
        moved = torch.zeros_like(responses.now)
        for step in range(STEPS):
            left = lag * (math.exp(-step / STEPS / lag) - math.exp(-(step + 1) / STEPS / lag))
            moved = compose(moved, displacement_of(responses.settled / STEPS + late * left))
        return twist_of(moved)
