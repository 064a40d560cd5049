"""Trains several seeds, one after the other or in processes of their own, whichever is quicker."""

import math
import multiprocessing
import os
import signal
import time
import traceback
from collections.abc import Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from threading import Thread
from typing import NamedTuple, Self

import torch

from swarmtwin.dynamics.base import Dynamics
from swarmtwin.dynamics.batches import ShuffledBatches
from swarmtwin.dynamics.fitting import SeedResult, fit_seed
from swarmtwin.dynamics.model_config import ModelConfig
from swarmtwin.dynamics.progress import Epoch, EpochReport
from swarmtwin.dynamics.recipe import Recipe
from swarmtwin.dynamics.training_data import TrainingData, training_data
from swarmtwin.errors import UserError
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
    """Train each job in a process of its own. None outlives this call, nor, should it be killed, this process."""
    waiting, workers = list(enumerate(jobs)), list[Worker]()
    results: dict[int, SeedResult] = {}
    try:
        while waiting or workers:
            while waiting and len(workers) < processes:
                workers.append(Worker.start(*waiting.pop(0)))
            ready = wait([worker.messages for worker in workers])
            for worker in [worker for worker in workers if worker.messages in ready]:
                message = worker.receive()
                if isinstance(message, SeedResult):
                    results[worker.number] = message
                    worker.process.join()
                    workers.remove(worker)
                elif report:
                    report(*message)
    finally:
        for worker in workers:
            worker.process.kill()
            worker.process.join()
    return [results[number] for number in range(len(jobs))]


class Worker(NamedTuple):
    """A process that trains one job, given by its number, and the end of the pipe on which it tells of it."""

    number: int
    job: Job
    process: BaseProcess
    messages: Connection

    @classmethod
    def start(cls, number: int, job: Job) -> Self:
        """Start the process."""
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload([__name__])
        messages, sender = context.Pipe(duplex=False)
        process = context.Process(target=_work, args=(job, sender), daemon=True)
        process.start()
        sender.close()
        return cls(number, job, process, messages)

    def receive(self) -> SeedResult | tuple[int, int, Epoch]:
        """Wait for its next message: the arguments of an epoch's report, or its result as the last one.

        Raises:
            UserError: the process was killed.
            Exception: the training raised it.
        """
        try:
            message: SeedResult | tuple[int, int, Epoch] | Exception = self.messages.recv()
        except (EOFError, OSError):
            self.process.join()
            raise UserError(
                f"seed {self.job.seed}: the process that trained it ended with exit code {self.process.exitcode}, "
                "as when memory runs out: make room and run the same command again"
            ) from None
        if isinstance(message, Exception):
            raise message
        return message


def _work(job: Job, sender: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group: the trainer ends its workers
    Thread(target=_end_with_the_trainer, daemon=True).start()
    try:
        sender.send(job.run(lambda *epoch: sender.send(epoch)))
    except Exception as error:
        error.add_note(traceback.format_exc())
        sender.send(error)


def _end_with_the_trainer() -> None:
    trainer = multiprocessing.parent_process()
    assert trainer is not None
    trainer.join()
    os._exit(1)
