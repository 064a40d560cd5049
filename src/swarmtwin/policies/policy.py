"""A policy: what one vehicle observes goes in, its command comes out."""

from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated, Literal, Self

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn

from swarmtwin.errors import UserError
from swarmtwin.robot import Robot, StrictModel

Activation = Literal["relu", "tanh"]
Squashing = Literal["tanh", "clip"]
Widths = Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(min_length=1)]

ACTIVATIONS: dict[Activation, type[nn.Module]] = {"relu": nn.ReLU, "tanh": nn.Tanh}


class Architecture(StrictModel):
    """A perceptron and how its outputs are brought to −1…1, the share of the command's limits.

    Attributes:
        layers: widths of the hidden layers.
        activation: after each of them.
        squashing: of the outputs: smoothly, or cut.
    """

    layers: Widths
    activation: Activation
    squashing: Squashing


class Policy(nn.Module):
    """A deterministic policy of one robot, shared by all vehicles; each decides by its own observation (section 4.5).

    It owns the command's limits, so that a saved policy needs nothing beside it.

    Attributes:
        robot: whose vehicles it commands.
        observation_names: what the numbers of an observation are, in order.
        architecture: of its network.
    """

    command_low: Tensor
    command_high: Tensor

    def __init__(self, robot: Robot, observation_names: tuple[str, ...], architecture: Architecture) -> None:
        super().__init__()
        self.robot = robot
        self.observation_names = observation_names
        self.architecture = architecture
        stack: list[nn.Module] = []
        for pair in pairwise((len(observation_names), *architecture.layers)):
            stack += [nn.Linear(*pair), ACTIVATIONS[architecture.activation]()]
        self.network = nn.Sequential(*stack, nn.Linear(architecture.layers[-1], len(robot.command)))
        self.register_buffer("command_low", torch.as_tensor(robot.command_low, dtype=torch.float32))
        self.register_buffer("command_high", torch.as_tensor(robot.command_high, dtype=torch.float32))

    @classmethod
    def with_weights(
        cls,
        robot: Robot,
        observation_names: tuple[str, ...],
        architecture: Architecture,
        weights: Mapping[str, Tensor],
    ) -> Self:
        """Build a trained policy from its weights, ready to act; no random number is drawn."""
        with torch.random.fork_rng(devices=[]):
            policy = cls(robot, observation_names, architecture)
        policy.load_state_dict(weights)
        return policy.eval()

    @classmethod
    def of_layers(
        cls, robot: Robot, observation_names: tuple[str, ...], architecture: Architecture, layers: list[nn.Linear]
    ) -> Self:
        """Build a policy from the linear layers of a trained actor, in their order."""
        weights = {
            "command_low": torch.as_tensor(robot.command_low, dtype=torch.float32),
            "command_high": torch.as_tensor(robot.command_high, dtype=torch.float32),
        }
        for index, layer in enumerate(layers):
            weights[f"network.{2 * index}.weight"] = layer.weight.detach().cpu().clone()
            weights[f"network.{2 * index}.bias"] = layer.bias.detach().cpu().clone()
        return cls.with_weights(robot, observation_names, architecture, weights)

    def forward(self, observation: Tensor) -> Tensor:
        """Return the commands (N, m), in the robot's units and within its limits, for observations (N, o)."""
        output = self.network(observation)
        share = output.tanh() if self.architecture.squashing == "tanh" else output.clamp(-1.0, 1.0)
        command = self.command_low + (self.command_high - self.command_low) * (0.5 * (share + 1.0))
        return torch.minimum(torch.maximum(command, self.command_low), self.command_high)

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return commands (W, K, m) for the observations (W, K, o) of W · K vehicles.

        Raises:
            UserError: a command is not finite.
            ValueError: the observations have another size.
        """
        worlds, vehicles, size = observation.shape
        if size != len(self.observation_names):
            raise ValueError(f"observations of {size} numbers, the policy looks at {len(self.observation_names)}")
        with torch.inference_mode():
            command = self(torch.as_tensor(observation.reshape(-1, size), dtype=torch.float32)).numpy()
        if not np.isfinite(command).all():
            raise UserError(f"the policy of {self.robot.name!r} gives a command that is not finite: train it anew")
        return command.reshape(worlds, vehicles, -1).astype(float)
