"""The console script `swarmtwin`: one Hydra app a command, each imported only when it is called."""

import sys

from swarmtwin import __version__
from swarmtwin.commands.catalogue import COMMANDS
from swarmtwin.errors import near_miss

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
    try:
        from swarmtwin.commands.app import run_command

        sys.exit(run_command(name, arguments[1:]))
    except KeyboardInterrupt:  # while the packages are imported
        sys.exit(130)
