"""Trains several seeds of a dynamics model and keeps the best live one."""

import logging
import multiprocessing
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import Any, NamedTuple

import torch

from swarmtwin.dynamics.base import Dynamics
from swarmtwin.dynamics.fitting import SeedResult, fit_seed
from swarmtwin.dynamics.model_config import ModelConfig
from swarmtwin.dynamics.progress import Epoch, EpochReport
from swarmtwin.dynamics.recipe import Recipe
from swarmtwin.dynamics.training_data import training_data
from swarmtwin.errors import UserError
from swarmtwin.transitions import Transitions

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Trained:
    """A trained model and what came of each seed.

    Attributes:
        dynamics: the live seed with the lowest validation loss, in eval mode.
        seed: its seed.
        recipe: the recipe with all its values known.
        results: one for each seed, in the order asked for.
    """

    dynamics: Dynamics
    seed: int
    recipe: Recipe
    results: tuple[SeedResult, ...]

    @property
    def best(self) -> SeedResult:
        """The chosen seed's result."""
        return next(result for result in self.results if result.seed == self.seed)

    @property
    def dead_seeds(self) -> dict[int, str]:
        """The seeds that cannot be used, with the reason."""
        return {result.seed: result.dead for result in self.results if result.dead}


class Job(NamedTuple):
    """One seed to train."""

    transitions: Transitions
    config: ModelConfig
    recipe: Recipe
    seed: int
    checkpoint: Path | None

    def run(self, report: EpochReport | None) -> SeedResult:
        """Train it."""
        data = training_data(self.transitions, self.config.situation or self.transitions.robot.situation)
        return fit_seed(self.config, self.recipe, data, self.seed, self.checkpoint, report)


def train(
    transitions: Transitions,
    config: ModelConfig,
    recipe: Recipe,
    seeds: Sequence[int],
    checkpoints: Path | None = None,
    report: EpochReport | None = None,
    processes: int | None = None,
) -> Trained:
    """Train each seed on the training split; the best live one on the validation split is the model.

    Args:
        transitions: measured or synthetic transitions with their splits.
        config: which model.
        recipe: how to train it.
        seeds: one training each.
        checkpoints: a folder from which interrupted seeds continue, written after each epoch.
        report: called after each epoch of each seed.
        processes: seeds trained at a time; by default as many as there are cores.

    Raises:
        UserError: too little data, values that are not finite, or every seed is dead.
    """
    recipe = recipe.for_model(config, len(transitions.part("train")))
    if checkpoints:
        checkpoints.mkdir(parents=True, exist_ok=True)
    files = [checkpoints / f"seed-{seed}.ckpt" if checkpoints else None for seed in seeds]
    jobs = [Job(transitions, config, recipe, seed, file) for seed, file in zip(seeds, files, strict=True)]
    processes = min(len(jobs), processes or len(os.sched_getaffinity(0)))
    results = _fit_in_turn(jobs, report) if processes == 1 else _fit_in_parallel(jobs, report, processes)
    for result in results:
        if result.dead:
            log.warning("%s, seed %d is dead: %s", config.name, result.seed, result.dead)
    best = _best_live(config, results)
    dynamics = Dynamics(transitions.robot, config)
    dynamics.load_state_dict({name: torch.from_numpy(weights) for name, weights in best.weights.items()})
    return Trained(dynamics.eval(), best.seed, recipe, tuple(results))


def _best_live(config: ModelConfig, results: Sequence[SeedResult]) -> SeedResult:
    live = [result for result in results if not result.dead]
    if not live:
        reasons = "; ".join(f"seed {result.seed}: {result.dead}" for result in results)
        raise UserError(
            f"{config.name}: every seed is dead ({reasons}): try other seeds, a lower learning rate, or another model"
        )
    return min(live, key=lambda result: result.validation_loss)


def _fit_in_turn(jobs: Sequence[Job], report: EpochReport | None) -> list[SeedResult]:
    return [job.run(report) for job in jobs]


def _fit_in_parallel(jobs: Sequence[Job], report: EpochReport | None, processes: int) -> list[SeedResult]:
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    reports: Any = context.SimpleQueue()
    listener = Thread(target=_pass_on, args=(reports, report), daemon=True)
    listener.start()
    pool = ProcessPoolExecutor(processes, context, initializer=_send_reports_to, initargs=(reports,))
    try:
        results = list(pool.map(_fit_job, jobs))
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        raise
    else:
        pool.shutdown()
        return results
    finally:
        reports.put(None)
        listener.join()


_reports: Any = None


def _send_reports_to(reports: Any) -> None:
    global _reports
    _reports = reports


def _fit_job(job: Job) -> SeedResult:
    return job.run(lambda seed, number, epoch: _reports.put((seed, number, tuple(epoch))))


def _pass_on(reports: Any, report: EpochReport | None) -> None:
    while (message := reports.get()) is not None:
        if report:
            seed, number, errors = message
            report(seed, number, Epoch(*errors))
