"""Processes that work side by side for a command, and never outlive it."""

import logging
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from multiprocessing.queues import SimpleQueue
from typing import Any

from swarmtwin.errors import UserError

logger = logging.getLogger(__name__)

GRACE_S = 10.0


def work_side_by_side(work: Callable[..., None], arguments: Sequence[tuple[Any, ...]]) -> None:
    """Call `work` with each of `arguments`, each in a process of its own, until all return.

    When this process ends, in whichever way, the others end too: they hear the end of a pipe that it alone holds open.

    Raises:
        UserError: as one of the calls raised it (likewise OSError and MemoryError), or every process failed.
    """
    context = multiprocessing.get_context("spawn")
    lifeline, held_open = context.Pipe(duplex=False)
    failures = context.SimpleQueue()
    processes = [context.Process(target=_work, args=(work, given, lifeline, failures)) for given in arguments]
    started = []
    try:
        for process in processes:
            process.start()
            started.append(process)
        for process in started:
            process.join()
        if not failures.empty():
            raise failures.get()
    finally:
        held_open.close()
        for process in started:
            process.join(GRACE_S + 1)
        lifeline.close()
    died = [process.exitcode for process in processes if process.exitcode]
    if len(died) == len(processes):
        raise UserError(f"every process failed (exit status {', '.join(map(str, died))})")
    if died:
        logger.warning("%d of %d processes failed, the others did the work", len(died), len(processes))


def _work(
    work: Callable[..., None], arguments: tuple[Any, ...], lifeline: Connection, failures: SimpleQueue[Exception]
) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _interrupt)
    threading.Thread(target=_end_with_parent, args=(lifeline,), daemon=True).start()
    try:
        work(*arguments)
    except (UserError, OSError, MemoryError) as error:
        failures.put(error)
    except KeyboardInterrupt:
        sys.exit(1)


def _interrupt(signal_number: int, frame: Any) -> None:
    raise KeyboardInterrupt


def _end_with_parent(lifeline: Connection) -> None:
    """Wait until the parent is gone; interrupt this process then, and end it should it not heed that."""
    lifeline.poll(None)
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(GRACE_S)
    os._exit(1)
