"""The marker is off the centre of rotation."""

from typing import Annotated

from pydantic import Field

from swarmtwin.standin.effect import Effect


class MarkerOffset(Effect):
    """The camera sees a point beside the one that the vehicle turns about.

    Attributes:
        forward_mm: how far ahead of it.
        left_mm: how far to the left of it.
    """

    forward_mm: Annotated[float, Field(ge=-100, le=100)] = 8.0
    left_mm: Annotated[float, Field(ge=-100, le=100)] = 0.0

    def marker(self) -> tuple[float, float, float]:
        """Shift the marker on the vehicle."""
        return self.forward_mm, self.left_mm, 0.0
