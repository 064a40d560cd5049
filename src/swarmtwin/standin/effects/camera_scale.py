"""Millimetres per pixel are wrong: the camera was moved or badly calibrated."""

from typing import Annotated

import numpy as np
from pydantic import Field

from swarmtwin.standin.effect import Effect


class CameraScale(Effect):
    """Measured positions are scaled about the arena's centre; headings are not.

    Attributes:
        scale: measured over true distance.
    """

    scale: Annotated[float, Field(ge=0.5, le=2)] = 1.06

    def magnification(self, radius: np.ndarray) -> float:
        """Scale all distances alike."""
        return self.scale
