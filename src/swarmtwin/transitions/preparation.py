"""The folder that `swarmtwin prepare` leaves: transitions, and how they came about."""

import dataclasses
import json
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from pydantic import model_validator

from swarmtwin.errors import UserError
from swarmtwin.files import write_text
from swarmtwin.recordings.recognition import known_by
from swarmtwin.recordings.recording import Recording, fault
from swarmtwin.robot import Arena, StrictModel
from swarmtwin.transitions.extraction import Counts
from swarmtwin.transitions.splitting import Fractions, SplitOptions
from swarmtwin.transitions.storage import read_transitions, write_transitions
from swarmtwin.transitions.stored_transitions import StoredTransitions
from swarmtwin.transitions.transitions import SPLITS, Transitions

TRANSITIONS_FILE = "transitions.parquet"
PREPARATION_FILE = "preparation.json"
REMEDY = "make it again with swarmtwin prepare"

Origin = Literal["real", "synthetic", "mixed"]


class CountsByReason(StrictModel):
    """`Counts` as it is stored."""

    rows: int
    dropped_rows: dict[str, int]
    considered: int
    kept: int
    dropped: dict[str, int]


class GeneratorOrigin(StrictModel):
    """Which generator synthetic transitions were sampled from, and how.

    Attributes:
        name: the kind of generator.
        digest: identifies its weights and description.
        seed: of the sampling.
        real_transitions: how many real ones it was trained on and chosen by.
    """

    name: str
    digest: str
    seed: int
    real_transitions: int


class RecordingOrigin(StrictModel):
    """Which recording something was made from: transitions, or what was learned from them.

    Attributes:
        recording: name of the recording's folder, without the path to it.
        digest: identifies the content of the recording's runs.
        source: where the recording comes from, in its own words.
        vehicles: ids of the vehicles that were taken from it.
    """

    recording: str
    digest: str
    source: str
    vehicles: tuple[str, ...]

    @classmethod
    def shared_with(cls, other: "RecordingOrigin", **own: Any) -> Self:
        """Describe what was made from the same recording as `other`; `own` are the fields that only its kind has."""
        return cls(recording=other.recording, digest=other.digest, source=other.source, vehicles=other.vehicles, **own)


class Preparation(RecordingOrigin):
    """The content of `preparation.json`: where transitions come from and what became of the recording's rows.

    Of synthetic transitions, `recording`, `digest`, `source`, `vehicles` and `learned` are those of the real ones that
    their generator learned from: what it has seen, a model trained on its samples has seen as well.

    Attributes:
        robot: name of the robot.
        arena_mm: where its vehicles could move; null in a folder of an old version.
        fractions: the shares asked for.
        seed: of the split.
        counts: what was kept and dropped, by reason.
        runs: names of the runs in each split; a run without a transition is in none.
        transitions: number of transitions in each split.
        learned: marks of the tracks that a model trained on these transitions has seen: train and validation.
        warnings: what is unusual of the recording as a whole and may be meant; left out of the file where nothing is.
        origin: whether the transitions were measured, sampled from a generator, or are some of each.
        generator: where synthetic ones come from; null for real ones.
    """

    robot: str
    fractions: Fractions
    seed: int
    counts: CountsByReason
    runs: dict[str, tuple[str, ...]]
    transitions: dict[str, int]
    learned: tuple[str, ...]
    warnings: tuple[str, ...] = ()
    arena_mm: Arena | None = None
    origin: Origin = "real"
    generator: GeneratorOrigin | None = None

    @model_validator(mode="after")
    def _synthetic_ones_name_their_generator(self) -> Self:
        if (self.origin == "real") != (self.generator is None):
            raise ValueError(f"origin {self.origin!r} and generator do not fit: only real transitions have none")
        return self


def describe(
    recording: Recording, name: str, transitions: Transitions, counts: Counts, fractions: Fractions, seed: int
) -> Preparation:
    """Describe how `transitions` came about from the `recording` called `name`."""
    runs = runs_by_split(transitions)
    unseen = set(runs["test"])
    return described(
        recording,
        name,
        counts,
        SplitOptions(fractions=fractions, seed=seed),
        vehicles=recording.vehicles,
        runs=runs,
        transitions=counts_by_split(transitions),
        learned=known_by(track for track in recording.tracks if track.run not in unseen),
    )


def described(recording: Recording, name: str, counts: Counts, split: SplitOptions, **found: Any) -> Preparation:
    """Describe how transitions came about from a recording, whose tracks need not be in memory.

    Args:
        recording: what is known of it as a whole.
        name: of its folder.
        counts: what was kept and dropped.
        split: how it was split.
        found: vehicles, runs, transitions and learned, as in `Preparation`.
    """
    return Preparation(
        robot=recording.robot.name,
        recording=name,
        digest=recording.digest,
        source=recording.header.source,
        arena_mm=recording.header.arena_mm,
        fractions=split.fractions,
        seed=split.seed,
        counts=CountsByReason.model_validate(dataclasses.asdict(counts)),
        warnings=recording.warnings,
        **found,
    )


def runs_by_split(transitions: Transitions) -> dict[str, tuple[str, ...]]:
    """Return the names of the runs in each split; a run without a transition is in none."""
    return {
        split: tuple(transitions.runs[index] for index in np.unique(transitions.part(split).run)) for split in SPLITS
    }


def counts_by_split(transitions: Transitions) -> dict[str, int]:
    """Return the number of transitions in each split."""
    return {split: len(transitions.part(split)) for split in SPLITS}


def save_preparation(folder: Path, transitions: Transitions, preparation: Preparation) -> None:
    """Write transitions and `preparation` into an existing `folder`."""
    save_transitions(folder, transitions)
    save_description(folder, preparation)


def save_description(folder: Path, preparation: Preparation) -> None:
    """Write how the transitions in a folder came about."""
    silent = None if preparation.warnings else {"warnings"}
    write_text(folder / PREPARATION_FILE, preparation.model_dump_json(indent=1, exclude=silent) + "\n")


def save_transitions(folder: Path, transitions: Transitions) -> None:
    """Write `transitions.parquet` into an existing `folder`: one row a transition, the robot in the file's metadata."""
    write_transitions(folder / TRANSITIONS_FILE, transitions)


def load_transitions(folder: Path) -> Transitions:
    """Read the transitions that `swarmtwin prepare` left in `folder`, their robot inside.

    Raises:
        UserError: there are none, or the file is damaged.
    """
    return read_transitions(_existing(folder, TRANSITIONS_FILE), REMEDY)


def stored_transitions(folder: Path) -> StoredTransitions:
    """Look into the transitions that `swarmtwin prepare` left in `folder`, and leave them there.

    Raises:
        UserError: there are none, or the file is damaged.
    """
    return StoredTransitions.of(_existing(folder, TRANSITIONS_FILE), REMEDY)


def load_preparation(folder: Path) -> Preparation:
    """Read `preparation.json` in `folder`.

    Raises:
        UserError: it is missing or damaged.
    """
    file = _existing(folder, PREPARATION_FILE)
    try:
        return Preparation.parse(json.loads(file.read_text()), str(file))
    except ValueError as error:
        raise fault(file, f"not valid JSON ({error})", REMEDY) from None


def _existing(folder: Path, name: str) -> Path:
    file = Path(folder) / name
    if not file.is_file():
        raise UserError(f"{file} is missing: name a folder that swarmtwin prepare made")
    return file
