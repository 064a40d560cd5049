"""A command in a process of its own, with what it costs."""

import os
import resource
import subprocess
import sys
import time

COMMAND = """
import resource, sys
from swarmtwin.commands.app import run_command
status = run_command(sys.argv[1], sys.argv[2:])
print("peak", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
sys.exit(status)
"""


def called(folder, *arguments, command=COMMAND):
    """Run a command in a process of its own; return its seconds of CPU, seconds, and peak of memory in MiB."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    answer = subprocess.run(
        [sys.executable, "-c", command, *arguments], cwd=folder, env=environment, capture_output=True, text=True
    )
    after, took_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter() - began
    assert answer.returncode == 0, answer.stderr
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return cpu_s, took_s, float(answer.stdout.split()[-1])
