"""Only the spread of the motion changed: a rougher ground, busier water."""

from typing import ClassVar, Literal

from swarmtwin.simulation.mechanism import Mechanism, Parameter


class Config(Mechanism):
    """The random part of the motion is `factor` times as large; its mean is as ever, the camera's noise as well."""

    stage: ClassVar = "body"
    words: ClassVar = "the motion is {factor} times as random"
    remedy: ClassVar = "look for a rougher ground, loose parts or busier water"
    parameters: ClassVar = {"factor": Parameter(0.1, 6.0, 1.0, "", (1.0,))}

    name: Literal["noise_change"] = "noise_change"
    factor: float

    def noise_factor(self) -> float:
        """Return the factor on the random part of the motion."""
        return self.factor
