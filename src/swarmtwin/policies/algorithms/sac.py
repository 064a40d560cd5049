"""SAC, soft actor-critic: a stochastic actor that is paid for its entropy, rolled out by its mean."""

from typing import Any, Literal

from stable_baselines3 import SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from swarmtwin.policies.algorithm import OffPolicyConfig
from swarmtwin.robot import Positive


class Config(OffPolicyConfig):
    """`conf/policy/sac.yaml`.

    Attributes:
        first_entropy_weight: how much entropy is worth in the beginning; it is learned from there.
    """

    name: Literal["sac"]
    first_entropy_weight: Positive

    def build(self, env: VecEnv, seed: int, device: str) -> BaseAlgorithm:
        """Return SAC."""
        return SAC(**self.common(env, seed, device), ent_coef=f"auto_{self.first_entropy_weight}")

    def actor(self, algorithm: Any) -> nn.Module:
        """Return the layers that lead to the mean action."""
        actor = algorithm.policy.actor
        return nn.Sequential(actor.latent_pi, actor.mu)
