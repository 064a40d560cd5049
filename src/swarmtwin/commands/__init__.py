"""The console script `swarmtwin`: one Hydra app a command, each imported only when it is called."""

import gc
import os
import signal
import sys
from types import FrameType

HELP = """swarmtwin: learn one robot's motion from its recording, and simulate the group

usage: swarmtwin COMMAND [option=value ...]        one run
       swarmtwin COMMAND -m option=a,b,c [...]     a sweep, one run each
       swarmtwin COMMAND --help                    a command's options and their defaults

commands:
{commands}

Options stand in conf/<command>.yaml and the folders beside it; a folder of your own is added by --config-dir=DIR.
A shell completes them after: eval "$(swarmtwin --shell-completion install=bash)"
"""


def main() -> None:
    """Run the command named by the first argument; explain what there is when none is."""
    for interrupt in (signal.SIGINT, signal.SIGTERM):  # before anything is imported that takes longer
        if signal.getsignal(interrupt) is not signal.SIG_IGN:
            signal.signal(interrupt, _leave)
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
    if arguments[0] in ("--shell-completion", "-sc"):
        arguments = _completing(arguments[1:])
    name = arguments[0]
    if name not in COMMANDS:
        print(f"swarmtwin: unknown command {name!r}: {near_miss(name, COMMANDS)}", file=sys.stderr)
        sys.exit(2)
    from swarmtwin.commands.preloaded import ask

    if (answer := ask(arguments)) is not None:
        sys.exit(answer)
    gc.disable()  # what is imported stays: to look through it again and again took a quarter of a command's start
    from swarmtwin.commands.app import answer_interrupts, run_command

    try:
        status = int(run_command(name, arguments[1:]))
    except KeyboardInterrupt:  # another one, while the first was answered
        status = 130
    answer_interrupts(signal.SIG_IGN)
    sys.exit(status)


def _completing(asked: list[str]) -> list[str]:
    """Answer a shell that completes what is typed; return the call that has to answer, where this has not been all."""
    from swarmtwin.commands.shell_completion import complete
    from swarmtwin.errors import UserError

    try:
        call = complete(asked)
    except UserError as error:
        print(f"swarmtwin: {error}", file=sys.stderr)
        sys.exit(2)
    if call is None:
        sys.exit(0)
    return [call[0], *call[1]]


def _leave(signal_number: int, frame: FrameType | None) -> None:
    """End at once, as long as packages are imported and nothing has begun: an import may swallow KeyboardInterrupt."""
    os.write(2, b"swarmtwin: interrupted before anything had begun\n")
    os._exit(130)
