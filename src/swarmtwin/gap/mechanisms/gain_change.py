"""All actuators are stronger or weaker: wheel radius, supply."""

from typing import ClassVar, Literal

import torch
from torch import Tensor

from swarmtwin.gap.mechanism import Drive, Mechanism, Quantity


class Config(Mechanism):
    """The speed of every actuator is multiplied by `gain`."""

    words: ClassVar = "every actuator runs at {gain} times its speed"
    remedy: ClassVar = "check supply voltage, wheel diameter or propeller; or learn the simulation anew"
    quantities: ClassVar = {"gain": Quantity(0.2, 2.5, 1.0, "", (1.0,))}

    name: Literal["gain_change"] = "gain_change"
    gain: float

    def strength(self, drive: Drive) -> Tensor:
        """Multiply."""
        return torch.full((1, 1), self.gain, dtype=torch.float64)
