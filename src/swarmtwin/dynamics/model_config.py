"""What every model's configuration has in common; each model file ends in its own kind of it."""

from abc import abstractmethod
from typing import Annotated, ClassVar

from pydantic import Field, field_validator
from torch import nn

from swarmtwin.dynamics import models
from swarmtwin.learning.batches import Examples
from swarmtwin.learning.encoding import Encoding, ScalingMethod
from swarmtwin.plugins import PluginRegistry
from swarmtwin.robot import Positive, Robot, SituationPart, StrictModel

Steps = Annotated[int, Field(ge=1)]
Width = Annotated[int, Field(ge=1)]
Widths = Annotated[tuple[Width, ...], Field(min_length=1)]


class ModelConfig(StrictModel):
    """The configuration of a dynamics model, as in its `conf/model/<name>.yaml`.

    A model that gives a field a default states its type again as it stands here: the limits are part of the type.

    Attributes:
        name: the model's name, that of its file.
        learning_rate: its own largest learning rate, for recipes that leave it open.
        steps: its own number of optimiser steps, likewise, rounded up to whole epochs.
        situation: the parts it is given; null: those the robot's file names.
        wall_reaches: where it is given the pose, how far the arena's walls are looked for beside it, in shorter sides
            of the arena (`learning.encoding`); none, as in the paper, for the pose alone.
        scaling: how its inputs and outputs are scaled.
    """

    scaling: ClassVar[ScalingMethod]

    name: str
    learning_rate: Positive
    steps: Steps
    situation: tuple[SituationPart, ...] | None = None
    wall_reaches: tuple[Positive, ...] = ()

    @field_validator("situation")
    @classmethod
    def _with_command(cls, situation: tuple[SituationPart, ...] | None) -> tuple[SituationPart, ...] | None:
        if situation is not None and "command" not in situation:
            raise ValueError("situation must contain 'command', or be null for that of the robot's file")
        return situation

    def inputs(self, robot: Robot) -> tuple[SituationPart, ...]:
        """Return the parts of a situation that the model looks at."""
        return self.situation or robot.situation

    def encoding(self, robot: Robot) -> Encoding:
        """Return what turns situations into the network's inputs."""
        return Encoding.for_network(robot, self.inputs(robot), self.scaling, self.wall_reaches)

    @abstractmethod
    def build(self, robot: Robot, inputs: int) -> nn.Module:
        """Build the network: scaled inputs (N, inputs) → scaled displacements (N, 3).

        Raises:
            UserError: the model does not fit this robot.
        """


class FittedModelConfig(ModelConfig):
    """The configuration of a model that is fitted in one go, not by gradient steps: no recipe has a say in it."""

    @abstractmethod
    def fit(self, network: nn.Module, train: Examples, validation: Examples, seed: int) -> None:
        """Fit what `build` made to the scaled examples of the training split, on the CPU.

        Args:
            network: to fit.
            train: to fit it to.
            validation: to choose by, where there is something to choose.
            seed: of all that is drawn.
        """


MODELS: PluginRegistry[ModelConfig] = PluginRegistry(models, "dynamics model", group="model")

model_names = MODELS.names
config_class = MODELS.plugin_class
model_config = MODELS.config
