"""Whether a recording as a whole can be what it says: units, axes, signs and clock, against the robot and the arena.

Looked at before single rows are: a recording in metres consists of rows that are each believable. What contradicts the
robot's file or the arena is refused with the mistake that would explain it; what may be meant is a warning.
"""

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np

from swarmtwin.errors import UserError
from swarmtwin.recordings.observed_motion import ObservedMotion
from swarmtwin.recordings.plausibility.commands import clock_doubts, command_doubts, unsteered_doubts
from swarmtwin.recordings.plausibility.doubt import Doubt, Limits
from swarmtwin.recordings.plausibility.frame import frame_doubts
from swarmtwin.recordings.plausibility.positions import arena_doubts, gain_doubts, stillness_doubts
from swarmtwin.recordings.recording import Recording, Track
from swarmtwin.recordings.rows import Rows


def judge(recording: Recording, in_degrees: Recording | None = None, limits: Limits | None = None) -> tuple[str, ...]:
    """Judge a recording as a whole.

    Args:
        recording: as read.
        in_degrees: the same with headings taken for degrees, where some are beyond a turn.
        limits: from where on it is doubted.

    Returns:
        Warnings: what is unusual and may be meant.

    Raises:
        UserError: it contradicts the robot's file or the arena, and its header does not say that this was looked at.
    """
    limits, accepted = limits or Limits(), recording.header.accept or ()
    doubts: list[Doubt] = []
    for doubt in _doubts(recording, in_degrees, limits):
        if doubt.refused and doubt.check not in accepted:
            accept = ", ".join([*accepted, doubt.check])
            end = "" if doubt.text.endswith("?") else "."
            raise UserError(
                f"{doubt.text}{end} If it is right as it stands, write accept: [{accept}] in recording.yaml"
            )
        doubts.append(doubt)
    return tuple(doubt.text for doubt in doubts)


def _doubts(recording: Recording, in_degrees: Recording | None, limits: Limits) -> Iterator[Doubt]:
    rows = Rows.of(recording)
    if len(rows.starts()) < limits.fewest_pairs:
        return
    yield from clock_doubts(recording, rows, limits)
    motion = ObservedMotion.of(recording)
    if len(motion) < limits.fewest_pairs:
        return
    yield from command_doubts(motion, limits)
    if np.sum(~np.isnan(motion.command).any(axis=1)) < limits.fewest_pairs:
        return
    yield from stillness_doubts(motion, limits)
    yield from arena_doubts(recording, rows, motion, limits)
    yield from gain_doubts(recording, motion, limits)
    degrees = ObservedMotion.of(in_degrees) if in_degrees else None
    of_frame = list(frame_doubts(motion, degrees, limits))
    yield from of_frame
    yield from unsteered_doubts(motion)
    if len(recording.vehicles) > 1 and not any(doubt.refused for doubt in of_frame):
        yield from _vehicle_doubts(recording, limits)


def _vehicle_doubts(recording: Recording, limits: Limits) -> Iterator[Doubt]:
    """Look at each vehicle's stillness, frame and signs by itself, as far as the whole does not show it."""
    for vehicle in recording.vehicles:
        own = recording.where(partial(_is_of, vehicle))
        motion = ObservedMotion.of(own)
        if np.sum(~np.isnan(motion.command).any(axis=1)) < limits.fewest_pairs:
            continue
        found: Sequence[Doubt] = [*stillness_doubts(motion, limits), *frame_doubts(motion, None, limits)]
        for doubt in found:
            yield doubt._replace(text=f"vehicle {vehicle!r}: {doubt.text}")


def _is_of(vehicle: str, track: Track) -> bool:
    return track.vehicle == vehicle
