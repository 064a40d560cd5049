"""Policies tried on robots with something hidden in them: what each roll-out gave, and what an extension gains."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np
from scipy.stats import t

from swarmtwin.learning.device import one_thread
from swarmtwin.learning.parallel import Report, run_side_by_side
from swarmtwin.policies.algorithm import AlgorithmConfig
from swarmtwin.policies.rollout_comparison import draw_scenarios
from swarmtwin.policies.training import SeedResult, policy_of
from swarmtwin.world.motion import Motion
from swarmtwin.world.rollout import NEVER, play
from swarmtwin.world.task import Task

RATES = ("success", "collision")
"""Quantities that are yes or no in each roll-out."""


@dataclass(frozen=True)
class Trial:
    """How a policy is tried.

    Attributes:
        task: that it learned.
        algorithm: that taught it.
        motion: gives what moves the vehicles, with the same chances each time.
        rollouts: W.
        seed: of the starts.
    """

    task: Task
    algorithm: AlgorithmConfig
    motion: Callable[[], Motion]
    rollouts: int
    seed: int


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
    def of(cls, results: Sequence[SeedResult], trial: "Trial", processes: int | None) -> Self | None:
        """Roll out the policies of all seeds, so many at a time; None where all diverged before they were evaluated.

        Args:
            results: of the seeds; those that diverged so early are left out.
            trial: of each policy.
            processes: at a time; None: as many as there are cores.

        Raises:
            UserError: a policy gives a command that is not finite.
        """
        able = [result for result in results if result.weights]
        if not able:
            return None
        played = run_side_by_side([_TrialJob(trial, result) for result in able], None, processes)
        success, collision, reward = (np.stack(values) for values in zip(*played, strict=True))
        return cls(tuple(result.seed for result in able), success, collision, reward)

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
        """Return the mean of a quantity with its interval; a success rate stays between 0 and 1."""
        estimate = Estimate.of(getattr(self, quantity))
        return estimate.within(0.0, 1.0) if quantity in RATES else estimate

    def gain(self, quantity: str, before: "Trials") -> "Estimate":
        """Return by how much the mean of a quantity is above that of other trials, of the same seeds and starts.

        A seed that only one of them has is left out.
        """
        after_of, before_of = (dict(zip(one.seeds, getattr(one, quantity), strict=True)) for one in (self, before))
        differences = [after_of[seed] - 1.0 * before_of[seed] for seed in self.seeds if seed in before_of]
        if not differences:
            return Estimate(math.nan, math.nan, math.nan)
        estimate = Estimate.of(np.stack(differences))
        return estimate.within(-1.0, 1.0) if quantity in RATES else estimate


class _TrialJob(NamedTuple):
    """A policy's roll-outs, in a process of their own."""

    trial: Trial
    result: SeedResult

    def run(self, report: Report | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return (W,) whether each succeeded, whether vehicles collided, and its reward a vehicle and step."""
        trial, task = self.trial, self.trial.task
        scenario = draw_scenarios(task, trial.rollouts, "rollout", trial.seed)
        with one_thread():
            played = play(task, trial.motion(), scenario, policy_of(task, trial.algorithm, self.result).act)
        return played.success, played.collided_step != NEVER, played.mean_reward


class Estimate(NamedTuple):
    """A figure with its 95 % interval over seeds of learning and over starts."""

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, values: np.ndarray) -> "Estimate":
        """Return the mean of values (S, W) of S seeds from W starts.

        Seeds are few, and differ by more than starts do: the interval is Student's, with the degrees of freedom of
        Welch and Satterthwaite, of a variance that is the sum of that of the seeds' means and that of the starts' means
        (a bootstrap of three seeds would be much too narrow). By what single roll-outs differ beside both it is a
        little too wide. With a single seed it is over starts alone.
        """
        means, value = (values.mean(axis=0), values.mean(axis=1)), float(values.mean())
        parts = [(float(one.var(ddof=1)) / len(one), len(one) - 1) for one in means if len(one) > 1]
        variance = sum(part for part, _ in parts)
        if variance == 0:
            return cls(value, value, value)
        freedom = variance**2 / sum(part**2 / degrees for part, degrees in parts)
        half = float(t.ppf(0.975, freedom)) * math.sqrt(variance)
        return cls(value, value - half, value + half)

    def within(self, least: float, most: float) -> "Estimate":
        """Return it with an interval that ends where the figure does."""
        return self._replace(low=max(self.low, least), high=min(self.high, most))
