"""What every algorithm's configuration has in common; each file in `algorithms/` ends in its own kind of it."""

from abc import abstractmethod
from typing import Annotated, Any, ClassVar

import torch
from pydantic import Field
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from swarmtwin.plugins import PluginRegistry
from swarmtwin.policies import algorithms
from swarmtwin.policies.lean_updates import SharedGaussianNoise
from swarmtwin.policies.policy import ACTIVATIONS, Activation, Architecture, Policy, Squashing, Widths
from swarmtwin.robot import Positive, StrictModel

Count = Annotated[int, Field(ge=1)]
Share = Annotated[float, Field(gt=0, le=1)]


class AlgorithmConfig(StrictModel):
    """The configuration of an algorithm, as in its `conf/policy/<name>.yaml`.

    Attributes:
        name: the algorithm's name, that of its file.
        steps: how long to learn, in control periods of all worlds.
        worlds: how many are played side by side while learning.
        layers: widths of the hidden layers, of actor and critic alike.
        learning_rate: of all networks.
        gamma: discount of later rewards, a period.
        batch_size: transitions in a gradient step.
        reward_size: to which the mean reward of random play is scaled.
    """

    activation: ClassVar[Activation]
    squashing: ClassVar[Squashing]

    name: str
    steps: Count
    worlds: Count
    layers: Widths
    learning_rate: Positive
    gamma: Annotated[float, Field(gt=0, lt=1)]
    batch_size: Count
    reward_size: Positive

    @property
    def architecture(self) -> Architecture:
        """The architecture of the policies that this algorithm makes."""
        return Architecture(layers=self.layers, activation=self.activation, squashing=self.squashing)

    @property
    def steps_at_a_time(self) -> int:
        """Control periods between two updates: evaluations are a multiple of it apart."""
        return 1

    @abstractmethod
    def build(self, env: VecEnv, seed: int, device: str) -> BaseAlgorithm:
        """Return the untrained algorithm of stable-baselines3, whose networks lie on a device of torch."""

    @abstractmethod
    def actor(self, algorithm: Any) -> nn.Module:
        """Return the part of a trained algorithm that gives the deterministic action."""

    @abstractmethod
    def critics(self, algorithm: Any) -> list[nn.Linear]:
        """Return the last layers of the networks that estimate values."""

    def expect(self, algorithm: BaseAlgorithm, value: float) -> None:
        """Let untrained critics begin with the value of random play, rather than learn so much from nothing first."""
        for layer in self.critics(algorithm):
            nn.init.constant_(layer.bias, value)

    def begin_with(self, algorithm: BaseAlgorithm, policy: Policy) -> None:
        """Let an untrained actor, and its target where it has one, begin with a policy of the same architecture."""
        learned = [layer for layer in policy.network if isinstance(layer, nn.Linear)]
        with torch.no_grad():
            for layer, known in zip(self.layers_of(algorithm), learned, strict=True):
                layer.weight.copy_(known.weight)
                layer.bias.copy_(known.bias)
        target = getattr(algorithm.policy, "actor_target", None)
        if target is not None:
            target.load_state_dict(self.actor(algorithm).state_dict())

    def layers_of(self, algorithm: BaseAlgorithm) -> list[nn.Linear]:
        """Return the actor's linear layers, in their order."""
        return [layer for layer in self.actor(algorithm).modules() if isinstance(layer, nn.Linear)]

    def network(self) -> dict[str, Any]:
        """Return the networks' description for stable-baselines3."""
        return {"net_arch": list(self.layers), "activation_fn": ACTIVATIONS[self.activation]}


class OffPolicyConfig(AlgorithmConfig):
    """An algorithm that learns from a replay buffer.

    Attributes:
        updates: gradient steps a control period of all worlds.
        tau: share by which the target networks follow, a step.
        buffer_size: transitions remembered.
        random_steps: control periods of random commands before learning begins.
    """

    activation: ClassVar[Activation] = "relu"
    squashing: ClassVar[Squashing] = "tanh"

    updates: Count
    tau: Share
    buffer_size: Count
    random_steps: Count

    def critics(self, algorithm: Any) -> list[nn.Linear]:
        """Return the last layers of the critics and of their targets."""
        policy = algorithm.policy
        return [network[-1] for critic in (policy.critic, policy.critic_target) for network in critic.q_networks]

    def common(self, env: VecEnv, seed: int, device: str) -> dict[str, Any]:
        """Return the arguments that the algorithms of this kind share."""
        return {
            "policy": "MlpPolicy",
            "env": env,
            "seed": seed,
            "device": device,
            "learning_rate": self.learning_rate,
            "gamma": self.gamma,
            "batch_size": self.batch_size,
            "tau": self.tau,
            "buffer_size": self.buffer_size,
            "learning_starts": self.random_steps * env.num_envs,
            "train_freq": 1,
            "gradient_steps": self.updates,
            "policy_kwargs": {**self.network(), "optimizer_kwargs": {"fused": True}},
        }


class ExploringConfig(OffPolicyConfig):
    """An algorithm whose policy is deterministic, so that noise on its actions of −1…1 has to explore.

    Attributes:
        exploration: standard deviation of that noise in the beginning.
        last_exploration: in the end; in between it goes straight from the one to the other. None: as in the beginning.
            Vehicles that see others move at random keep more distance than they will need; but where noise falls
            early, some never find the way.
        critic_updates: gradient steps that the critics learn for before the actor begins.
    """

    exploration: Annotated[float, Field(ge=0)]
    last_exploration: Annotated[float, Field(ge=0)] | None = None
    critic_updates: Annotated[int, Field(ge=0)] = 0

    def noise(self, env: VecEnv) -> ActionNoise:
        """Return the noise of a training."""
        last = self.exploration if self.last_exploration is None else self.last_exploration
        return SharedGaussianNoise(env, self.exploration, last, self.steps)


ALGORITHMS: PluginRegistry[AlgorithmConfig] = PluginRegistry(algorithms, "algorithm", group="policy")

algorithm_names = ALGORITHMS.names
config_class = ALGORITHMS.plugin_class
algorithm_config = ALGORITHMS.config
