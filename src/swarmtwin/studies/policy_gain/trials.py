"""Policies tried on robots with something hidden in them: what each roll-out gave, and what an extension gains."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np

from swarmtwin.policies.algorithm import AlgorithmConfig
from swarmtwin.policies.rollout_comparison import draw_scenarios
from swarmtwin.policies.training import SeedResult, policy_of
from swarmtwin.world.motion import Motion
from swarmtwin.world.rollout import NEVER, play
from swarmtwin.world.task import Task


@dataclass(frozen=True)
class Trials:
    """The roll-outs of the policies of S seeds from the same W starts.

    Attributes:
        seeds: of the policies, (S,).
        success: (S, W) all targets reached, no collision, nobody left the arena.
        collision: (S, W).
        reward: (S, W) a vehicle and step.
    """

    seeds: tuple[int, ...]
    success: np.ndarray
    collision: np.ndarray
    reward: np.ndarray

    @classmethod
    def of(
        cls,
        results: tuple[SeedResult, ...],
        task: Task,
        algorithm: AlgorithmConfig,
        motion: Callable[[], Motion],
        rollouts: int,
        seed: int,
    ) -> Self | None:
        """Roll out the policies of all seeds; None where all diverged before they were first evaluated.

        Args:
            results: of the seeds; those that diverged so early are left out.
            task: that they learned.
            algorithm: that taught them.
            motion: gives what moves the vehicles, with the same chances each time.
            rollouts: W.
            seed: of the starts.

        Raises:
            UserError: a policy gives a command that is not finite.
        """
        able = [result for result in results if result.weights]
        if not able:
            return None
        scenario = draw_scenarios(task, rollouts, "rollout", seed)
        played = [play(task, motion(), scenario, policy_of(task, algorithm, result).act) for result in able]
        return cls(
            seeds=tuple(result.seed for result in able),
            success=np.stack([one.success for one in played]),
            collision=np.stack([one.collided_step != NEVER for one in played]),
            reward=np.stack([one.mean_reward for one in played]),
        )

    def rows(self) -> list[dict[str, Any]]:
        """Return each roll-out as a line of trials.csv."""
        return [
            {
                "seed": seed,
                "rollout": start,
                "success": bool(self.success[number, start]),
                "collision": bool(self.collision[number, start]),
                "reward": round(float(self.reward[number, start]), 5),
            }
            for number, seed in enumerate(self.seeds)
            for start in range(self.success.shape[1])
        ]

    def mean(self, quantity: str) -> "Estimate":
        """Return the mean of a quantity with its interval."""
        return Estimate.of(getattr(self, quantity))

    def gain(self, quantity: str, before: "Trials") -> "Estimate":
        """Return by how much the mean of a quantity is above that of other trials from the same starts."""
        return Estimate.of(getattr(self, quantity), getattr(before, quantity))


class Estimate(NamedTuple):
    """A figure with its 95 % interval, by bootstrap over seeds of learning and over starts."""

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, values: np.ndarray, less: np.ndarray | None = None, resamples: int = 2000) -> "Estimate":
        """Return the mean of values (S, W), less that of others (S', W) from the same starts, if there are any."""
        rng = np.random.default_rng(0)
        starts = rng.integers(0, values.shape[1], (resamples, values.shape[1]))
        drawn, value = _resampled(values, starts, rng), float(values.mean())
        if less is not None:
            drawn, value = drawn - _resampled(less, starts, rng), value - float(less.mean())
        low, high = np.quantile(drawn, [0.025, 0.975])
        return cls(value, float(low), float(high))


def _resampled(values: np.ndarray, starts: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return means (D,) of values (S, W) at starts (D, W) that were drawn, each over as many seeds, drawn here."""
    seeds = rng.integers(0, len(values), (len(starts), len(values)))
    means: np.ndarray = values[seeds[:, :, None], starts[:, None, :]].mean(axis=(1, 2))
    return means
