"""The console script `swarmtwin`: one Hydra app a command, each imported only when it is called."""

import os
import signal
import sys
from collections.abc import Callable
from types import FrameType

HELP = """swarmtwin: learn one robot's motion from its recording, and simulate the group

usage: swarmtwin COMMAND [option=value ...]        one run
       swarmtwin COMMAND -m option=a,b,c [...]     a sweep, one run each
       swarmtwin COMMAND --help                    a command's options and their defaults

commands:
{commands}

Options stand in conf/<command>.yaml and the folders beside it; a folder of your own is added by --config-dir=DIR.
"""


def main() -> None:
    """Run the command named by the first argument; explain what there is when none is."""
    answer_interrupts(_leave)  # before anything is imported that takes longer
    from swarmtwin import __version__
    from swarmtwin.commands.catalogue import COMMANDS
    from swarmtwin.errors import near_miss

    arguments = sys.argv[1:]
    if not arguments or arguments[0] in ("--help", "-h", "help"):
        print(HELP.format(commands="\n".join(f"  {name:<12}{entry.summary}" for name, entry in COMMANDS.items())))
        return
    if arguments[0] in ("--version", "version"):
        print(f"swarmtwin {__version__}")
        return
    name = arguments[0]
    if name not in COMMANDS:
        print(f"swarmtwin: unknown command {name!r}: {near_miss(name, COMMANDS)}", file=sys.stderr)
        sys.exit(2)
    from swarmtwin.commands.app import run_command

    try:
        status = int(run_command(name, arguments[1:]))
    except KeyboardInterrupt:  # another one, while the first was answered
        status = 130
    answer_interrupts(signal.SIG_IGN)
    sys.exit(status)


def answer_interrupts(handler: Callable[[int, FrameType | None], None] | signal.Handlers) -> None:
    """Let a handler answer Ctrl-C and SIGTERM; a process that was started to ignore Ctrl-C goes on doing so."""
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, handler)
    signal.signal(signal.SIGTERM, handler)


def _leave(signal_number: int, frame: FrameType | None) -> None:
    """End at once, as long as packages are imported and nothing has begun: an import may swallow KeyboardInterrupt."""
    os.write(2, b"swarmtwin: interrupted before anything had begun\n")
    os._exit(130)
