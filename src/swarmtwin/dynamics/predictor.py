"""The one interface of all dynamics models, situation → displacement, and the networks that implement it."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import Protocol, Self

import torch
from torch import Tensor, nn

from swarmtwin.dynamics.model_config import ModelConfig
from swarmtwin.dynamics.motion_noise import MotionNoise
from swarmtwin.errors import UserError
from swarmtwin.learning.encoding import Scaling
from swarmtwin.learning.situation import Situation
from swarmtwin.robot import Arena, Robot, SituationPart


class OneStepModel(Protocol):
    """What predicts one robot's motion over a period from a measured situation: dynamics models and simulations.

    Attributes:
        robot: the robot whose motion it predicts.
        inputs: the parts of a situation that it looks at; a situation must hold these, others are not looked at.
    """

    robot: Robot
    inputs: tuple[SituationPart, ...]

    def predict(self, situation: Situation) -> Tensor:
        """Return the expected displacements (N, 3), forward_mm, left_mm, turn_rad in the vehicles' frames at the start.

        They carry no gradients and lie on the situation's device.
        """


class DynamicsModel(OneStepModel, Protocol):
    """A learned one-step model, equation (1) of the paper: a distribution over displacements given a situation."""

    def sample(self, situation: Situation, rng: torch.Generator) -> Tensor:
        """Draw displacements (N, 3) from the distribution around the expected ones; all randomness is from `rng`."""


class DynamicsModule(nn.Module):
    """A dynamics model with weights whose spread is that of `motion_noise`; a kind of it adds `predict`.

    Attributes:
        robot: the robot whose motion it predicts.
        inputs: the parts of a situation that it looks at.
        motion_noise: the random part of motion and camera, estimated from transitions it was not fitted to; None where
            nobody did.
    """

    robot: Robot
    inputs: tuple[SituationPart, ...]
    motion_noise: MotionNoise | None = None

    @abstractmethod
    def predict(self, situation: Situation) -> Tensor:
        """Return the expected displacements (N, 3)."""

    def sample(self, situation: Situation, rng: torch.Generator) -> Tensor:
        """Draw displacements (N, 3), float64, around the expected ones; the camera's noise is not among it.

        Raises:
            UserError: the spread is not known.
        """
        if self.motion_noise is None:
            raise UserError(f"the spread of this dynamics model of {self.robot.name!r} is not known: train it anew")
        return self.motion_noise.sample(self.predict(situation).double(), rng)


class NetworkDynamics(DynamicsModule):
    """A network with the encoding of its inputs and the scaling of its outputs: a saved one needs nothing beside it.

    Attributes:
        robot: the robot whose motion it predicts.
        config: the model's configuration.
        inputs: the parts of a situation that it looks at.
        batch_size: the most situations that `predict` passes through the network at a time.
    """

    batch_size: int = 2048

    def __init__(self, robot: Robot, config: ModelConfig) -> None:
        super().__init__()
        self.robot = robot
        self.config = config
        self.inputs = config.inputs(robot)
        self.encoding = config.encoding(robot)
        self.network = config.build(robot, self.encoding.width)
        self.output_scaling = Scaling(3, config.scaling)

    @classmethod
    def with_weights(cls, robot: Robot, config: ModelConfig, weights: Mapping[str, Tensor]) -> Self:
        """Build a trained model from its weights and scalings, ready to predict; no random number is drawn.

        Raises:
            RuntimeError: names or shapes of the weights are not the model's.
        """
        with torch.random.fork_rng(devices=[]):
            dynamics = cls(robot, config)
        dynamics.load_state_dict(weights)
        return dynamics.eval()

    @property
    def device(self) -> torch.device:
        """Where the weights lie."""
        return next(self.buffers()).device

    def learn_scaling(self, situation: Situation, displacement: Tensor, arena_mm: Arena | None = None) -> None:
        """Take both scalings from the training split: N situations, their displacements (N, 3), and their arena."""
        self.encoding.learn(situation, arena_mm)
        self.output_scaling.learn(displacement)

    def forward(self, situation: Situation) -> Tensor:
        """Predict displacements (N, 3), with gradients, of situations on the weights' device."""
        return self.output_scaling.inverse(self.network(self.encoding(situation)))

    def predict(self, situation: Situation) -> Tensor:
        """Return the expected displacements (N, 3), without gradients, on the situation's device."""
        asked = situation.only(self.inputs)
        starts = range(0, max(len(asked), 1), self.batch_size)
        with torch.inference_mode():
            parts = (asked[start : start + self.batch_size].to(self.device).to(torch.float32) for start in starts)
            batches = [self(part) for part in parts]
            return torch.cat(batches).to(asked.command.device)
