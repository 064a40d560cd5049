"""The journal: nothing of it is lost by a kill, and no room for it is told before anything moves."""

import errno
import json
import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
import yaml

from swarmtwin.deploy.control.deployment_recording import ABOUT, read_runs, write_deployment
from swarmtwin.deploy.control.journal import JOURNAL, Journal, JournalError, read_journal
from swarmtwin.deploy.control.recovery import left_by_a_kill, recover
from swarmtwin.deploy.tracking.sighting import Sighting
from swarmtwin.errors import UserError
from swarmtwin.files import CHECKPOINTS
from swarmtwin.recordings.reading import read_recording
from swarmtwin.recordings.recording import Header
from tiny_policies import robot_named

HEADER = {"robot": "mgr", "period_s": 0.5, "arena_mm": {"x": [0, 1030], "y": [0, 1030]}, "source": "a test"}


def test_lines_come_back_in_order_from_many_threads(tmp_path):
    journal = Journal(tmp_path / JOURNAL, 2**16)

    def write(name):
        for number in range(50):
            journal.write("line", name=name, number=number, values=np.arange(3) + 0.5)

    threads = [threading.Thread(target=write, args=(name,)) for name in "abc"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    before = list(read_journal(journal.path))
    journal.close()
    after = list(read_journal(journal.path))
    assert before == after
    for name in "abc":
        assert [line["number"] for line in after if line["name"] == name] == list(range(50))
    assert journal.path.stat().st_size < 2**16
    assert after[0]["values"] == [0.5, 1.5, 2.5]


def test_no_room_is_told_before_anything_moves(tmp_path, monkeypatch):
    def full(descriptor, start, length):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(UserError, match=r"no room for the recording, 0\.1 MiB in .*: No space left"):
        Journal(tmp_path / JOURNAL, 2**17)
    assert not (tmp_path / JOURNAL).exists()


def test_what_was_reserved_is_written_however_full_the_disk_becomes(tmp_path):
    """On a file system of its own where that is allowed, filled to the last byte."""
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", disk], capture_output=True).returncode:
        pytest.skip("mounting is not allowed")
    try:
        with pytest.raises(UserError, match="no room"):
            Journal(disk / JOURNAL, 2**21)
        journal = Journal(disk / JOURNAL, 2**18)
        with pytest.raises(OSError, match="No space left"):
            (disk / "filler").write_bytes(bytes(2**20))
        for number in range(1000):
            journal.write("line", number=number, text="x" * 200)
        assert sum(1 for _ in read_journal(journal.path)) == 1000
        with pytest.raises(JournalError, match="cannot be written"):
            write_on(journal)
        journal.close()
    finally:
        subprocess.run(["umount", disk], check=True)


def write_on(journal):
    for _ in range(1000):
        journal.write("line", text="x" * 200)


WRITER = """
import sys, time
from pathlib import Path
import numpy as np
from swarmtwin.deploy.control.journal import Journal
from swarmtwin.deploy.tracking.sighting import Sighting
folder = Path(sys.argv[1])
journal = Journal(folder / "journal.jsonl", 2**20)
journal.write("run", name="run_001")
start = time.monotonic()
for tick in range(10_000):
    now = start + 0.5 * tick
    for late in (0.0, 0.01):
        pose = np.array([300.0 + tick, 400 + 5 * np.sin(tick), 0.1 * np.sin(tick)])
        journal.sighting(Sighting(tick, now + late, {"1": pose}))
    journal.write("sending", tick=tick, now_s=now + 0.004, sent={"1": [50.0, 60.0]})
    journal.write("period", tick=tick, due_s=now, sent_s=now + 0.005, vehicles=["1"], captured_s=[now],
                  pose=[[300.0 + tick, 400.0, 0.0]], predicted=[[0, 0, 0]], requested=[[70.0, 60.0]],
                  sent=[[50.0, 60.0]], reason=["weakened"], alarm=[0.0])
    print(tick, flush=True)
    time.sleep(0.001)
"""


def test_a_kill_loses_no_row_and_the_recording_is_made_from_what_is_left(tmp_path):
    output = tmp_path / "out"
    folder = tmp_path / ".out.partial" / CHECKPOINTS
    folder.mkdir(parents=True)
    about = {"robot": robot_named("mgr").model_dump(mode="json"), "recording": HEADER, "vehicles": ["1"]}
    (folder / ABOUT).write_text(yaml.safe_dump(about))
    writer = subprocess.Popen([sys.executable, "-c", WRITER, str(folder)], stdout=subprocess.PIPE, text=True)
    last = -1
    until_s = time.monotonic() + 10
    while last < 120 and time.monotonic() < until_s:
        last = int(writer.stdout.readline())
    writer.send_signal(signal.SIGKILL)
    rest = writer.stdout.read().split()
    last = int(rest[-1]) if rest else last
    writer.wait()
    writer.stdout.close()
    assert left_by_a_kill(output)
    recover(output)
    assert left_by_a_kill(output) is None
    tracks = read_recording(output, robot_named("mgr")).tracks  # a long run comes in blocks
    time_s, pose = (np.concatenate([getattr(track, name) for track in tracks]) for name in ("time_s", "pose"))
    assert last + 1 <= len(time_s) <= last + 2
    known = np.isfinite(pose[:, 0])
    assert known[:-1].all()
    assert pose[known, 0] == pytest.approx(300 + time_s[known] / 0.5, abs=0.05)
    assert yaml.safe_load((output / ABOUT).read_text())["outcome"]["ending"] == "stopped"
    with pytest.raises(UserError, match="there is nothing to recover"):
        recover(output)


def test_a_command_that_was_about_to_be_sent_is_a_row_and_repeated_zeros_are_one_a_period(tmp_path):
    journal = Journal(tmp_path / JOURNAL, 2**18)
    journal.write("run", name="run_001")
    for number in range(150):
        journal.sighting(
            Sighting(
                number, 0.02 * number, {"1": np.array([100.0 + number, 200.0 + np.sin(number), 0.1 * np.cos(number)])}
            )
        )
    for tick in range(2):
        common = {"tick": tick, "sent": [[50.0, 60.0]], "requested": [[50.0, 60.0]], "reason": [""]}
        journal.write("sending", tick=tick, now_s=0.5 * tick, sent={"1": [50.0, 60.0]})
        journal.write("period", sent_s=0.5 * tick + 0.001, vehicles=["1"], **common)
    journal.write("sending", tick=2, now_s=1.0, sent={"1": [10.0, 10.0]})
    for number in range(30):
        journal.write("stop", sent_s=1.1 + 0.05 * number, sent={"1": [0.0, 0.0]}, reason="a test")
    journal.close()
    [run] = read_runs(tmp_path)
    assert len(run.sent["1"]) == 33
    write_deployment(tmp_path, robot_named("mgr"), Header(**HEADER))
    [track] = read_recording(tmp_path, robot_named("mgr")).tracks
    assert track.time_s == pytest.approx([0.001, 0.501, 1.0, 1.1, 1.6, 2.1], abs=2e-3)
    assert (track.command[3:] == 0).all()
    assert json.dumps(track.command[2].tolist()) == "[10.0, 10.0]"
