"""When runs were driven: a vehicle drives in one at a time, and the clock goes on from each to the next."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

from swarmtwin.recordings.blocks import run_of

FROM_START = "count times from the start of the session"


class Span(NamedTuple):
    """When a track drives."""

    vehicle: str
    begun_s: float
    ended_s: float
    run: str


def clock_warnings(spans: Sequence[Span]) -> tuple[str, ...]:
    """Return what is odd of the times of tracks, in order of their runs' names, and may be meant."""
    warnings = []
    if overlap := _overlapping_runs(spans):
        vehicle, *runs = overlap
        at_once = "vehicle {!r} drives in runs {!r} and {!r} at the same time".format(vehicle, *runs)
        warnings.append(f"{at_once}: {FROM_START}")
    if jump := _set_back(spans):
        before, after = jump
        back = f"by their times run {run_of(after.run)!r} begins {before.begun_s - after.begun_s:,.0f} s before"
        warnings.append(f"{back} run {run_of(before.run)!r}: was the clock set back between them? {FROM_START}")
    if spans and (first_s := min(span.begun_s for span in spans)) < 0:
        warnings.append(f"times begin at {first_s:,.0f} s, below zero: {FROM_START}")
    return tuple(warnings)


def _overlapping_runs(spans: Sequence[Span]) -> tuple[str, str, str] | None:
    """Return the first vehicle and two runs in which it would have to be at the same time."""
    ordered = sorted(spans, key=lambda span: (span.vehicle, span.begun_s))
    for earlier, later in itertools.pairwise(ordered):
        if earlier.vehicle == later.vehicle and later.begun_s < earlier.ended_s:
            return earlier.vehicle, run_of(earlier.run), run_of(later.run)
    return None


def _set_back(spans: Sequence[Span], fewest: int = 8, most: float = 0.1) -> tuple[Span, Span] | None:
    """Return two runs that follow one another by name, and not by time; None where names say nothing of the order.

    Names do where there are `fewest` runs, of which no more than a share of `most`, or one, end before the last begins.
    """
    tracks = [list(own) for _, own in itertools.groupby(spans, key=lambda span: run_of(span.run))]
    runs = [
        Span(own[0].vehicle, min(one.begun_s for one in own), max(one.ended_s for one in own), own[0].run)
        for own in tracks
    ]
    back = [(one, other) for one, other in itertools.pairwise(runs) if other.ended_s <= one.begun_s]
    return back[0] if back and len(runs) >= fewest and len(back) <= max(1, most * len(runs)) else None
