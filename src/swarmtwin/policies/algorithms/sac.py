"""SAC, soft actor-critic: a stochastic actor that is paid for its entropy, rolled out by its mean."""

from typing import Any, Literal

from stable_baselines3 import SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from swarmtwin.policies.algorithm import OffPolicyConfig


class Config(OffPolicyConfig):
    """`conf/policy/sac.yaml`. The weight of the entropy is learned."""

    name: Literal["sac"]

    def build(self, env: VecEnv, seed: int) -> BaseAlgorithm:
        """Return SAC."""
        return SAC(**self.common(env, seed), ent_coef="auto")

    def actor(self, algorithm: Any) -> nn.Module:
        """Return the layers that lead to the mean action."""
        actor = algorithm.policy.actor
        return nn.Sequential(actor.latent_pi, actor.mu)
