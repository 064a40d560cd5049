"""The scale changes with the distance from the image's centre."""

from typing import Annotated

import numpy as np
from pydantic import Field

from swarmtwin.standin.effect import Effect


class LensDistortion(Effect):
    """Measured positions are moved radially: r (1 + coefficient · r²), r = 1 at the arena's corners.

    Attributes:
        coefficient: positive is a pincushion, negative a barrel.
    """

    coefficient: Annotated[float, Field(ge=-0.3, le=0.5)] = 0.12

    def magnification(self, radius: np.ndarray) -> np.ndarray:
        """Scale what is far from the centre more."""
        return 1.0 + self.coefficient * radius**2
