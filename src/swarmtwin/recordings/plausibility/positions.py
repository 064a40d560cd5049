"""Positions of a recording against arena and commands: units, origin, and what does not move."""

from collections.abc import Callable, Iterator

import numpy as np

from swarmtwin.recordings.observed_motion import ObservedMotion
from swarmtwin.recordings.plausibility.commands import smaller_commands
from swarmtwin.recordings.plausibility.doubt import Doubt, Limits
from swarmtwin.robot import Arena


def stillness_doubts(motion: ObservedMotion, limits: Limits) -> Iterator[Doubt]:
    """Look for columns and vehicles that do not change although the commands drive."""
    for name, values in zip(("x_mm", "y_mm", "heading_rad"), motion.start.T, strict=True):
        if np.ptp(values) == 0:
            yield Doubt("still", True, f"{name} is {values[0]:g} in all rows: is the column filled by the camera?")
            return
    if np.array_equal(motion.start[:, 0], motion.start[:, 1]):
        yield Doubt("still", True, "x_mm and y_mm are equal in all rows: one is a copy of the other")
        return
    told = np.zeros(len(motion), dtype=bool)
    for effort in (motion.forward_effort, motion.turn_effort):
        if effort is not None:
            told |= np.abs(effort) > 0.3
    if told.sum() < 30:
        return
    still = float((motion.start == motion.end).all(axis=1)[told].mean())
    said = f"{still:.0%} of the poses are the same as a row before although the command drives"
    if still > limits.still:
        yield Doubt("still", True, f"{said}: did the camera stop, or was the vehicle switched off? Record again")
    elif still > limits.still / 5:
        yield Doubt("still", False, f"{said}: is the camera slower than the commands?")


def arena_doubts(arena_mm: Arena, position: np.ndarray, motion: ObservedMotion, limits: Limits) -> Iterator[Doubt]:
    """Compare positions (S, 2) with the arena that the recording states."""
    low, high = arena_mm.low_mm, arena_mm.high_mm
    margin = max(motion.robot.vehicle_size_mm) / 2

    def outside(at: np.ndarray) -> float:
        return float(np.any((at < low - margin) | (at > high + margin), axis=1).mean())

    share = outside(position)
    said = f"{share:.0%} of the poses are outside the arena"
    if share <= limits.outside:
        if share > limits.outside / 10:
            yield Doubt("arena", False, f"{said} and not used where the next one is as well: is arena_mm right?")
        return
    middle = (low + high) / 2
    readings: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        "is the origin in the arena's middle? Correct arena_mm in recording.yaml": lambda at: at + middle,
        "are x_mm and y_mm exchanged? Exchange the columns": lambda at: at[:, ::-1],
        f"does y point down? Replace y_mm by {low[1] + high[1]:g} − y_mm, and heading_rad by −heading_rad": (
            lambda at: np.column_stack([at[:, 0], low[1] + high[1] + at[:, 1]])
        ),
        "are they in tenths of a millimetre? Multiply x_mm, y_mm by 0.1": lambda at: at * 0.1,
        "are they in micrometres? Multiply x_mm, y_mm by 0.001": lambda at: at * 0.001,
    }
    travel = motion.gain()[0] or 0.6

    def explains(undo: Callable[[np.ndarray], np.ndarray]) -> bool:
        factor = np.ptp(undo(position)) / np.ptp(position)
        return outside(undo(position)) < min(0.02, share / 10) and 0.2 < travel * factor < 1.8

    meant = [text for text, undo in readings.items() if explains(undo)]
    seen_low, seen_high = np.quantile(position, [0.005, 0.995], axis=0)
    where = " and ".join(
        f"{name} from {a:.4g} to {b:.4g}" for name, a, b in zip("xy", seen_low, seen_high, strict=True)
    )
    remedy = meant[0] if meant else "are they in pixels or another unit? Bring them to mm, or correct arena_mm"
    yield Doubt("arena", True, f"{said}, {where}: {remedy}")


def gain_doubts(arena_mm: Arena, motion: ObservedMotion, limits: Limits) -> Iterator[Doubt]:
    """Compare how far vehicles move for their commands with how far the robot's file says they can."""
    size_mm = arena_mm.high_mm - arena_mm.low_mm
    low, high = np.quantile(motion.start[:, :2], [0.001, 0.999], axis=0)
    in_corner = bool(np.all(high - low < limits.corner * size_mm))
    travel, turn = motion.gain()
    least, most = limits.gain
    spans = " × ".join(f"{value:.3g}" for value in high - low)
    said = f"poses span {spans} of an arena of {size_mm[0]:g} × {size_mm[1]:g} mm"
    hardly = float(np.quantile(motion.distance, 0.95)) < limits.least_motion * motion.robot.displacement_limit[0]
    slow = travel is not None and travel < least
    if travel is not None and slow and (in_corner or travel < limits.least_gain):
        yield Doubt("scale", True, f"{said}: {_length_unit(motion, travel, arena_mm.low_mm, arena_mm.high_mm)}")
    elif hardly and in_corner and float(np.quantile(np.abs(motion.displacement[:, 2]), 0.95)) < 0.02:
        yield Doubt("scale", False, f"{said}: vehicles hardly move")
    elif slow:
        yield Doubt("scale", False, f"vehicles move {travel:.2g} times as far for their commands as the robot could")
    elif np.all((low - arena_mm.low_mm < 0.12 * size_mm) & (high - arena_mm.low_mm < limits.covered * size_mm)):
        yield Doubt("scale", False, f"{said}, from its origin on: are they in pixels?")
    for what, value in (("move", travel), ("turn", turn)):
        if value is not None and value > most:
            text = f"vehicles {what} {value:.3g} times as far for their commands as the robot's file says they can"
            yield Doubt("scale", True, f"{text}: {smaller_commands(motion)}")
            return


def _length_unit(motion: ObservedMotion, travel: float, low_mm: np.ndarray, high_mm: np.ndarray) -> str:
    """Say in which unit positions that cover too little of the arena may be."""
    units = {"metres": 1000.0, "feet": 304.8, "inches": 25.4, "centimetres": 10.0}
    margin = 0.05 * (high_mm - low_mm)
    fits = {
        unit: abs(np.log(travel * factor / 0.6))
        for unit, factor in units.items()
        if np.mean((motion.start[:, :2] * factor > low_mm - margin) & (motion.start[:, :2] * factor < high_mm + margin))
        > 0.9
    }
    if not fits or min(fits.values()) > np.log(4):
        return "are they in another unit? Bring x_mm, y_mm to mm"
    unit = min(fits, key=lambda name: float(fits[name]))
    return f"are they in {unit}? Multiply x_mm, y_mm by {units[unit]:g}"
