"""Processes that need not import packages for seconds: forks of one that has imported them.

What the environment variable RUN_FIRST holds is run as Python before the program, in its process.
"""

import contextlib
import os
import subprocess
import sys
import time
import traceback
from collections.abc import Iterator
from pathlib import Path

from swarmtwin.commands import preloaded

PROGRAM = """#!{python} -IS
import os, sys
sys.path.insert(0, {source!r})
os.environ["SWARMTWIN_PRELOADED"] = {address!r}
{call}
"""
SERVER = """
import os, sys
from swarmtwin.commands import preloaded
preloaded.PACKAGES = {packages!r}
preloaded.serve({address!r})
exec(os.environ.pop("RUN_FIRST", ""))
{call}
"""
SWARMTWIN = "from swarmtwin.commands import main; main()"
DVC = "from dvc.cli import main; sys.exit(main(sys.argv[1:]))"
DVC_PACKAGES = (
    *("dvc.cli.parser", "dvc.repo.reproduce", "dvc.repo.status", "dvc.repo.metrics.show", "dvc.repo.experiments.run"),
    *("dvc.repo.index", "dvc.stage.run", "dvc.output", "dvc.api", "dvc_data.index", "dulwich.repo"),
)
ASK = "from swarmtwin.commands.preloaded import ask; sys.exit(ask(sys.argv[1:]))"


@contextlib.contextmanager
def preloaded_program(program: Path, source: Path, packages: tuple[str, ...] = preloaded.PACKAGES) -> Iterator[None]:
    """Write an executable `program` that runs the swarmtwin in the folder `source`, as long as the block lasts.

    For tests that call it often: each call is a fork of a process that has imported its packages.
    """
    with _served(program, source, packages, SWARMTWIN, SWARMTWIN):
        yield


@contextlib.contextmanager
def preloaded_dvc(program: Path, source: Path) -> Iterator[None]:
    """Write an executable `program` that runs DVC likewise."""
    with _served(program, source, DVC_PACKAGES, DVC, ASK):
        yield


@contextlib.contextmanager
def _served(program: Path, source: Path, packages: tuple[str, ...], served: str, call: str) -> Iterator[None]:
    address = program.with_name(f"{program.name}.preloaded")
    program.write_text(PROGRAM.format(python=sys.executable, address=str(address), source=str(source), call=call))
    program.chmod(0o755)
    server_code = SERVER.format(packages=packages, address=str(address), call=served)
    with subprocess.Popen([sys.executable, "-c", server_code]) as server:
        try:
            while not address.exists():
                assert server.poll() is None, "the process with the packages has ended"
                time.sleep(0.1)
            yield
        finally:
            server.terminate()


def run_forked(script: str) -> int:
    """Run Python code in a fork of this process; return its exit status, below 0 where a signal ended it.

    Of swarmtwin nothing is imported in it before: what modules here remember the fork does not know.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    if process := os.fork():
        return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    status = 1
    try:
        for name in [name for name in sys.modules if name.partition(".")[0] == "swarmtwin"]:
            del sys.modules[name]
        exec(compile(script, "script", "exec"), {})
        status = 0
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
