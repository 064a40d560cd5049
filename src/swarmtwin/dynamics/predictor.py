"""The one interface of all dynamics models, situation → displacement, and the networks that implement it."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import Protocol, Self

import torch
from torch import Tensor, nn

from swarmtwin.dynamics.mean_variance import MeanVarianceEnsemble
from swarmtwin.dynamics.model_config import ModelConfig
from swarmtwin.dynamics.motion_noise import MotionNoise
from swarmtwin.errors import UserError
from swarmtwin.geometry import wrap_angle
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
        predicted = torch.empty(len(asked), 3, device=asked.command.device)
        with torch.inference_mode():
            for start in range(0, len(asked), self.batch_size):
                rows = slice(start, start + self.batch_size)
                predicted[rows] = self(asked[rows].to(self.device).to(torch.float32))
        return predicted

    @property
    def drawn_members(self) -> int:
        """How many members a vehicle draws one of in a sampled simulation; 0 where the network states no spread."""
        return self.network.members if isinstance(self.network, MeanVarianceEnsemble) else 0

    def moments(self, situation: Situation) -> tuple[Tensor, Tensor]:
        """Return mean and variance of the displacements that a camera measures, as each of M members has them.

        Only a model with `drawn_members` knows them: (M, N, 3) each, float64, calibrated, in mm, mm and rad.
        """
        network = self.network
        assert isinstance(network, MeanVarianceEnsemble)
        asked = situation.only(self.inputs).to(self.device).to(torch.float32)
        with torch.inference_mode():
            mean, variance = (part.double() for part in network.moments(self.encoding(asked)))
            scale = self.output_scaling.scale
            moments = self.output_scaling.inverse(mean), variance * (scale * network.spread_factor) ** 2
            return moments[0].to(situation.command.device), moments[1].to(situation.command.device)

    def sample(self, situation: Situation, rng: torch.Generator, member: Tensor | None = None) -> Tensor:
        """Draw displacements (N, 3), float64, around the expected ones; the camera's noise is not among it.

        Args:
            situation: of N vehicles.
            rng: of all that is drawn.
            member: (N,) of a model with `drawn_members`, who answers for each vehicle; −1: the distribution that has
                mean and variance of all members together. None: each vehicle draws a member.

        Raises:
            UserError: the spread is not known.
        """
        if not self.drawn_members:
            return super().sample(situation, rng)
        mean, variance = self.moments(situation)
        together = variance.mean(dim=0) + mean.var(dim=0, correction=0)
        mean, variance = torch.cat([mean, mean.mean(dim=0)[None]]), torch.cat([variance, together[None]])
        count = len(situation)
        if member is None:
            member = torch.randint(self.drawn_members, (count,), generator=rng, device=rng.device).to(mean.device)
        row = torch.arange(count, device=mean.device)
        camera = mean.new_tensor(self.motion_noise.camera if self.motion_noise else (0.0, 0.0, 0.0))
        of_motion = (variance[member, row] - 2 * camera).clamp(min=0.0)  # two poses were measured, each with its noise
        drawn = torch.randn(count, 3, generator=rng, dtype=mean.dtype, device=rng.device).to(mean.device)
        moved = mean[member, row] + of_motion.sqrt() * drawn
        return torch.cat([moved[:, :2], wrap_angle(moved[:, 2:])], dim=-1)
