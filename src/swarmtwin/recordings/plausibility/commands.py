"""Clock and commands of a recording against the robot's file: units, order of columns, what is missing."""

from collections.abc import Iterator

import numpy as np

from swarmtwin.recordings.observed_motion import ObservedMotion
from swarmtwin.recordings.plausibility.doubt import Doubt, Limits
from swarmtwin.robot import Robot


def clock_doubts(robot: Robot, between_s: np.ndarray, limits: Limits) -> Iterator[Doubt]:
    """Compare the times (P,) between successive rows with the robot's period."""
    typical = float(np.median(between_s))
    usual = float(np.mean((between_s >= 0.49 * robot.period_s) & (between_s <= 1.01 * robot.longest_gap_s)))
    said = f"rows follow one another by {typical:.3g} in time_s, the robot's period is {robot.period_s:g} s"
    if usual < limits.usual_periods:
        units = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9, "minutes": 60.0, "hours": 3600.0}
        meant = [
            f"are times in {unit}? Multiply time_s by {factor:g}"
            for unit, factor in units.items()
            if 0.8 < typical * factor / robot.period_s < 1.25
        ]
        if not meant and np.isclose(between_s, 1.0).mean() > 0.9:
            meant = [f"are they numbers of rows? Multiply time_s by {robot.period_s:g}"]
        remedy = (
            meant[0] if meant else "give one row a period, or describe the robot with the period at which it drives"
        )
        yield Doubt("clock", True, f"{said}: {remedy}")
    elif usual < 2 * limits.usual_periods or abs(typical / robot.period_s - 1) > limits.period_error:
        yield Doubt("clock", False, f"{said}; {usual:.0%} of the pairs of rows are about a period apart")


def command_doubts(motion: ObservedMotion, limits: Limits) -> Iterator[Doubt]:
    """Compare the commands with the robot's limits."""
    robot, command = motion.robot, motion.command[~np.isnan(motion.command).any(axis=1)]
    if not len(command):
        return
    if not command.any():
        yield Doubt("commands", True, "every command is 0: what was sent is missing; record commands with the poses")
        return
    command = command[command.any(axis=1)]  # all 0 is how robots are stopped, also those whose limits exclude it
    beyond = _beyond_limits(command, motion)
    if beyond > limits.beyond_limits:
        yield Doubt("commands", True, f"{beyond:.0%} of the commands are beyond the robot's limits: {_unit(motion)}")
    elif beyond > limits.beyond_limits / 10:
        yield Doubt("commands", False, f"{beyond:.0%} of the commands are beyond the robot's limits and not used")
    for name, values, column in zip(robot.command, command.T, robot.command.values(), strict=True):
        largest, allowed = float(np.abs(values).max()), max(abs(column.low), abs(column.high))
        if np.ptp(values) == 0:
            yield Doubt("commands", False, f"{name} is {values[0]:g} in all rows: what it does cannot be learned")
        elif largest < limits.command_range * allowed:
            said = f"{name} never exceeds {largest:.3g} of {allowed:g} {column.unit}: is it in another unit?"
            yield Doubt("commands", False, said)
    if np.abs(command).max() == 100 and all(max(abs(one.low), one.high) != 100 for one in robot.command.values()):
        yield Doubt("commands", False, "the largest command is exactly 100: are commands in percent of the limits?")


def _beyond_limits(command: np.ndarray, motion: ObservedMotion) -> float:
    robot = motion.robot
    return float(np.any((command < robot.command_low) | (command > robot.command_high), axis=1).mean())


def _unit(motion: ObservedMotion) -> str:
    """Say in which unit or order commands that are beyond the limits may be."""
    columns = motion.robot.command_columns
    command = motion.command[~np.isnan(motion.command).any(axis=1)]
    for first in range(len(columns)):
        for second in range(first):
            order = list(range(len(columns)))
            order[first], order[second] = second, first
            if _beyond_limits(command[:, order], motion) < 0.01:
                return f"are {columns[second]} and {columns[first]} exchanged? Exchange the columns"
    for index, (name, column) in enumerate(motion.robot.command.items()):
        alone = command[:, index]
        if np.mean((alone < column.low) | (alone > column.high)) < 0.01:
            continue
        for unit, factor in _other_units(column.unit).items():
            within = (alone * factor > column.low - 1e-6) & (alone * factor < column.high * 1.001)
            if within.mean() > 0.99:
                return f"is {name} in {unit}? Multiply it by {factor:.6g}"
    return "are they in percent, or in another unit? Bring them to the units of the robot's file, or correct its limits"


def _other_units(unit: str) -> dict[str, float]:
    """Return units that a command may be in by mistake, and by what it is multiplied then."""
    degree, turn = np.pi / 180, 2 * np.pi
    return {
        "mm/s": {"m/s": 1000.0, "cm/s": 10.0},
        "m/s": {"mm/s": 0.001, "cm/s": 0.01},
        "rad/s": {"Hz": turn, "degrees a second": degree, "revolutions a minute": turn / 60},
        "Hz": {"rad/s": 1 / turn, "revolutions a minute": 1 / 60},
        "deg": {"rad": 1 / degree},
        "rad": {"degrees": degree},
    }.get(unit, {})


def unsteered_doubts(motion: ObservedMotion) -> Iterator[Doubt]:
    """Look for motion that no command asks for: a column that is missing, or a copy of another."""
    moved = {
        "drives": (motion.forward_effort, motion.distance, motion.robot.displacement_limit[0]),
        "steers": (motion.turn_effort, np.abs(motion.displacement[:, 2]), motion.robot.displacement_limit[2]),
    }
    for verb, (effort, amount, largest) in moved.items():
        if effort is not None and np.nanmax(np.abs(effort)) < 0.02 and np.quantile(amount, 0.95) > 0.2 * largest:
            what = "move" if verb == "drives" else "turn"
            yield Doubt("commands", False, f"vehicles {what}, but no command {verb}: is a column missing or copied?")


def smaller_commands(motion: ObservedMotion) -> str:
    """Say in which unit commands may be for which vehicles move too far."""
    columns = zip(motion.robot.command.items(), motion.command.T, strict=True)
    small = {
        name: (float(np.nanmax(np.abs(values))), max(abs(column.low), abs(column.high)))
        for (name, column), values in columns
    }
    doubtful = {name: both for name, both in small.items() if both[0] < 0.15 * both[1]}
    if not doubtful:
        return "are poses in mm, and the limits in the robot's file right?"
    largest = max(both[0] for both in doubtful.values())
    names = ", ".join(doubtful)
    if 0.8 < largest <= 1.001 and len(doubtful) == len(small):
        return f"are {names} shares of the limits? Multiply them by the limits"
    if len(doubtful) == 1:
        (name, (largest, allowed)) = next(iter(doubtful.items()))
        for unit, factor in _other_units(motion.robot.command[name].unit).items():
            if 0.4 < largest * factor / allowed < 1.1:
                return f"is {name} in {unit}? Multiply it by {factor:.6g}"
    return f"is {names} in another unit? It reaches {largest:.3g}; bring it to the unit of the robot's file"
