"""From a recording to a folder of transitions, of which no more than a part is in memory at a time.

Parts of whole runs are read, checked and made into transitions, and laid aside; when the recording has been judged as a
whole and all its runs are known, they are split, and the parts are put together in one file.
"""

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from swarmtwin.errors import UserError, near_miss
from swarmtwin.recordings.reading import read_in_parts
from swarmtwin.recordings.recognition import Marks, kept_marks, marks
from swarmtwin.recordings.recording import Recording
from swarmtwin.robot import Robot
from swarmtwin.transitions.extraction import Counts, from_part
from swarmtwin.transitions.preparation import TRANSITIONS_FILE, Preparation, described, save_description
from swarmtwin.transitions.splitting import SplitOptions, splits_of_runs
from swarmtwin.transitions.storage import read_transitions, write_parts, write_transitions
from swarmtwin.transitions.transitions import SPLITS, Transitions


def prepare(
    recording: Path,
    robot: Robot,
    split: SplitOptions,
    folder: Path,
    vehicles: tuple[str, ...] | None = None,
    rows_at_a_time: int = 250_000,
) -> Preparation:
    """Make the transitions of a recording, split by run, and write them and how they came about into a folder.

    The files are those of `from_recording`, `split_by_run` and `save_preparation`, except that transitions of more rows
    stand there in several groups.

    Args:
        recording: its folder.
        robot: whose recording it is.
        split: the share of each split, and the seed of the draw.
        folder: exists; what is laid aside meanwhile lies there too.
        vehicles: ids of those that are taken from the recording; None: all.
        rows_at_a_time: about so many rows of the recording are in memory at a time, or those of its longest run.

    Raises:
        UserError: the recording is at fault, a vehicle does not occur in it, nothing is left, or it has too few runs to
            split.
    """
    with tempfile.TemporaryDirectory(dir=folder, prefix="parts-") as aside:
        parts = _LaidAside(Path(aside), vehicles)
        whole = read_in_parts(recording, robot, parts.take, rows_at_a_time)
        for vehicle in vehicles or ():
            if vehicle not in parts.occurring:
                raise UserError(f"{recording}: no vehicle {vehicle!r}: {near_miss(vehicle, sorted(parts.occurring))}")
        counts = replace(parts.counts, dropped_rows=dict(whole.dropped_rows))
        counts.check(robot)
        sizes = np.concatenate(parts.sizes)
        split_of_run = splits_of_runs(sizes, split.fractions, split.seed)
        preparation = _describe(whole, recording.resolve().name, parts, counts, split, sizes, split_of_run)
        write_parts(folder / TRANSITIONS_FILE, parts.split(split_of_run), parts.runs, preparation.vehicles)
    save_description(folder, preparation)
    return preparation


@dataclass
class _LaidAside:
    """Transitions of the parts of a recording, laid aside in files, and what is kept in memory of them.

    Attributes:
        aside: folder of the files.
        vehicles: ids of those whose tracks are taken; None: all.
        files: one a part.
        occurring: ids of all vehicles of the recording.
        counts: what became of the rows taken.
        runs: names of the runs taken, in order.
        sizes: of each part, how many transitions each of its runs has.
        neighbours: the most of any part.
        tracks: marks, run and vehicle of each track that was taken.
    """

    aside: Path
    vehicles: tuple[str, ...] | None
    files: list[Path] = field(default_factory=list)
    occurring: set[str] = field(default_factory=set)
    counts: Counts = field(default_factory=lambda: Counts(0, {}, 0, 0, {}))
    runs: list[str] = field(default_factory=list)
    sizes: list[np.ndarray] = field(default_factory=list)
    neighbours: int = 0
    tracks: list[tuple[Marks, str, str]] = field(default_factory=list)

    def take(self, part: Recording) -> None:
        """Lay the transitions of the next part aside."""
        self.occurring.update(part.vehicles)
        if self.vehicles is not None:
            wanted = self.vehicles
            part = part.where(lambda track: track.vehicle in wanted)
        if not part.tracks:
            return
        transitions, counts = from_part(part)
        self.counts += counts
        self.runs += transitions.runs
        self.sizes.append(np.bincount(transitions.run, minlength=len(transitions.runs)))
        self.neighbours = max(self.neighbours, transitions.neighbours.shape[1])
        self.tracks += [(marks(track), track.run, track.vehicle) for track in part.tracks]
        self.files.append(self.aside / f"{len(self.files):06}.parquet")
        write_transitions(self.files[-1], transitions)

    def split(self, split_of_run: np.ndarray) -> Iterator[Transitions]:
        """Yield the parts as they were laid aside, with the splits of their runs, and as many neighbours each."""
        first = 0
        for file in self.files:
            part = read_transitions(file, "prepare again")
            split = split_of_run[first : first + len(part.runs)][part.run]
            missing = self.neighbours - part.neighbours.shape[1]
            neighbours = np.pad(part.neighbours, ((0, 0), (0, missing), (0, 0)), constant_values=np.nan)
            first += len(part.runs)
            file.unlink()
            yield replace(part, split=split, neighbours=neighbours)


def _describe(
    whole: Recording,
    name: str,
    parts: _LaidAside,
    counts: Counts,
    split: SplitOptions,
    sizes: np.ndarray,
    split_of_run: np.ndarray,
) -> Preparation:
    """Describe how the transitions came about: each run has `sizes` (R,) of them, in a split `split_of_run` (R,)."""
    of_split = [np.flatnonzero((split_of_run == number) & (sizes > 0)) for number in range(len(SPLITS))]
    runs = {part: tuple(parts.runs[run] for run in own) for part, own in zip(SPLITS, of_split, strict=True)}
    unseen = set(runs["test"])
    return described(
        whole,
        name,
        counts,
        split,
        vehicles=tuple(sorted({vehicle for *_, vehicle in parts.tracks})),
        runs=runs,
        transitions={part: int(sizes[own].sum()) for part, own in zip(SPLITS, of_split, strict=True)},
        learned=kept_marks(own for own, run, _ in parts.tracks if run not in unseen),
    )
