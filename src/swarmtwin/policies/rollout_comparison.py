"""Policies judged by roll-outs from the same starts, in simulation and on vehicles: tables 5 and 6 of the paper."""

import zlib
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np
import pandas as pd

from swarmtwin.errors import UserError
from swarmtwin.robot import POSE_COLUMNS, StrictModel
from swarmtwin.world.rollout import NEVER, Rollout, RolloutFigures, figures_of
from swarmtwin.world.scenario import Scenario
from swarmtwin.world.task import Task

Purpose = Literal["evaluation", "challenge", "rollout", "gate"]

MOTION_NAMES = {"simulation": "simulation", "stand_in": "stand-ins"}
"""What people call that which moves the vehicles."""


def draw_scenarios(task: Task, count: int, purpose: Purpose, seed: int) -> Scenario:
    """Draw `count` scenarios of a task to judge policies in: the same for every policy, and for each purpose others.

    Fewer are not the first of more. No training starts from any of them.
    """
    return task.draw(np.random.default_rng([zlib.crc32(purpose.encode()), seed]), count)


class Evaluation(StrictModel):
    """What roll-outs gave after so many control periods of training: shares of the roll-outs, mean reward a step."""

    step: int
    success: float
    reward: float
    collision: float
    left_arena: float

    @classmethod
    def of(cls, step: int, rollout: Rollout) -> "Evaluation":
        """Sum up roll-outs."""
        return cls(
            step=step,
            success=float(rollout.success.mean()),
            reward=float(rollout.mean_reward.mean()),
            collision=float((rollout.collided_step != NEVER).mean()),
            left_arena=float((rollout.left_step != NEVER).mean()),
        )

    @property
    def rank(self) -> tuple[float, float]:
        """By which policies are ordered: success, then reward."""
        return self.success, self.reward

    def __str__(self) -> str:
        return f"success {self.success:.0%}  reward {self.reward:.2f}"


class Difference(NamedTuple):
    """How much more a policy earns on vehicles than in simulation, in per cent of the latter, with its 95 % interval.

    Rewards are negative: −5 means that it earns 5 % less.
    """

    percent: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.percent:+.1f} % ({self.low:+.1f} to {self.high:+.1f})"


class RewardGap(NamedTuple):
    """How much more a policy earns on vehicles than in simulation, a vehicle and step, with its 95 % interval.

    The reality gap of the simulation, as tables 5 and 6 of the paper show it.
    """

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:+.3f} ({self.low:+.3f} to {self.high:+.3f})"


def reward_gap(simulation: Rollout, vehicles: Rollout, seed: int = 0, resamples: int = 2000) -> RewardGap:
    """Compare the mean rewards of roll-outs from the same starts; the interval by bootstrap over pairs of them.

    Raises:
        UserError: there are fewer than 10 roll-outs, too few for an interval.
    """
    return RewardGap(*_compared(simulation, vehicles, _absolute, seed, resamples))


def reward_difference(simulation: Rollout, vehicles: Rollout, seed: int = 0, resamples: int = 2000) -> Difference:
    """Compare them likewise, in per cent of the reward in simulation.

    Raises:
        UserError: there are fewer than 10 roll-outs, too few for an interval.
    """
    return Difference(*_compared(simulation, vehicles, _relative, seed, resamples))


def _compared(
    simulation: Rollout, vehicles: Rollout, difference: Callable[[np.ndarray], np.ndarray], seed: int, resamples: int
) -> tuple[float, float, float]:
    """Return a difference of mean rewards (2,), simulated and real, and the ends of its interval."""
    check_count(len(simulation))
    pairs = np.stack([simulation.mean_reward, vehicles.mean_reward])
    drawn = np.random.default_rng(seed).integers(0, pairs.shape[1], (resamples, pairs.shape[1]))
    low, high = np.quantile(difference(pairs[:, drawn].mean(axis=2)), [0.025, 0.975])
    return float(difference(pairs.mean(axis=1))), float(low), float(high)


def check_count(rollouts: int, fewest: int = 10) -> None:
    """Refuse to state an interval from too few roll-outs.

    Raises:
        UserError: there are fewer than `fewest`.
    """
    if rollouts < fewest:
        raise UserError(f"{rollouts} roll-outs are too few for an interval: ask for {fewest} or more")


def _absolute(means: np.ndarray) -> np.ndarray:
    simulated, real = means
    return np.asarray(real - simulated)


def _relative(means: np.ndarray) -> np.ndarray:
    simulated, real = means
    return 100 * (real - simulated) / np.maximum(np.abs(simulated), 1e-12)


def plain_figures(figures: RolloutFigures) -> dict[str, Any]:
    """Return the figures of roll-outs as plain data, as they stand in metrics.json; null where nothing was reached."""
    rates = {name: getattr(figures, name)._asdict() for name in ("success", "collision", "left_arena")}
    means = {
        "reward": (figures.reward, figures.reward_sd),
        "reach_time_s": (figures.reach_time_s, figures.reach_time_sd_s),
        "final_distance_mm": (figures.final_distance_mm, figures.final_distance_sd_mm),
    }
    plain = {name: {"mean": _known(mean), "sd": _known(sd)} for name, (mean, sd) in means.items()}
    return {"rollouts": figures.rollouts, **plain, **rates}


def metrics_of(rollouts: dict[str, Rollout]) -> dict[str, Any]:
    """Return the figures of each, and the difference of rewards where there are a simulation and stand-ins."""
    metrics: dict[str, Any] = {name: plain_figures(figures_of(rollout)) for name, rollout in rollouts.items()}
    if {"simulation", "stand_in"} <= set(rollouts):
        difference = reward_difference(rollouts["simulation"], rollouts["stand_in"])
        metrics["reward_difference_percent"] = {
            "value": difference.percent,
            "low": difference.low,
            "high": difference.high,
        }
    return metrics


def tracked_figures(metrics: dict[str, Any], prefix: str = "") -> dict[str, float]:
    """Return metrics by name and unit, as MLflow keeps them."""
    by_name = {}
    for motion in ("simulation", "stand_in"):
        if motion in metrics:
            figures = metrics[motion]
            by_name[f"{prefix}{motion}_reward"] = figures["reward"]["mean"]
            by_name[f"{prefix}{motion}_success"] = figures["success"]["value"]
            by_name[f"{prefix}{motion}_collision"] = figures["collision"]["value"]
    if "reward_difference_percent" in metrics:
        by_name[f"{prefix}reward_difference_percent"] = metrics["reward_difference_percent"]["value"]
    return by_name


def rollout_table(motion: str, rollout: Rollout) -> pd.DataFrame:
    """Return every moment of every roll-out, one row for each vehicle; the first has no command and no reward yet."""
    moments, worlds, vehicles = rollout.pose.shape[:3]
    moment, world, vehicle = (index.ravel() for index in np.indices((moments, worlds, vehicles)))
    going_on = np.concatenate([np.ones((1, worlds), dtype=bool), rollout.counted])
    columns: dict[str, Any] = {
        "world": motion,
        "rollout": world,
        "vehicle": vehicle + 1,
        "time_s": moment * rollout.robot.period_s,
        **{name: rollout.pose[..., axis].ravel() for axis, name in enumerate(POSE_COLUMNS)},
        **{
            name: _after_start(rollout.command[..., column]).ravel()
            for column, name in enumerate(rollout.robot.command_columns)
        },
        "reward": _after_start(rollout.reward).ravel(),
    }
    return pd.DataFrame(columns)[np.repeat(going_on.ravel(), vehicles)].reset_index(drop=True)


def _after_start(values: np.ndarray) -> np.ndarray:
    """Return what belongs to T periods (T, W, K) with a first row in which nothing has happened yet."""
    return np.concatenate([np.full((1, *values.shape[1:]), np.nan), values])


def _known(value: float) -> float | None:
    return None if np.isnan(value) else value
