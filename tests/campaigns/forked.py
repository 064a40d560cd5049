"""Commands in processes forked from this one, which has imported everything: what a campaign starts again and again."""

import atexit
import contextlib
import os
import signal
import sys
import traceback
from collections.abc import Callable
from pathlib import Path

from swarmtwin import commands


def fork(arguments: list[str], folder: Path, place: Path) -> int:
    """Start a command in a process forked from this one, in a group and a folder of its own; return its id.

    It reads nothing; what it says is left in the files `shown` and `error` of `place`.
    """
    said = [os.open(place / name, os.O_CREAT | os.O_WRONLY | os.O_TRUNC) for name in ("shown", "error")]
    streams = [os.open(os.devnull, os.O_RDONLY), *said]
    process = os.fork()
    if process:
        for stream in streams:
            os.close(stream)
        with contextlib.suppress(OSError):  # both do it: whoever comes first
            os.setpgid(process, process)
        return process
    status = 1
    try:
        os.setpgid(0, 0)
        os.chdir(folder)
        for number, stream in enumerate(streams):
            os.dup2(stream, number)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        sys.argv = ["swarmtwin", *arguments]
        commands.main()
        status = 0
    except SystemExit as ending:
        status = int(ending.code or 0)
    except BaseException:
        traceback.print_exc()
    finally:
        atexit._run_exitfuncs()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    raise AssertionError


def in_a_child(work: Callable[[], None]) -> None:
    """Do something in a forked process, and wait for it: libraries' threads begun here would stop later forks."""
    process = os.fork()
    if not process:
        status = 1
        try:
            work()
            status = 0
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(status)
    _, how = os.waitpid(process, 0)
    if how:
        raise RuntimeError("a forked process has failed")
