"""Everything weakens as the session goes on: the battery runs down."""

from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from swarmtwin.standin.effect import Effect, Placement


class BatterySag(Effect):
    """The speed of wheels or fin falls from full at the session's beginning: 1 − loss · progress^shape.

    Attributes:
        loss: share of the speed that is lost by the session's end.
        shape: 1 falls steadily, more than 1 late, less than 1 early.
    """

    ages: ClassVar[bool] = True

    loss: Annotated[float, Field(gt=0, lt=1)] = 0.3
    shape: Annotated[float, Field(ge=0.2, le=5)] = 1.0

    def strength(self, placement: Placement) -> np.ndarray:
        """Weaken every actuator with the session's progress."""
        return 1.0 - self.loss * placement.progress**self.shape
