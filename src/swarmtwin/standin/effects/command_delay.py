"""The command acts late: a slow network or controller."""

from typing import Annotated, Self

from pydantic import Field

from swarmtwin.errors import UserError
from swarmtwin.robot import Robot
from swarmtwin.standin.effect import Effect


class CommandDelay(Effect):
    """The command before goes on for a while after each new one is sent.

    Attributes:
        delay_s: how long; at most one period.
    """

    delay_s: Annotated[float, Field(gt=0)] = 0.15

    def on(self, robot: Robot, vehicle_count: int) -> Self:
        """Refuse a delay beyond a period."""
        if self.delay_s > robot.period_s:
            raise UserError(
                f"effect 'command_delay': delay_s {self.delay_s:g} is longer than the period of {robot.name!r}: "
                f"give at most {robot.period_s:g}"
            )
        return self

    def lateness_s(self) -> float:
        """Let each command arrive late."""
        return self.delay_s
