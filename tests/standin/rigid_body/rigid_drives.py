"""Short drives of rigid bodies, and what they truly did."""

import numpy as np

from swarmtwin.geometry import displacement_between
from swarmtwin.standin.effects import parse_effects
from swarmtwin.standin.rigid_body.driving import drive_rigid_session
from swarmtwin.standin.session import StandInSession

CALM = {"name": "noise_change", "factor": 1e-4}


def drive(robot, *effects, vehicles=("1",), runs=12, steps=12, seed=3, **options):
    session = StandInSession(
        robot, vehicles, runs, steps, seed, parse_effects(effects, robot, len(vehicles)), **options
    )
    return drive_rigid_session(session)


def true_displacements(driven):
    """Return true displacements (R, T, V, 3) of the vehicle itself."""
    pose = np.moveaxis(driven.state[:3], 0, -1)
    return displacement_between(pose[:, :-1], pose[:, 1:])


def measured_displacements(driven):
    return displacement_between(driven.pose[:, :-1], driven.pose[:, 1:])


def held_displacements(robot, command, *effects, steps=3, **options):
    """Return true displacements (N, 3) of the last period of runs in which one command was held throughout."""
    driven = drive(robot, *effects, steps=steps, drive=np.array([command], float), **options)
    as_told = (driven.command[:, :, 0] == command).all(axis=(1, 2))
    assert as_told.sum() > len(as_told) / 4
    return true_displacements(driven)[as_told, -1, 0]


def steady_displacement(robot, command, *effects, runs=4, **options):
    """Return the mean displacement (3,) by a command that has been held for two periods before, without chance."""
    return held_displacements(robot, command, CALM, *effects, runs=runs, **options).mean(axis=0)
