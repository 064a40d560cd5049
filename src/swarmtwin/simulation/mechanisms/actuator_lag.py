"""Speed follows the command gradually: tired motors, a slow controller."""

import math
from collections.abc import Mapping
from typing import ClassVar, Literal

from swarmtwin.robot import Robot, SituationPart
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.mechanism import Mechanism, Parameter


class Config(Mechanism):
    """Actuators follow to first order: what is left of the old speed decays with an additional `time_constant_s`.

    Wheels: their speed lags, beyond the lag that the reference shows by itself. Thrust: the setting of fin or propeller
    lags, so that something between both commands holds for a while. A fin that is thrown from one mean angle to another
    pushes the vehicle as it goes, which the reference holds, and less the slower it goes: by own / (own + added).

    Attributes:
        time_constant_s: the added one.
        own_time_constant_s: with which the setting of thrust follows in the reference; None: so slowly that an added
            lag leaves what a sudden change brings about as it was.
    """

    stage: ClassVar = "actuators"
    words: ClassVar = "actuators follow with an additional time constant of {time_constant_s}"
    remedy: ClassVar = "check motors and gears for wear, or lower the controller's smoothing"
    parameters: ClassVar = {"time_constant_s": Parameter(0.0, 1.0, 0.0, "s", (0.1,))}
    inputs: ClassVar[tuple[SituationPart, ...]] = ("previous_command", "earlier_command")
    says_when: ClassVar = True

    name: Literal["actuator_lag"] = "actuator_lag"
    time_constant_s: float
    own_time_constant_s: float | None = None

    @classmethod
    def suits(cls, robot: Robot, conditions: SessionConditions) -> bool:
        """Know what lags: a speed or a setting."""
        return robot.actuation.kind != "unknown"

    @classmethod
    def parameters_of(cls, robot: Robot, conditions: SessionConditions) -> Mapping[str, Parameter]:
        """Allow a period at most, and as much of thrust's own."""
        period_s = robot.period_s
        begin = (0.1 * period_s, 0.35 * period_s)
        added = {"time_constant_s": Parameter(0.0, period_s, 0.0, "s", begin, 0.01 * period_s)}
        if robot.actuation.kind != "thrust":
            return added
        own = Parameter(0.0, period_s, None, "s", (0.25 * period_s,), 0.01 * period_s, doubted_ends="none")
        return {**added, "own_time_constant_s": own}

    def added_lag_s(self) -> float:
        """Return the time constant."""
        return self.time_constant_s

    def share_of_transient(self) -> float:
        """Return by what the speed of a change of setting falls."""
        if self.own_time_constant_s is None or self.time_constant_s <= 0:
            return 1.0
        return self.own_time_constant_s / (self.own_time_constant_s + self.time_constant_s)

    def breakpoints(self, robot: Robot) -> tuple[float, ...]:
        """Look at thrust after each eighth of the change of its setting."""
        if robot.actuation.kind == "wheel":
            return ()
        lag = self.time_constant_s / robot.period_s
        return (*(lag * math.log(8 / left) for left in range(7, 0, -1)), 5 * lag)
