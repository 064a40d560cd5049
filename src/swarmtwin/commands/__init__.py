"""The console script `swarmtwin`: one Hydra app a command, each imported only when it is called."""

import sys
from typing import NamedTuple

from swarmtwin import __version__
from swarmtwin.errors import near_miss


class Command(NamedTuple):
    """A command: the module in this package that runs it, and what it does in one line."""

    module: str
    summary: str


COMMANDS = {
    "record": Command("record", "stand-in robots drive; a recording results"),
    "import": Command("import_recording", "foreign data become a recording"),
    "prepare": Command("prepare", "a recording becomes transitions: checked, counted, split by run"),
    "generate": Command(
        "generate", "train a generator on real transitions and draw synthetic ones, or draw from a given one"
    ),
    "train": Command("train", "train a dynamics model on transitions or on a recording"),
    "evaluate": Command("evaluate", "a simulation model against measured runs: one-step, floor, open loop"),
    "tune": Command("tune", "search hyper-parameters with Optuna, several processes on one study"),
    "diagnose": Command("diagnose", "what a simulation gets wrong on measured data: cause, extended simulation, gain"),
    "learn": Command("learn", "learn a policy, shared by all vehicles, in the simulated world"),
    "rollout": Command("rollout", "a policy from the same starts in the simulation and on stand-ins, side by side"),
    "promote": Command("promote", "make a registered model the champion, if it passes the gate; or roll back"),
    "experiment": Command("experiment", "a table or figure of the paper, or an overview of the pipeline"),
}

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
