"""Only the spread of the motion changed: a rougher ground, busier water."""

from typing import Annotated

from pydantic import Field

from swarmtwin.standin.effect import Effect


class NoiseChange(Effect):
    """The random part of the motion is larger or smaller, its mean is as ever; the camera's noise is not touched.

    Attributes:
        factor: on its standard deviation.
    """

    factor: Annotated[float, Field(gt=0, le=5)] = 1.8

    def noise_factor(self) -> float:
        """Multiply the random part of the motion."""
        return self.factor
