"""Wheels turn more slowly backwards than forwards, as a worn brush in a motor makes them."""

from typing import ClassVar, Literal

import torch

from swarmtwin.simulation.mechanism import Mechanism, Parameter


class Config(Mechanism):
    """Efforts below 0 are made smaller by the share `loss`."""

    stage: ClassVar = "controller"
    words: ClassVar = "wheels turn more slowly backwards, by a share of {loss}"
    remedy: ClassVar = "replace the motors' brushes"
    parameters: ClassVar = {"loss": Parameter(0.0, 0.8, 0.0, "", (0.2,))}

    name: Literal["weak_reverse"] = "weak_reverse"
    loss: float

    def transform_command(self, command, moment):
        return torch.where(command < 0, command * (1 - self.loss), command)
