import dataclasses
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from swarmtwin.dynamics.model_config import config_class
from swarmtwin.dynamics.training import train
from swarmtwin.errors import UserError
from toy import recipe, toy_transitions

ENDLESS = config_class("mlp")(steps=10_000_000)
TRAINER = """
import signal, sys
sys.path[:0] = sys.argv[1:]
from test_seeds import BusyJob
from swarmtwin.dynamics.training import train_seeds
signal.signal(signal.SIGINT, signal.default_int_handler)
train_seeds([BusyJob(0), BusyJob(1)], lambda seed, number, epoch: print(seed, flush=True), processes=2)
"""


class BusyJob(NamedTuple):
    """A job that reports once and then never looks up again."""

    seed: int

    def run(self, report):
        report(self.seed, 1, None)
        while True:
            pass


@pytest.fixture(scope="module")
def transitions(robots):
    return toy_transitions(robots["mgr"], 600)


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
def test_no_process_outlives_its_trainer(fate):
    folder = Path(__file__).parent
    command = [sys.executable, "-c", TRAINER, str(folder), str(folder.parent)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True) as trainer:
        try:
            assert {trainer.stdout.readline(), trainer.stdout.readline()} == {"0\n", "1\n"}
            assert len(running_in_session(trainer.pid)) >= 3
            trainer.send_signal(fate)
            trainer.wait(timeout=30)
            deadline = time.monotonic() + 30  # busy jobs would go on for ever
            while running_in_session(trainer.pid) and time.monotonic() < deadline:
                time.sleep(0.05)
            assert not running_in_session(trainer.pid)
        finally:
            for process in running_in_session(trainer.pid):
                os.kill(process, signal.SIGKILL)


def test_an_interrupt_in_the_trainer_ends_the_workers(transitions):
    def interrupt(seed, number, epoch):
        assert len(multiprocessing.active_children()) == 2
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(transitions, ENDLESS, recipe(), [0, 1], report=interrupt, processes=2)
    assert not multiprocessing.active_children()


def test_a_worker_that_was_killed_is_told_of(transitions):
    def kill_all(seed, number, epoch):
        for process in multiprocessing.active_children():
            os.kill(process.pid, signal.SIGKILL)

    with pytest.raises(UserError, match=r"^a process that worked for this command was killed, as when memory"):
        train(transitions, ENDLESS, recipe(), [3, 4], report=kill_all, processes=2)


def test_what_a_worker_raises_is_raised_here(transitions):
    without_validation = dataclasses.replace(transitions, split=np.zeros(len(transitions), int))
    with pytest.raises(UserError, match=r"^the validation split has 0 transitions: "):
        train(without_validation, ENDLESS, recipe(), [0, 1], processes=2)
    assert not multiprocessing.active_children()
