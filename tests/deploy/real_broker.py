"""A real broker for the tests: mosquitto, started as a user on a free port."""

import getpass
import signal
import socket
import subprocess
import time
from pathlib import Path

from swarmtwin.deploy.link.broker import Broker


def free_port():
    """A port that nobody listens at now."""
    with socket.socket() as trial:
        trial.bind(("127.0.0.1", 0))
        return trial.getsockname()[1]


def wait_until(holds, timeout_s=5.0):
    """Wait until a condition holds; return whether it did in time."""
    end_s = time.monotonic() + timeout_s
    while not (held := holds()) and time.monotonic() < end_s:
        time.sleep(0.005)
    return held


class Mosquitto:
    """A mosquitto that can be stopped, started again, frozen and thawed; `options` are lines of its configuration."""

    def __init__(self, folder, *options):
        self.port = free_port()
        self.address = f"mqtt://127.0.0.1:{self.port}"
        self.broker = Broker(host="127.0.0.1", port=self.port)
        self._file = Path(folder) / "mosquitto.conf"
        anonymous = [] if any("allow_anonymous" in option for option in options) else ["allow_anonymous true"]
        lines = [f"listener {self.port} 127.0.0.1", f"user {getpass.getuser()}", *anonymous, *options]
        self._file.write_text("\n".join([*lines, ""]))
        self.start()

    def start(self):
        self._process = subprocess.Popen(["mosquitto", "-c", self._file], stderr=subprocess.DEVNULL)
        assert wait_until(self._listens), "mosquitto does not start"

    def stop(self):
        self._process.terminate()
        self._process.wait()

    def freeze(self):
        self._process.send_signal(signal.SIGSTOP)

    def thaw(self):
        self._process.send_signal(signal.SIGCONT)

    def _listens(self):
        with socket.socket() as trial:
            return trial.connect_ex(("127.0.0.1", self.port)) == 0
