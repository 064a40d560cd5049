"""Processes of our own: told what to do over a pipe, which nobody else reads, and gone when their parent is."""

import json
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any

from swarmtwin.errors import UserError


class ChildProcess:
    """A module of this package that runs as a process of its own. Ctrl-C reaches the parent alone.

    Attributes:
        module: its full name.
        pid: of the process.
    """

    def __init__(self, module: str, told: Mapping[str, Any], descriptors: Sequence[int] = ()) -> None:
        """Start it; `wait_until_ready` before it is used.

        Args:
            module: its full name.
            told: what it is told, as JSON can hold it.
            descriptors: files of this process that it inherits.
        """
        self.module = module
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", module],  # -P: no file of the current folder stands in for a library
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
            pass_fds=tuple(descriptors),
        )
        self.pid = self._process.pid
        assert self._process.stdin
        self._process.stdin.write(json.dumps(told).encode() + b"\n")
        self._process.stdin.flush()

    @property
    def is_running(self) -> bool:
        """Whether it has not ended, though it may be frozen."""
        return self._process.poll() is None

    def wait_until_ready(self, timeout_s: float = 60.0) -> dict[str, Any]:
        """Return what it says when it is ready.

        Raises:
            UserError: it cannot do what it was told, and says why.
            RuntimeError: it ended or froze without a word.
        """
        assert self._process.stdout
        readable, _, _ = select.select([self._process.stdout], [], [], timeout_s)
        line = self._process.stdout.readline() if readable else b""
        if not line:
            self.end()
            raise RuntimeError(f"{self.module} did not start")
        said: dict[str, Any] = json.loads(line)
        if "mistake" in said:
            self.end()
            raise UserError(said["mistake"])
        return said

    def end(self, timeout_s: float = 2.0) -> None:
        """End it, frozen or not; twice does no harm."""
        assert self._process.stdin
        assert self._process.stdout
        if self.is_running:
            self._process.send_signal(signal.SIGCONT)
        self._process.stdin.close()
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()


def told_by_parent() -> dict[str, Any]:
    """Return, in a child process, what the parent told it; from now on the process ends when its parent does."""
    told: dict[str, Any] = json.loads(sys.stdin.buffer.readline())
    threading.Thread(target=_end_with_parent, daemon=True).start()
    return told


def say_ready(**what: Any) -> None:
    """Tell the parent that all is ready."""
    print(json.dumps({"ready_s": time.monotonic(), **what}), flush=True)


def say_mistake(error: UserError) -> None:
    """Tell the parent what the user can put right."""
    print(json.dumps({"mistake": str(error)}), flush=True)


def _end_with_parent() -> None:
    while os.read(sys.stdin.fileno(), 4096):
        pass
    os._exit(0)
