"""Jobs that run side by side in joblib's processes, which tell how far they are and never outlive this one."""

import _thread
import contextlib
import multiprocessing
import os
import signal
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import AuthenticationError
from multiprocessing.connection import Client, Listener
from pathlib import Path
from threading import Thread
from typing import Any, NamedTuple, Protocol, TypeVar

from joblib import Parallel, cpu_count, delayed
from joblib.externals.loky.backend.context import set_start_method

from swarmtwin.errors import UserError

PACKAGES = (
    *("torch", "torch._dynamo", "lightning", "pandas", "scipy.optimize", "scipy.stats", "stable_baselines3"),
    *("numba", "numba.np.arraymath", "numba.np.npyimpl"),
)
"""What most jobs import; the modules of the jobs themselves are imported as well."""

Result = TypeVar("Result", covariant=True)
Report = Callable[..., None]


class Job(Protocol[Result]):
    """Something to do in a process of its own: it and its result can be pickled."""

    def run(self, report: Report | None) -> Result:
        """Do it, calling `report` now and then with what can be pickled."""


def cores() -> int:
    """Return how many cores this process may use; the environment variable LOKY_MAX_CPU_COUNT may allow it fewer."""
    return int(cpu_count())


def run_side_by_side(jobs: Sequence[Job[Result]], report: Report | None, processes: int | None) -> list[Result]:
    """Run jobs, `processes` at a time; None: as many as there are cores. One at a time runs in this process.

    Args:
        jobs: in the order of the results.
        report: called in this process with what the jobs report, one call at a time; what it raises ends the jobs.
        processes: how many at a time.

    Raises:
        UserError: a process was killed.
        Exception: a job or the report raised it.
    """
    at_a_time = min(len(jobs), processes or cores())
    if at_a_time <= 1:
        return [job.run(report) for job in jobs]
    started_in = (str(Path.cwd()), tuple(os.environ.items()))  # where these changed, processes start anew
    with _Listening(report) as listening:
        calls = [delayed(_work)(job, listening.door if report else None) for job in jobs]
        pool = Parallel(at_a_time, "loky", batch_size=1, max_nbytes=None, initializer=_begin, initargs=started_in)
        try:
            with _forked_from_one(jobs), warnings.catch_warnings():
                # joblib replaces a process that grew large, between two jobs
                warnings.filterwarnings("ignore", "A worker stopped while some jobs", UserWarning)
                return list(pool(calls))
        except BrokenProcessPool:
            raise UserError(
                "a process that worked for this command was killed, as when memory runs out: make room and run the "
                "same command again"
            ) from None
        except KeyboardInterrupt:
            raise listening.failure or KeyboardInterrupt from None


@contextlib.contextmanager
def _forked_from_one(jobs: Sequence[Job[Any]]) -> Iterator[None]:
    """Let joblib fork its processes, as long as the block lasts, from one that has imported what takes seconds.

    That one was started anew for the first jobs, so that no thread and no GPU of this process is copied; it ends with
    this one.
    """
    modules = {type(job).__module__ for job in jobs} - {"__main__"}
    multiprocessing.set_forkserver_preload([*PACKAGES, *sorted(modules)])
    set_start_method("forkserver", force=True)
    try:
        yield
    finally:
        set_start_method("loky", force=True)


class _Door(NamedTuple):
    """Where a process delivers its reports."""

    address: str
    key: bytes

    def deliver(self, *message: Any) -> None:
        """Deliver a report, and wait until it has been heard."""
        with Client(self.address, authkey=self.key) as connection:
            connection.send(message)
            connection.recv()


class _Listening:
    """Calls `report` with what processes deliver, in a thread of its own, while the block runs."""

    def __init__(self, report: Report | None) -> None:
        self.failure: BaseException | None = None
        self._report = report
        key = os.urandom(32)
        self._listener = Listener(family="AF_UNIX", authkey=key)
        self.door = _Door(str(self._listener.address), key)
        self._thread = Thread(target=self._listen, daemon=True)

    def __enter__(self) -> "_Listening":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.door.deliver()
        self._thread.join()
        self._listener.close()

    def _listen(self) -> None:
        while True:
            try:
                with self._listener.accept() as connection:
                    message = connection.recv()
                    if message and self._report and self.failure is None:
                        self._call(message)
                    connection.send(None)
            except (OSError, EOFError, AuthenticationError):  # its sender was killed
                continue
            if not message:
                return

    def _call(self, message: tuple[Any, ...]) -> None:
        assert self._report is not None
        try:
            self._report(*message)
        except BaseException as failure:
            self.failure = failure
            _thread.interrupt_main()


def _begin(folder: str, environment: tuple[tuple[str, str], ...]) -> None:
    """Prepare a process: it leaves Ctrl-C, which reaches the whole group, to its parent, and ends when that ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    Thread(target=watch, daemon=True).start()


def _work(job: Job[Result], door: _Door | None) -> Result:
    return job.run(door.deliver if door else None)
