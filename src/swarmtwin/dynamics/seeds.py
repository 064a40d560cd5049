"""Trains several seeds, one after the other or in processes of their own, whichever is quicker."""

import math
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch

from swarmtwin.dynamics.base import Dynamics
from swarmtwin.dynamics.batches import ShuffledBatches
from swarmtwin.dynamics.fitting import SeedResult, fit_seed
from swarmtwin.dynamics.model_config import ModelConfig
from swarmtwin.dynamics.progress import EpochReport
from swarmtwin.dynamics.recipe import Recipe
from swarmtwin.dynamics.training_data import TrainingData, training_data
from swarmtwin.processes import run_side_by_side
from swarmtwin.trainer import one_thread
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
        return training_data(self.transitions, self.config.parts(self.transitions.robot))


def fit_all(jobs: Sequence[Job], report: EpochReport | None, processes: int | None) -> list[SeedResult]:
    """Train all jobs, `processes` at a time; None: as many as there are cores, or one where that is quicker."""
    at_a_time = min(len(jobs), processes or len(os.sched_getaffinity(0)))
    if processes is None and _saved_s(jobs, at_a_time) < START_UP_S:
        at_a_time = 1
    return run_side_by_side(jobs, report, at_a_time, preload=__name__)


def _saved_s(jobs: Sequence[Job], at_a_time: int) -> float:
    """Estimate from one step what training `at_a_time` jobs at a time would save, start-up left out."""
    in_turn = len(jobs) - math.ceil(len(jobs) / at_a_time)
    return in_turn * jobs[0].expected_s()
