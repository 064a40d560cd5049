"""Whether a recording as a whole can be what it says: units, axes, signs and clock, against the robot and the arena.

Looked at before single rows are: a recording in metres consists of rows that are each believable. What contradicts the
robot's file or the arena is refused with the mistake that would explain it; what may be meant is a warning.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from swarmtwin.errors import UserError
from swarmtwin.recordings.plausibility.commands import clock_doubts, command_doubts, unsteered_doubts
from swarmtwin.recordings.plausibility.doubt import Doubt, Limits
from swarmtwin.recordings.plausibility.frame import frame_doubts
from swarmtwin.recordings.plausibility.positions import arena_doubts, gain_doubts, stillness_doubts
from swarmtwin.recordings.plausibility.sampled_rows import SampledRows
from swarmtwin.recordings.plausibility.sent_log import SentLog
from swarmtwin.recordings.recording import Header


def judge(
    header: Header,
    rows: SampledRows,
    in_degrees: SampledRows | None = None,
    sent_log: SentLog | None = None,
    limits: Limits | None = None,
) -> tuple[str, ...]:
    """Judge a recording as a whole.

    Args:
        header: what it says of itself.
        rows: as read.
        in_degrees: the same with headings taken for degrees, where some are beyond a turn.
        sent_log: the rows beside the log of the commands, where there is one.
        limits: from where on it is doubted.

    Returns:
        Warnings: what is unusual and may be meant.

    Raises:
        UserError: it contradicts the robot's file or the arena, and its header does not say that this was looked at.
    """
    limits, accepted = limits or Limits(), header.accept or ()
    doubts: list[Doubt] = []
    for doubt in _doubts(header, rows, in_degrees, sent_log, limits):
        if doubt.refused and doubt.check not in accepted:
            accept = ", ".join([*accepted, doubt.check])
            end = "" if doubt.text.endswith("?") else "."
            raise UserError(
                f"{doubt.text}{end} If it is right as it stands, write accept: [{accept}] in recording.yaml"
            )
        doubts.append(doubt)
    return tuple(doubt.text for doubt in doubts)


def _doubts(
    header: Header, rows: SampledRows, in_degrees: SampledRows | None, sent_log: SentLog | None, limits: Limits
) -> Iterator[Doubt]:
    if rows.pairs < limits.fewest_pairs:
        return
    yield from clock_doubts(rows.robot, rows.between_s(), limits)
    if sent_log:
        yield from sent_log.doubts(limits)
    motion = rows.motion()
    if len(motion) < limits.fewest_pairs:
        return
    yield from command_doubts(motion, limits)
    if np.sum(~np.isnan(motion.command).any(axis=1)) < limits.fewest_pairs:
        return
    yield from stillness_doubts(motion, limits)
    yield from arena_doubts(header.arena_mm, rows.position(), motion, limits)
    yield from gain_doubts(header.arena_mm, motion, limits)
    of_frame = list(frame_doubts(motion, in_degrees.motion() if in_degrees else None, limits))
    yield from of_frame
    yield from unsteered_doubts(motion)
    if len(rows.vehicles) > 1 and not any(doubt.refused for doubt in of_frame):
        yield from _vehicle_doubts(rows, limits)


def _vehicle_doubts(rows: SampledRows, limits: Limits) -> Iterator[Doubt]:
    """Look at each vehicle's stillness, frame and signs by itself, as far as the whole does not show it."""
    for vehicle in rows.vehicles:
        motion = rows.motion(vehicle)
        if np.sum(~np.isnan(motion.command).any(axis=1)) < limits.fewest_pairs:
            continue
        found: Sequence[Doubt] = [*stillness_doubts(motion, limits), *frame_doubts(motion, None, limits)]
        for doubt in found:
            yield doubt._replace(text=f"vehicle {vehicle!r}: {doubt.text}")
