"""DDPG, deep deterministic policy gradient: the paper's algorithm (sections 4.4 and 4.5)."""

from typing import Annotated, Any, Literal

from pydantic import Field
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from swarmtwin.policies.algorithm import OffPolicyConfig, gaussian
from swarmtwin.policies.lean_updates import LeanDDPG


class Config(OffPolicyConfig):
    """`conf/policy/ddpg.yaml`.

    Attributes:
        exploration: standard deviation of the noise on actions of −1…1.
    """

    name: Literal["ddpg"]
    exploration: Annotated[float, Field(ge=0)]

    def build(self, env: VecEnv, seed: int, device: str) -> BaseAlgorithm:
        """Return DDPG with Gaussian exploration."""
        return LeanDDPG(**self.common(env, seed, device), action_noise=gaussian(env, self.exploration))

    def actor(self, algorithm: Any) -> nn.Module:
        """Return the actor."""
        actor: nn.Module = algorithm.policy.actor
        return actor
