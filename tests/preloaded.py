"""`swarmtwin` for tests that call it often: each call is a fork of a process that has imported its packages."""

import contextlib
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from swarmtwin.commands import preloaded

PROGRAM = """#!{python} -IS
import os, sys
sys.path.insert(0, {source!r})
os.environ["SWARMTWIN_PRELOADED"] = {address!r}
from swarmtwin.commands import main
main()
"""


@contextlib.contextmanager
def preloaded_program(program: Path, source: Path, packages: tuple[str, ...] = preloaded.PACKAGES) -> Iterator[None]:
    """Write an executable `program` that runs the swarmtwin in the folder `source`, as long as the block lasts."""
    address = program.with_name("preloaded")
    program.write_text(PROGRAM.format(python=sys.executable, address=str(address), source=str(source)))
    program.chmod(0o755)
    serve = f"from swarmtwin.commands import preloaded as p; p.PACKAGES = {packages!r}; p.run({str(address)!r})"
    with subprocess.Popen([sys.executable, "-c", serve]) as server:
        try:
            while not address.exists():
                assert server.poll() is None, "the process with the packages has ended"
                time.sleep(0.1)
            yield
        finally:
            server.terminate()
