"""Learns with several seeds, each in a process of its own, and keeps the best."""

import logging
from collections.abc import Sequence

import torch

from swarmtwin.errors import UserError
from swarmtwin.policies.learning import Lesson, SeedResult
from swarmtwin.policies.policy import Policy
from swarmtwin.policies.stage import StageReport
from swarmtwin.processes import run_side_by_side

log = logging.getLogger(__name__)


def learn_all(
    lessons: Sequence[Lesson], report: StageReport | None = None, processes: int | None = None
) -> list[SeedResult]:
    """Learn all lessons, `processes` at a time; None: as many as there are cores."""
    results = run_side_by_side(lessons, report, processes, preload=Lesson.__module__)
    for result in results:
        if result.failed:
            log.warning("seed %d has failed: %s", result.seed, result.failed)
    return results


def best_of(results: Sequence[SeedResult]) -> SeedResult:
    """Return the seed with most success in the evaluation scenes, of equal ones that with the highest reward.

    Raises:
        UserError: every seed has failed.
    """
    usable = [result for result in results if not result.failed and result.best]
    if not usable:
        reasons = "; ".join(f"seed {result.seed}: {result.failed}" for result in results)
        raise UserError(f"every seed has failed ({reasons}): learn longer, try other seeds, or another algorithm")
    return max(usable, key=_goodness)


def policy_of(lesson: Lesson, result: SeedResult) -> Policy:
    """Return the best policy of a seed."""
    names = lesson.task.build(lesson.robot).observation_names
    weights = {name: torch.from_numpy(values) for name, values in result.weights.items()}
    return Policy.with_weights(lesson.robot, names, lesson.algorithm.architecture, weights)


def _goodness(result: SeedResult) -> tuple[float, float]:
    assert result.best is not None
    return result.best.success, result.best.reward
