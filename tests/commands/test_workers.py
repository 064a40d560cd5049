"""Processes beside a command: their errors are told once, and they end when it ends, whichever way."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from swarmtwin.commands.workers import work_side_by_side
from swarmtwin.errors import UserError

LONGEST_WAIT_S = 60.0
PARENT = """
from pathlib import Path
from test_workers import linger
from swarmtwin.commands.workers import work_side_by_side

if __name__ == "__main__":
    work_side_by_side(linger, [(Path({folder!r}), name) for name in ("one", "two")])
"""


def write(folder, name):
    (folder / name).write_text(str(os.getpid()))


def refuse(folder, name):
    write(folder, name)
    raise UserError(f"no {name} here: try another")


def die(folder, name):
    if name == "one":
        os._exit(3)
    write(folder, name)


def linger(folder, name):
    write(folder, name)
    time.sleep(10 * LONGEST_WAIT_S)


def calls(folder):
    return [(folder, "one"), (folder, "two")]


def wait_until(true):
    end = time.monotonic() + LONGEST_WAIT_S
    while not true():
        assert time.monotonic() < end
        time.sleep(0.05)


def alive(process):
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_each_call_has_a_process_of_its_own(tmp_path):
    work_side_by_side(write, calls(tmp_path))
    processes = {(tmp_path / name).read_text() for name in ("one", "two")}
    assert len(processes | {str(os.getpid())}) == 3


def test_an_error_in_every_process_is_raised_once(tmp_path, capfd):
    with pytest.raises(UserError, match=r"^no (one|two) here: try another$"):
        work_side_by_side(refuse, calls(tmp_path))
    assert capfd.readouterr().err == ""


def test_the_others_go_on_where_a_process_dies(tmp_path, caplog):
    work_side_by_side(die, calls(tmp_path))
    assert (tmp_path / "two").exists()
    assert "1 of 2 processes failed, the others did the work" in caplog.messages
    with pytest.raises(UserError, match=r"^every process failed \(exit status 3\)$"):
        work_side_by_side(die, calls(tmp_path)[:1])


@pytest.mark.parametrize("ending", [signal.SIGKILL, signal.SIGINT])
def test_no_process_outlives_the_command(tmp_path, ending):
    script = tmp_path / "parent.py"
    script.write_text(PARENT.format(folder=str(tmp_path)))
    paths = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    parent = subprocess.Popen([sys.executable, script], env=paths, stderr=subprocess.PIPE, text=True)
    files = [tmp_path / "one", tmp_path / "two"]
    wait_until(lambda: all(file.exists() and file.read_text() for file in files))
    workers = [int(file.read_text()) for file in files]
    assert all(alive(worker) for worker in workers)
    parent.send_signal(ending)
    parent.wait(LONGEST_WAIT_S)
    wait_until(lambda: not any(alive(worker) for worker in workers))
