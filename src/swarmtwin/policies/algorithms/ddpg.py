"""DDPG, deep deterministic policy gradient: the paper's algorithm (sections 4.4 and 4.5)."""

from typing import Any, Literal

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from swarmtwin.policies.algorithm import ExploringConfig
from swarmtwin.policies.lean_updates import LeanDDPG


class Config(ExploringConfig):
    """`conf/policy/ddpg.yaml`."""

    name: Literal["ddpg"]

    def build(self, env: VecEnv, seed: int, device: str) -> BaseAlgorithm:
        """Return DDPG with Gaussian exploration."""
        algorithm = LeanDDPG(**self.common(env, seed, device), action_noise=self.noise(env))
        algorithm.critic_updates = self.critic_updates
        return algorithm

    def actor(self, algorithm: Any) -> nn.Module:
        """Return the actor."""
        actor: nn.Module = algorithm.policy.actor
        return actor
