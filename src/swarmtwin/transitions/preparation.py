"""The folder that `swarmtwin prepare` leaves: transitions, their scaling, and how they came about."""

import dataclasses
import json
from pathlib import Path
from typing import Any, Literal, Self, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet
from pydantic import model_validator

from swarmtwin.errors import UserError
from swarmtwin.files import write_text
from swarmtwin.recordings.faults import fault
from swarmtwin.recordings.recording import Recording
from swarmtwin.robot import DISPLACEMENT_COLUMNS, POSE_COLUMNS, Robot, StrictModel
from swarmtwin.transitions.extraction import Counts
from swarmtwin.transitions.scaling import Scaling
from swarmtwin.transitions.splitting import Fractions
from swarmtwin.transitions.transitions import SPLITS, Transitions

TRANSITIONS_FILE = "transitions.parquet"
PREPARATION_FILE = "preparation.json"
SCALING_FILE = "scaling.json"

Model = TypeVar("Model", bound=StrictModel)
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


class Preparation(StrictModel):
    """The content of `preparation.json`: where transitions come from and what became of the recording's rows.

    Of synthetic transitions, `recording`, `digest`, `source`, `vehicles` and `learned` are those of the real ones that
    their generator learned from: what it has seen, a model trained on its samples has seen as well.

    Attributes:
        robot: name of the robot.
        recording: name of the recording's folder, without the path to it.
        digest: identifies the content of the recording's runs.
        source: where the recording comes from, in its own words.
        vehicles: ids of the vehicles.
        fractions: the shares asked for.
        seed: of the split.
        counts: what was kept and dropped, by reason.
        runs: names of the runs in each split; a run without a transition is in none.
        transitions: number of transitions in each split.
        learned: digests of the tracks that a model trained on these transitions has seen: train and validation.
        origin: whether the transitions were measured, sampled from a generator, or are some of each.
        generator: where synthetic ones come from; null for real ones.
    """

    robot: str
    recording: str
    digest: str
    source: str
    vehicles: tuple[str, ...]
    fractions: Fractions
    seed: int
    counts: CountsByReason
    runs: dict[str, tuple[str, ...]]
    transitions: dict[str, int]
    learned: tuple[str, ...]
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
    return Preparation(
        robot=recording.robot.name,
        recording=name,
        digest=recording.digest,
        source=recording.header.source,
        vehicles=recording.vehicles,
        fractions=fractions,
        seed=seed,
        counts=CountsByReason.model_validate(dataclasses.asdict(counts)),
        runs=runs,
        transitions=counts_by_split(transitions),
        learned=tuple(sorted(track.digest() for track in recording.tracks if track.run not in unseen)),
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
    """Write transitions, their scaling and `preparation` into an existing `folder`."""
    save_transitions(folder, transitions)
    write_text(folder / PREPARATION_FILE, preparation.model_dump_json(indent=1) + "\n")
    write_text(folder / SCALING_FILE, Scaling.learn(transitions).model_dump_json(indent=1) + "\n")


def save_transitions(folder: Path, transitions: Transitions) -> None:
    """Write `transitions.parquet` into an existing `folder`: one row a transition, the robot in the file's metadata."""
    names = transitions.robot.command_columns
    columns: dict[str, Any] = {
        "run": _named(transitions.run, transitions.runs),
        "vehicle": _named(transitions.vehicle, transitions.vehicles),
        "split": _named(transitions.split, SPLITS),
        "time_s": transitions.time_s,
        "duration_s": transitions.duration_s,
        **dict(zip(names, transitions.command.T, strict=True)),
        **dict(zip((f"previous_{name}" for name in names), transitions.previous_command.T, strict=True)),
        **dict(zip(POSE_COLUMNS, transitions.pose.T, strict=True)),
        **dict(zip(DISPLACEMENT_COLUMNS, transitions.displacement.T, strict=True)),
    }
    metadata = {
        "robot": transitions.robot.model_dump_json(),
        "runs": json.dumps(transitions.runs),
        "vehicles": json.dumps(transitions.vehicles),
    }
    pa.parquet.write_table(pa.table(columns, metadata=metadata), folder / TRANSITIONS_FILE)


def load_transitions(folder: Path) -> Transitions:
    """Read the transitions that `swarmtwin prepare` left in `folder`, their robot inside.

    Raises:
        UserError: there are none, or the file is damaged.
    """
    file = _existing(folder, TRANSITIONS_FILE)
    try:
        table = pa.parquet.read_table(file)
        metadata = {name.decode(): value for name, value in (table.schema.metadata or {}).items()}
        robot = Robot.model_validate_json(metadata["robot"])
        names = robot.command_columns
        return Transitions(
            robot=robot,
            command=_stacked(table, names),
            previous_command=_stacked(table, tuple(f"previous_{name}" for name in names)),
            pose=_stacked(table, POSE_COLUMNS),
            displacement=_stacked(table, DISPLACEMENT_COLUMNS),
            time_s=table.column("time_s").to_numpy(),
            duration_s=table.column("duration_s").to_numpy(),
            run=_index(table, "run", runs := tuple(json.loads(metadata["runs"]))),
            vehicle=_index(table, "vehicle", vehicles := tuple(json.loads(metadata["vehicles"]))),
            split=_index(table, "split", SPLITS).astype(np.int8),
            runs=runs,
            vehicles=vehicles,
        )
    except (pa.ArrowException, OSError, ValueError, KeyError) as error:
        what = f"no transitions can be read ({str(error).splitlines()[0]})"
        raise fault(file, what, "make it again with swarmtwin prepare") from None


def load_preparation(folder: Path) -> Preparation:
    """Read `preparation.json` in `folder`.

    Raises:
        UserError: it is missing or damaged.
    """
    return _load_json(folder, PREPARATION_FILE, Preparation)


def load_scaling(folder: Path) -> Scaling:
    """Read `scaling.json` in `folder`.

    Raises:
        UserError: it is missing or damaged.
    """
    return _load_json(folder, SCALING_FILE, Scaling)


def _load_json(folder: Path, name: str, model: type[Model]) -> Model:
    file = _existing(folder, name)
    try:
        return model.parse(json.loads(file.read_text()), str(file))
    except ValueError as error:
        raise fault(file, f"not valid JSON ({error})", "make it again with swarmtwin prepare") from None


def _existing(folder: Path, name: str) -> Path:
    file = Path(folder) / name
    if not file.is_file():
        raise UserError(f"{file} is missing: name a folder that swarmtwin prepare made")
    return file


def _named(index: np.ndarray, names: tuple[str, ...]) -> pa.DictionaryArray:
    return pa.DictionaryArray.from_arrays(pa.array(index.astype(np.int32)), pa.array(names, pa.string()))


def _index(table: pa.Table, name: str, names: tuple[str, ...]) -> np.ndarray:
    """Return (N,) the position in `names` of each text in a column."""
    encoded = table.column(name).cast(pa.string()).combine_chunks().dictionary_encode()
    positions = {text: index for index, text in enumerate(names)}
    translated = np.array([positions[text] for text in encoded.dictionary.to_pylist()], dtype=np.int64)
    return translated[encoded.indices.to_numpy()]


def _stacked(table: pa.Table, names: tuple[str, ...]) -> np.ndarray:
    return np.column_stack([table.column(name).to_numpy() for name in names])
