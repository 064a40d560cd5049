"""Sessions with and without an effect, to be compared pairwise."""

import numpy as np

from swarmtwin.geometry import displacement_between
from swarmtwin.standin.effects import parse_effects
from swarmtwin.standin.session import StandInSession, drive_session


def session(robot, *entries, runs=20, steps=20, vehicles=("1", "2"), **more):
    return StandInSession(robot, vehicles, runs, steps, 11, parse_effects(entries, robot, len(vehicles)), **more)


def displacements(driven):
    return displacement_between(driven.pose[:, :-1], driven.pose[:, 1:])


def true_displacements(driven):
    pose = np.moveaxis(driven.state[:3], 0, -1)
    return displacement_between(pose[:, :-1], pose[:, 1:])


def first_periods(robot, entry, runs=400):
    """Film the first period of many runs with and without an effect; true displacements (runs, V, 3), and commands."""
    plain, changed = (drive_session(session(robot, *entries, runs=runs, steps=1)) for entries in ((), (entry,)))
    return true_displacements(plain)[:, 0], true_displacements(changed)[:, 0], plain.command[:, 0]
