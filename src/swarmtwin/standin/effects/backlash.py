"""Travel is lost when an actuator reverses: worn gears."""

from typing import Annotated, Self

from pydantic import Field

from swarmtwin.robot import Robot
from swarmtwin.standin.effect import Effect, only_for


class Backlash(Effect):
    """A gear has play: after each reversal the actuator turns idly until the play is taken up.

    Attributes:
        travel_mm: for wheels: play at the rim; 5 where none is given.
        travel_rad: for a fin: play of its joint; 0.15 where none is given.
    """

    travel_mm: Annotated[float, Field(gt=0, le=40)] | None = None
    travel_rad: Annotated[float, Field(gt=0, le=1)] | None = None

    def on(self, robot: Robot, vehicle_count: int) -> Self:
        """Fill in the default of the robot's kind of actuator; refuse the other kind's parameter."""
        only_for("backlash", robot, ("travel_mm", self.travel_mm), ("travel_rad", self.travel_rad))
        if robot.actuation.kind == "thrust":
            return self.model_copy(update={"travel_rad": 0.15 if self.travel_rad is None else self.travel_rad})
        return self.model_copy(update={"travel_mm": 5.0 if self.travel_mm is None else self.travel_mm})

    def backlash(self) -> float:
        """Lose travel, mm or rad."""
        return self.travel_mm or self.travel_rad or 0.0
