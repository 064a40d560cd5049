"""Jobs side by side: no process outlives the one that started it, whatever becomes of either."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import pytest

from busy_job import BriefJob, BusyJob
from swarmtwin.errors import UserError
from swarmtwin.learning.parallel import run_side_by_side

STARTER = """
import signal, sys
sys.path.insert(0, sys.argv[1])
from busy_job import BusyJob
from swarmtwin.learning import parallel
parallel.PACKAGES = ()
signal.signal(signal.SIGINT, signal.default_int_handler)
parallel.run_side_by_side([BusyJob(0), BusyJob(1)], lambda number: print(number, flush=True), 2)
"""


def running_in_session(session):
    """Process ids of a session's processes that still run."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, its_session = path.read_text().rpartition(")")[2].split()[:4]
        except (FileNotFoundError, ProcessLookupError):
            continue
        if int(its_session) == session and state != "Z":
            found.append(int(path.parent.name))
    return found


@pytest.mark.parametrize("fate", [signal.SIGINT, signal.SIGKILL])
def test_no_process_outlives_the_one_that_started_it(fate):
    command = [sys.executable, "-c", STARTER, str(Path(__file__).parents[1])]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True) as starter:
        try:
            assert {starter.stdout.readline(), starter.stdout.readline()} == {"0\n", "1\n"}
            assert len(running_in_session(starter.pid)) >= 3
            starter.send_signal(fate)
            starter.wait(timeout=30)
            deadline = time.monotonic() + 30  # busy jobs would go on for ever
            while running_in_session(starter.pid) and time.monotonic() < deadline:
                time.sleep(0.05)
            assert not running_in_session(starter.pid)
        finally:
            for process in running_in_session(starter.pid):
                os.kill(process, signal.SIGKILL)


def test_an_interrupt_while_jobs_report_ends_the_processes():
    def interrupt(number):
        assert len(multiprocessing.active_children()) == 2
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_side_by_side([BusyJob(0), BusyJob(1)], interrupt, 2)
    assert not multiprocessing.active_children()


def test_a_process_that_was_killed_is_told_of():
    def kill_all(number):
        for process in multiprocessing.active_children():
            os.kill(process.pid, signal.SIGKILL)

    with pytest.raises(UserError, match=r"^a process that worked for this command was killed, as when memory"):
        run_side_by_side([BusyJob(3), BusyJob(4)], kill_all, 2)


def test_nothing_is_said_of_a_process_that_joblib_replaces(recwarn):
    """It warns of that in a thread of its own, as here the reports are heard in one."""
    told = "A worker stopped while some jobs were given to the executor. This can be caused by a memory leak."
    run_side_by_side([BriefJob(0), BriefJob(1)], lambda number: warnings.warn(told, UserWarning, stacklevel=1), 2)
    assert not [one for one in recwarn if told in str(one.message)]
