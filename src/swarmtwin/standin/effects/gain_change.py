"""All actuators are stronger or weaker: other wheels, another supply."""

from typing import Annotated

from pydantic import Field

from swarmtwin.standin.effect import Effect, Placement


class GainChange(Effect):
    """The speed of wheels or fin is multiplied.

    Attributes:
        gain: factor on the speed.
    """

    gain: Annotated[float, Field(gt=0, le=3)] = 0.85

    def strength(self, placement: Placement) -> float:
        """Multiply the speed of every actuator."""
        return self.gain
