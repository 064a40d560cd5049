"""Commands as forks of one process that has imported the packages they compute with, which takes seconds a command.

`python -m swarmtwin.commands.preloaded ADDRESS` is such a process: `make run` has one. A `swarmtwin`
whose environment names its address hands over to it what it was called with: arguments, folder, environment, streams.
Ctrl-C and SIGTERM are passed on, and the exit status comes back. Of swarmtwin itself nothing is imported before: each
call finds it where it is, as it is by then.
"""

import contextlib
import gc
import importlib
import json
import os
import select
import signal
import socket
import sys
from collections.abc import Sequence
from pathlib import Path
from types import FrameType

ADDRESS = "SWARMTWIN_PRELOADED"
"""The environment variable that says where the process listens."""

LARGEST_CALL = 1 << 20
PACKAGES = (
    *(
        "torch",
        "torch._dynamo",
        "lightning",
        "safetensors.torch",
        "joblib",
        "optuna",
        "hydra",
        "pydantic",
    ),
    *(
        "mlflow",
        "mlflow.pyfunc",
        "mlflow.store.tracking.sqlalchemy_store",
        "alembic.command",
        "pandas",
        "pyarrow.parquet",
    ),
    *("scipy.optimize", "scipy.stats", "scipy.spatial", "sklearn.neighbors", "sklearn.ensemble", "matplotlib.pyplot"),
    *("stable_baselines3", "pettingzoo", "gymnasium", "cv2", "av", "jinja2", "rich.progress"),
)


def ask(arguments: Sequence[str]) -> int | None:
    """Let the preloaded process run `swarmtwin` with arguments; return the exit status, None where nobody answers."""
    if not (address := os.environ.get(ADDRESS)):
        return None
    source = str(Path(__file__).parents[2])
    call = json.dumps([list(arguments), source, str(Path.cwd()), dict(os.environ)]).encode()
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as server:
        try:
            server.connect(address)
            socket.send_fds(server, [call], [0, 1, 2])
        except OSError:  # it is no more
            return None

        def pass_on(number: int, frame: FrameType | None) -> None:
            with contextlib.suppress(OSError):
                server.send(str(number).encode())

        for interrupt in (signal.SIGINT, signal.SIGTERM):
            if signal.getsignal(interrupt) is not signal.SIG_IGN:
                signal.signal(interrupt, pass_on)
        return int(server.recv(16) or b"1")


def serve(address: str) -> None:
    """Answer calls until the process that started this one ends; return in each process forked for a call.

    onnxruntime is not imported before: it starts threads, and waits at its end for them, which a fork has not.
    """
    started_by = os.getppid()
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(address)
        listener.listen()
        listener.settimeout(1)
        with contextlib.suppress(OSError):
            os.setsid()  # Ctrl-C reaches those who call, and they pass it on
        for package in PACKAGES:
            importlib.import_module(package)
        gc.freeze()
        signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for those who wait
        while os.getppid() == started_by:
            with contextlib.suppress(TimeoutError):
                connection, _ = listener.accept()
                if os.fork() == 0:
                    break
                connection.close()
        else:
            sys.exit()
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    connection.setblocking(True)
    message, streams, _, _ = socket.recv_fds(connection, LARGEST_CALL, 3)
    if process := os.fork():
        _look_after(process, connection)
    connection.close()
    _become(message, streams)


def _look_after(process: int, caller: socket.socket) -> None:
    """Pass signals on from the caller to the process that runs its command, and tell how that ended; never return."""
    while os.waitid(os.P_PID, process, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None:
        if select.select([caller], [], [], 0.02)[0]:
            number = caller.recv(16)
            os.kill(process, int(number or signal.SIGTERM))
            if not number:  # the caller is no more
                break
    status = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    with contextlib.suppress(OSError):
        caller.sendall(str(status if status >= 0 else 128 - status).encode())
    os._exit(0)


def _become(message: bytes, streams: Sequence[int]) -> None:
    """Be as the `swarmtwin` that was called before it has begun."""
    arguments, source, folder, environment = json.loads(message)
    for number, stream in enumerate(streams):
        os.dup2(stream, number)
        os.close(stream)
    os.environ.clear()
    os.environ.update({name: value for name, value in environment.items() if name != ADDRESS})
    os.chdir(folder)
    for interrupt in (signal.SIGINT, signal.SIGTERM):
        signal.signal(interrupt, signal.default_int_handler if interrupt == signal.SIGINT else signal.SIG_DFL)
    for name in [name for name in sys.modules if name.partition(".")[0] == "swarmtwin"]:
        del sys.modules[name]
    sys.path.insert(0, source)
    sys.argv = ["swarmtwin", *arguments]


def run(address: str) -> None:
    """Serve; in each process forked for a call, run the command that was called."""
    serve(address)
    importlib.import_module("swarmtwin.commands").main()


if __name__ == "__main__":
    run(sys.argv[1])
