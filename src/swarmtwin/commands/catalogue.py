"""Which commands there are."""

from typing import NamedTuple

from swarmtwin.extras import Extra


class Ranking(NamedTuple):
    """How the runs of a sweep are ordered: by figures of theirs, the lowest first or the highest; else not at all."""

    by: tuple[str, ...] = ()
    highest_first: bool = False


class Command(NamedTuple):
    """A command.

    Attributes:
        module: the module in this package that runs it.
        summary: what it does in one line.
        ranking: how a sweep's runs compare.
        extra: the part of swarmtwin that must be installed for it.
    """

    module: str
    summary: str
    ranking: Ranking = Ranking()
    extra: Extra = "train"


COMMANDS = {
    "new": Command("new", "a lab's own project: a robot's file, a first recording, a pipeline"),
    "doctor": Command("doctor", "what this machine has and lacks, and what to do about it", extra="base"),
    "record": Command("record", "stand-in robots drive; a recording results", extra="deploy"),
    "import": Command("import_recording", "foreign data become a recording", extra="base"),
    "calibrate": Command("calibrate", "where an overhead camera hangs, from the arena's four markers", extra="deploy"),
    "track": Command("track", "a video and the commands that were sent become a recording", extra="deploy"),
    "prepare": Command("prepare", "a recording becomes transitions: checked, counted, split by run", extra="base"),
    "generate": Command(
        "generate",
        "train a generator on real transitions and draw synthetic ones, or draw from a given one",
    ),
    "train": Command(
        "train",
        "train a dynamics model on transitions or on a recording",
        Ranking(("validation_position_mm", "validation_orientation_deg")),
    ),
    "evaluate": Command(
        "evaluate",
        "a simulation model against measured runs: one-step, floor, open loop",
        Ranking(("one_step_position_mm", "one_step_orientation_deg")),
    ),
    "tune": Command("tune", "search hyper-parameters with Optuna, several processes on one study", Ranking(("loss",))),
    "diagnose": Command("diagnose", "what a simulation gets wrong on measured data: cause, extended simulation, gain"),
    "learn": Command(
        "learn",
        "learn a policy, shared by all vehicles, in the simulated world",
        Ranking(("evaluation_success",), True),
    ),
    "rollout": Command(
        "rollout",
        "a policy from the same starts in the simulation and on stand-ins, side by side",
        Ranking(("stand_in_success",), True),
    ),
    "collect": Command("collect", "real vehicles drive under an overhead camera; a recording results", extra="deploy"),
    "deploy": Command(
        "deploy",
        "a policy drives real vehicles under an overhead camera, safely; a recording results",
        Ranking(("robots_reward",), True),
        extra="deploy",
    ),
    "fleet": Command("fleet", "emulated robots on a real broker, under an emulated camera", extra="deploy"),
    "promote": Command("promote", "make a registered model the champion, if it passes the gate; or roll back"),
    "experiment": Command("experiment", "a table or figure of the paper, or an overview of the pipeline"),
}
