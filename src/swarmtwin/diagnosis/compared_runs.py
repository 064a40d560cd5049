"""Step 1. Which part of a measured recording is compared: long runs in blocks, and of very many rows some."""

import logging
from dataclasses import replace

from swarmtwin.recordings.blocks import in_blocks
from swarmtwin.recordings.recording import Recording

logger = logging.getLogger(__name__)


def compared(measured: Recording, most_rows: int, fewest: int = 40) -> tuple[Recording, int]:
    """Return what of a recording is compared, and how many rows are left out since there are more than `most_rows`.

    Of fewer than `fewest` runs, long ones are cut into blocks, which stand for runs: in what is held out, in intervals,
    in what the result says. What is left of a longer recording lies all over it. A clock that shows more than ten times
    the session's length when that begins was not set for it: times then count from the first one. One that shows more
    than its length is believed, and in doubt.
    """
    measured = _with_clock_set(measured)
    rows = sum(map(len, measured.tracks))
    every = max(1, -(-rows // most_rows))
    parts = replace(measured, tracks=in_blocks(measured.tracks, fewest=fewest * every, blocks=fewest * every))
    if every == 1:
        return parts, 0
    taken = set(parts.runs[::every])
    parts = parts.where(lambda track: track.run in taken)
    left_out = rows - sum(map(len, parts.tracks))
    logger.info("%d of %d measured rows are compared, of runs or blocks all over the recording", rows - left_out, rows)
    return parts, left_out


def _with_clock_set(measured: Recording, most_lengths: float = 10.0) -> Recording:
    """Return a recording whose times count from its first one, where its clock was not set when it began."""
    if not measured.tracks:
        return measured
    began_s = min(float(track.time_s[0]) for track in measured.tracks)
    length_s = max(float(track.time_s[-1]) for track in measured.tracks) - began_s
    if abs(began_s) <= most_lengths * length_s:
        if began_s <= length_s:
            return measured
        doubt = (
            f"the measured session's clock begins at {began_s:,.0f} s, and it lasts {length_s:,.0f} s: what ages is "
            "taken to have begun at 0 s; if the clock was not set then, count times from the start of the session"
        )
        logger.warning("%s", doubt)
        return replace(measured, warnings=(*measured.warnings, doubt))
    logger.info("the session's clock begins at %.0f s: times count from then on", began_s)
    sent = measured.sent and {vehicle: (at_s - began_s, sent) for vehicle, (at_s, sent) in measured.sent.items()}
    return replace(
        measured, tracks=tuple(replace(track, time_s=track.time_s - began_s) for track in measured.tracks), sent=sent
    )
