"""PPO, proximal policy optimisation: learns from the latest experience alone."""

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from swarmtwin.policies.algorithm import AlgorithmConfig, Count, Share
from swarmtwin.policies.policy import Activation, Squashing
from swarmtwin.robot import Positive


class Config(AlgorithmConfig):
    """`conf/policy/ppo.yaml`.

    Attributes:
        collected_steps: control periods of all worlds between two updates.
        epochs: passes over them in an update.
        gae_lambda: between one-step (0) and whole-return (1) advantages.
        clip_range: how far an update may go.
        entropy_weight: pay for exploring.
        first_log_spread: logarithm of the first actions' standard deviation, on −1…1.
    """

    activation: ClassVar[Activation] = "tanh"
    squashing: ClassVar[Squashing] = "clip"

    name: Literal["ppo"]
    collected_steps: Count
    epochs: Count
    gae_lambda: Share
    clip_range: Positive
    entropy_weight: Annotated[float, Field(ge=0)]
    first_log_spread: float

    @property
    def steps_at_a_time(self) -> int:
        """Control periods between two updates."""
        return self.collected_steps

    def build(self, env: VecEnv, seed: int, device: str) -> BaseAlgorithm:
        """Return PPO."""
        return PPO(
            "MlpPolicy",
            env,
            seed=seed,
            device=device,
            learning_rate=self.learning_rate,
            gamma=self.gamma,
            batch_size=self.batch_size,
            n_steps=self.collected_steps,
            n_epochs=self.epochs,
            gae_lambda=self.gae_lambda,
            clip_range=self.clip_range,
            ent_coef=self.entropy_weight,
            policy_kwargs={**self.network(), "log_std_init": self.first_log_spread},
        )

    def critics(self, algorithm: Any) -> list[nn.Linear]:
        """Return the last layer of the value network."""
        return [algorithm.policy.value_net]

    def actor(self, algorithm: Any) -> nn.Module:
        """Return the layers that lead to the mean action."""
        policy = algorithm.policy
        return nn.Sequential(policy.mlp_extractor.policy_net, policy.action_net)
