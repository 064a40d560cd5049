"""TD3, twin delayed DDPG: two critics, a smoothed target, the actor updated every other step."""

from typing import Annotated, Any, Literal

from pydantic import Field
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from swarmtwin.policies.algorithm import Count, ExploringConfig
from swarmtwin.policies.lean_updates import LeanTD3


class Config(ExploringConfig):
    """`conf/policy/td3.yaml`.

    Attributes:
        policy_delay: gradient steps of the critics for one of the actor.
        target_noise: standard deviation of the noise that smooths the target.
        target_noise_limit: where that noise is cut.
    """

    name: Literal["td3"]
    policy_delay: Count
    target_noise: Annotated[float, Field(ge=0)]
    target_noise_limit: Annotated[float, Field(ge=0)]

    def build(self, env: VecEnv, seed: int, device: str) -> BaseAlgorithm:
        """Return TD3 with Gaussian exploration."""
        algorithm = LeanTD3(
            **self.common(env, seed, device),
            action_noise=self.noise(env),
            policy_delay=self.policy_delay,
            target_policy_noise=self.target_noise,
            target_noise_clip=self.target_noise_limit,
        )
        algorithm.critic_updates = self.critic_updates
        return algorithm

    def actor(self, algorithm: Any) -> nn.Module:
        """Return the actor."""
        actor: nn.Module = algorithm.policy.actor
        return actor
