"""A command handed over to a preloaded process is as one that runs by itself: output, status, folder, signals, code."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from preloaded import preloaded_program

REPOSITORY = Path(__file__).resolve().parents[2]
COMMAND = """
import os, sys, time

def main():
    from swarmtwin.commands.preloaded import ask
    if (answer := ask(sys.argv[1:])) is not None:
        sys.exit(answer)
    try:
        print(os.getpid(), flush=True)
        if sys.argv[1] == "wait":
            for _ in range(600):  # one long sleep goes on if the signal comes just before it
                time.sleep(0.1)
    except KeyboardInterrupt:
        print("interrupted", flush=True)
        sys.exit(130)
    print(sys.argv[1:], os.getcwd(), os.environ["ASKED"], sys.stdin.read(), flush=True)
    sys.exit(int(sys.argv[2]))
"""


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    """A `swarmtwin` whose preloaded process has imported nothing, and whose commands wait or tell what they see."""
    folder = tmp_path_factory.mktemp("preloaded")
    package = folder / "src" / "swarmtwin" / "commands"
    package.mkdir(parents=True)
    (package.parent / "__init__.py").touch()
    shutil.copy(REPOSITORY / "src" / "swarmtwin" / "commands" / "preloaded.py", package)
    (package / "__init__.py").write_text(COMMAND)
    with preloaded_program(folder / "swarmtwin", folder / "src", packages=()):
        yield folder / "swarmtwin"


def start(program, *arguments, **options):
    environment = {**os.environ, "ASKED": "what it was asked"}
    return subprocess.Popen(
        [program, *arguments], env=environment, stdout=subprocess.PIPE, stdin=subprocess.PIPE, text=True, **options
    )


def test_it_sees_what_its_caller_sees_and_its_status_comes_back(program, tmp_path):
    called = start(program, "see", "7", cwd=tmp_path)
    output, _ = called.communicate("typed")
    process, seen = output.splitlines()
    assert int(process) != called.pid
    assert seen == f"['see', '7'] {tmp_path} what it was asked typed"
    assert called.returncode == 7


def test_it_runs_the_code_that_is_there_by_then(program):
    file = program.parent / "src" / "swarmtwin" / "commands" / "__init__.py"
    before = file.read_text()
    file.write_text(before.replace("sys.argv[1:], os", "'changed', os"))
    output, _ = start(program, "see", "0").communicate("")
    file.write_text(before)
    assert "changed" in output


def test_an_interrupt_is_passed_on(program):
    called = start(program, "wait")
    called.stdout.readline()
    called.send_signal(signal.SIGINT)
    assert called.stdout.read() == "interrupted\n"
    assert called.wait() == 130


def test_it_ends_with_its_caller(program):
    called = start(program, "wait")
    process = int(called.stdout.readline())
    called.kill()
    called.wait()
    deadline = time.monotonic() + 10
    while Path(f"/proc/{process}").exists():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_a_command_runs_by_itself_where_nobody_listens(tmp_path):
    environment = {**os.environ, "SWARMTWIN_PRELOADED": str(tmp_path / "nobody")}
    call = "import sys; sys.argv[1:] = ['train', 'robot=nosuch']; from swarmtwin.commands import main; main()"
    answer = subprocess.run([sys.executable, "-c", call], env=environment, capture_output=True, text=True, check=False)
    assert answer.returncode == 2
    assert "no such robot" in answer.stderr
