"""Clean recordings to test with: drives whose every transition is known and believable."""

import numpy as np

from swarmtwin.files import new_folder
from swarmtwin.geometry import compose
from swarmtwin.recordings.recording import Header, Track
from swarmtwin.recordings.writing import write_recording


def header_of(robot, vehicles=None):
    """A header that says that motion need not follow commands: here it is made up."""
    arena_mm, accept = robot.arena_mm, ("frame", "scale")
    about = {"robot": robot.name, "period_s": robot.period_s, "source": "made up"}
    return Header(**about, arena_mm=arena_mm, vehicles=vehicles, accept=accept)


def drive(robot, runs=2, steps=10, vehicles=("1", "2"), seed=0):
    """Make one track a run and vehicle: `steps` random commands, and poses that move about a home by believable steps.

    Homes are at least 300 mm apart, so a swapped marker is a teleport. Each run begins 5 s after the one before.
    """
    generator = np.random.default_rng(seed)
    count = runs * len(vehicles)
    command = np.full((count, steps + 1, len(robot.command_columns)), np.nan)
    command[:, :-1] = generator.uniform(robot.command_low, robot.command_high, command[:, :-1].shape).round(3)
    home = np.zeros((count, 1, 3))
    middle = (robot.arena_mm.low_mm + robot.arena_mm.high_mm) / 2
    places = np.linspace(-150, 150, len(vehicles)) * max(1, len(vehicles) - 1)
    home[:, 0, 0] = middle[0] + np.tile(places, runs)
    home[:, 0, 1] = middle[1]
    home[:, 0, 2] = generator.uniform(-3, 3, count)
    moved = generator.uniform(-0.1, 0.1, (count, steps + 1, 3)) * robot.displacement_limit
    pose = compose(home, moved)
    time_s = np.arange(steps + 1) * robot.period_s
    length_s = time_s[-1] + 5
    return [
        Track(f"run_{index // len(vehicles):05d}", vehicles[index % len(vehicles)], time, command[index], pose[index])
        for index in range(count)
        for time in [time_s + index // len(vehicles) * length_s]
    ]


def write_drive(folder, robot, tracks, file_format="csv"):
    """Write a recording of `tracks` to `folder`, stating its vehicles; return `folder`."""
    vehicles = tuple(sorted({track.vehicle for track in tracks}))
    with new_folder(folder, "test") as inside:
        write_recording(inside, robot, header_of(robot, vehicles), tracks, file_format)
    return folder
