"""Jobs that run side by side, each in a process of its own that never outlives this one."""

import multiprocessing
import os
import signal
import traceback
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from threading import Thread
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

from swarmtwin.errors import UserError

Result = TypeVar("Result", covariant=True)
Report = Callable[..., None]


class Job(Protocol[Result]):
    """Something to do with one seed, in a process of its own: it and its result can be pickled."""

    @property
    def seed(self) -> int:
        """The seed, by which the job is known."""

    def run(self, report: Report | None) -> Result:
        """Do it, calling `report` now and then."""


class _Done(NamedTuple):
    result: Any


def run_side_by_side(
    jobs: Sequence[Job[Result]], report: Report | None, processes: int | None, preload: str
) -> list[Result]:
    """Run jobs, `processes` at a time; None: as many as there are cores. One at a time runs in this process.

    Args:
        jobs: in the order of the results.
        report: called here with what the jobs report.
        processes: how many at a time.
        preload: the module with all that the jobs need, imported once for all processes.

    Raises:
        UserError: a process was killed.
        Exception: a job raised it.
    """
    at_a_time = min(len(jobs), processes or len(os.sched_getaffinity(0)))
    if at_a_time <= 1:
        return [job.run(report) for job in jobs]
    waiting, workers = list(enumerate(jobs)), list[_Worker[Any]]()
    results: dict[int, Result] = {}
    try:
        while waiting or workers:
            while waiting and len(workers) < at_a_time:
                workers.append(_Worker(*waiting.pop(0), preload))
            ready = wait([worker.messages for worker in workers])
            for worker in [worker for worker in workers if worker.messages in ready]:
                message = worker.receive()
                if isinstance(message, _Done):
                    results[worker.number] = message.result
                    worker.process.join()
                    workers.remove(worker)
                elif report:
                    report(*message)
    finally:
        for worker in workers:
            worker.process.kill()
            worker.process.join()
    return [results[number] for number in range(len(jobs))]


class _Worker(Generic[Result]):
    """A process that runs the job with this number, and the end of the pipe on which it tells of it."""

    def __init__(self, number: int, job: Job[Result], preload: str) -> None:
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload([preload])
        self.number, self.seed = number, job.seed
        self.messages, sender = context.Pipe(duplex=False)
        self.process: BaseProcess = context.Process(target=_work, args=(job, sender), daemon=True)
        self.process.start()
        sender.close()

    def receive(self) -> Any:
        """Wait for its next message: the arguments of a report, or its result as the last one."""
        try:
            message = self.messages.recv()
        except (EOFError, OSError):
            self.process.join()
            raise UserError(
                f"seed {self.seed}: its process ended with exit code {self.process.exitcode}, as when memory runs out: "
                "make room and run the same command again"
            ) from None
        if isinstance(message, Exception):
            raise message
        return message


def _work(job: Job[Any], sender: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group: the parent ends its workers
    Thread(target=_end_with_parent, daemon=True).start()
    try:
        sender.send(_Done(job.run(lambda *told: sender.send(told))))
    except Exception as error:
        error.add_note(traceback.format_exc())
        sender.send(error)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
