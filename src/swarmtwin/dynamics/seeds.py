"""Trains several seeds, one after the other or in processes of their own, whichever is quicker."""

import math
import multiprocessing
import os
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from threading import Thread
from typing import Any, NamedTuple

import torch

from swarmtwin.dynamics.base import Dynamics
from swarmtwin.dynamics.batches import ShuffledBatches
from swarmtwin.dynamics.fitting import SeedResult, fit_seed, one_thread
from swarmtwin.dynamics.model_config import ModelConfig
from swarmtwin.dynamics.progress import Epoch, EpochReport
from swarmtwin.dynamics.recipe import Recipe
from swarmtwin.dynamics.training_data import TrainingData, training_data
from swarmtwin.transitions import Transitions

# What the first process of a program takes to import everything; measured on two cores.
START_UP_S = 7.0


class Job(NamedTuple):
    """One seed to train."""

    transitions: Transitions
    config: ModelConfig
    recipe: Recipe
    seed: int
    checkpoint: Path | None

    def run(self, report: EpochReport | None) -> SeedResult:
        """Train it."""
        return fit_seed(self.config, self.recipe, self._data(), self.seed, self.checkpoint, report)

    def expected_s(self) -> float:
        """Estimate how long that takes, from the second of two steps."""
        assert self.recipe.epochs is not None
        data = self._data()
        with one_thread(), torch.random.fork_rng(devices=[]):
            batches = ShuffledBatches(*data.train, size=self.recipe.batch_size, seed=self.seed)
            dynamics = Dynamics(data.robot, self.config)
            dynamics.learn_scaling(*data.train)
            batch = next(iter(batches))
            for _ in range(2):
                start = time.perf_counter()
                position_mm, orientation_rad = dynamics.errors(batch)
                (position_mm + orientation_rad).backward()
                step_s = time.perf_counter() - start
        return step_s * len(batches) * self.recipe.epochs

    def _data(self) -> TrainingData:
        return training_data(self.transitions, self.config.situation or self.transitions.robot.situation)


def fit_all(jobs: Sequence[Job], report: EpochReport | None, processes: int | None) -> list[SeedResult]:
    """Train all jobs, `processes` at a time; None: as many as there are cores, or one where that is quicker."""
    at_a_time = min(len(jobs), processes or len(os.sched_getaffinity(0)))
    if at_a_time == 1 or (processes is None and _saved_s(jobs, at_a_time) < START_UP_S):
        return _fit_in_turn(jobs, report)
    return _fit_in_parallel(jobs, report, at_a_time)


def _saved_s(jobs: Sequence[Job], at_a_time: int) -> float:
    """Estimate from one step what training `at_a_time` jobs at a time would save, start-up left out."""
    in_turn = len(jobs) - math.ceil(len(jobs) / at_a_time)
    return in_turn * jobs[0].expected_s()


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
