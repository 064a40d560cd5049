"""The columns a run's file must have, and whose columns they are where they are not the robot's."""

import difflib
import functools
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from swarmtwin.configuration import config_folder
from swarmtwin.errors import UserError
from swarmtwin.recordings.faults import fault
from swarmtwin.robot import POSE_COLUMNS, Robot


def run_columns(robot: Robot) -> tuple[str, ...]:
    """Return the columns of a run's file, in the order they are written."""
    return ("time_s", "vehicle", *robot.command_columns, *POSE_COLUMNS)


def check_columns(found: Sequence[str], robot: Robot, file: Path) -> tuple[str, ...]:
    """Check that the columns `found` in `file` hold those of `robot`; return the ones that nothing reads.

    Raises:
        UserError: a column is missing or stands twice.
    """
    if repeated := [name for name, count in Counter(found).items() if count > 1]:
        raise fault(file, f"column {repeated[0]!r} stands twice", "keep one of them", row=1)
    required = run_columns(robot)
    missing = [name for name in required if name not in found]
    if missing:
        raise _missing_column(missing[0], found, robot, file)
    return tuple(name for name in found if name not in required)


def _missing_column(missing: str, found: Sequence[str], robot: Robot, file: Path) -> UserError:
    for other in known_robots():
        if other.name != robot.name and set(other.command_columns) <= set(found):
            what = f"the columns are those of robot {other.name!r}, not of {robot.name!r}"
            return fault(file, what, f"put the file in a recording of {other.name!r}, and read that one", row=1)
    unread = [name for name in found if name not in run_columns(robot)]
    meant = difflib.get_close_matches(missing, unread, n=1, cutoff=0.6)
    remedy = f"rename {meant[0]!r} to {missing!r}" if meant else f"add it; {robot.name!r} needs them all"
    return fault(file, f"column {missing!r} is missing, there are {', '.join(found)}", remedy, row=1)


@functools.cache
def known_robots() -> tuple[Robot, ...]:
    """Return the robots of `conf/robot/`."""
    return tuple(Robot.load(file) for file in sorted((config_folder() / "robot").glob("*.yaml")))
