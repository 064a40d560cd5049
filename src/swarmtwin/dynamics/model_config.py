"""What every model's configuration has in common; each model file ends in its own kind of it."""

from typing import Annotated, ClassVar

from pydantic import Field
from torch import nn

from swarmtwin.dynamics.scaling import ScalingMethod
from swarmtwin.robot import Positive, Robot, SituationPart, StrictModel


class ModelConfig(StrictModel):
    """The configuration of a dynamics model, as in its `conf/model/<name>.yaml`.

    Attributes:
        name: the model's name, that of its file.
        learning_rate: its own largest learning rate, for recipes that leave it open.
        steps: its own number of optimiser steps, likewise, rounded up to whole epochs.
        situation: the parts it is given; null: those the robot's file names.
        scaling: how its inputs and outputs are scaled.
    """

    scaling: ClassVar[ScalingMethod]

    name: str
    learning_rate: Positive
    steps: Annotated[int, Field(ge=1)]
    situation: tuple[SituationPart, ...] | None = None

    def build(self, robot: Robot, inputs: int) -> nn.Module:
        """Build the network: scaled inputs (N, inputs) → scaled displacements (N, 3).

        Raises:
            UserError: the model does not fit this robot.
        """
        raise NotImplementedError
