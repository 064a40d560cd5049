"""`swarmtwin` for tests that call it often: each call is a fork of one process that has imported the packages it needs.

Importing them takes seconds a call. Of swarmtwin itself nothing is imported before: each call finds it in the folder
that its program names, as it is there by then.
"""

import contextlib
import importlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

PACKAGES = (
    *("torch", "lightning", "mlflow", "mlflow.pyfunc", "mlflow.store.tracking.sqlalchemy_store", "matplotlib.pyplot"),
    *("scipy.optimize", "scipy.stats", "pandas", "pyarrow.parquet", "hydra", "pydantic", "rich.console", "optuna"),
)
PROGRAM = """#!{python} -IS
import json, os, socket, sys
with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as server:
    server.connect({address!r})
    call = [sys.argv[1:], {source!r}, os.getcwd(), dict(os.environ)]
    socket.send_fds(server, [json.dumps(call).encode()], [0, 1, 2])
    sys.exit(int(server.recv(16) or b"1"))
"""
LARGEST_CALL = 1 << 20


@contextlib.contextmanager
def preloaded_program(program: Path, source: Path) -> Iterator[None]:
    """Write an executable `program` that runs the swarmtwin in the folder `source`, as long as the block lasts."""
    address = program.with_name("preloaded")
    program.write_text(PROGRAM.format(python=sys.executable, address=str(address), source=str(source)))
    program.chmod(0o755)
    with subprocess.Popen([sys.executable, __file__, str(address)], start_new_session=True) as server:
        try:
            while not address.exists():
                assert server.poll() is None, "the process with the packages has ended"
                time.sleep(0.1)
            yield
        finally:
            server.terminate()


def serve(address: str) -> None:
    """Answer calls until terminated; in the process forked for a call, return when all is as it should be for it."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(address)
        listener.listen()
        signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for those who wait
        while True:
            connection, _ = listener.accept()
            if os.fork() == 0:
                break
            connection.close()
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    message, streams, _, _ = socket.recv_fds(connection, LARGEST_CALL, 3)
    if process := os.fork():
        connection.sendall(str(os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])).encode())
        os._exit(0)
    connection.close()
    arguments, source, folder, environment = json.loads(message)
    for number, stream in enumerate(streams):
        os.dup2(stream, number)
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    sys.path.insert(0, source)
    sys.argv = ["swarmtwin", *arguments]


if __name__ == "__main__":
    for package in PACKAGES:
        importlib.import_module(package)
    serve(sys.argv[1])
    from swarmtwin.commands import main

    main()
