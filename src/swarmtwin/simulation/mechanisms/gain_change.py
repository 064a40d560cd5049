"""All actuators are stronger or weaker: wheel radius, supply."""

from typing import ClassVar, Literal

import torch
from torch import Tensor

from swarmtwin.simulation.mechanism import Mechanism, Moment, Parameter


class Config(Mechanism):
    """The speed of every actuator is multiplied by `gain`."""

    stage: ClassVar = "supply"
    words: ClassVar = "every actuator runs at {gain} times its speed"
    remedy: ClassVar = "check supply voltage, wheel diameter or propeller; or learn the simulation anew"
    parameters: ClassVar = {"gain": Parameter(0.2, 2.5, 1.0, "", (1.0,))}

    name: Literal["gain_change"] = "gain_change"
    gain: float

    def supply_gain(self, moment: Moment) -> Tensor:
        """Return the gain of all actuators."""
        return torch.full((1, 1), self.gain, dtype=torch.float64)
