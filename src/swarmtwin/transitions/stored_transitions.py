"""Transitions that stay in their file and pass by one group of rows after the other, so that memory is bounded."""

import hashlib
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from swarmtwin.robot import Arena, Robot
from swarmtwin.transitions.storage import StoredHeader, read_transitions, readable
from swarmtwin.transitions.transitions import (
    SPLITS,
    Fields,
    Split,
    Transitions,
    array_fields,
    digested_fields,
    velocity_before,
)

BEFORE = ("displacement", "run", "vehicle", "time_s", "duration_s")
"""What velocities follow from, where the file has none."""


@dataclass(frozen=True)
class StoredTransitions:
    """The transitions in a file: a `TransitionSource` of which only what is asked for is in memory.

    Attributes:
        file: `.parquet`.
        remedy: what to do if it is damaged.
        header: what the file says of them as a whole.
        counts: how many transitions each split has.
    """

    file: Path
    remedy: str
    header: StoredHeader
    counts: Mapping[Split, int]

    @classmethod
    def of(cls, file: Path, remedy: str) -> Self:
        """Look into a file.

        Raises:
            UserError: it is missing or damaged.
        """
        with readable(file, remedy):
            header = StoredHeader.of(pa.parquet.read_schema(file))
        whole = cls(file, remedy, header, {})
        numbers = sum(
            (np.bincount(block["split"], minlength=len(SPLITS)) for block in whole.blocks(("split",))),
            start=np.zeros(len(SPLITS), dtype=int),
        )
        return cls(file, remedy, header, dict(zip(SPLITS, numbers.tolist(), strict=True)))

    @property
    def robot(self) -> Robot:
        """The robot they were measured on."""
        return self.header.robot

    @property
    def arena_mm(self) -> Arena:
        """Where its vehicles could move."""
        return self.header.arena_mm

    @property
    def runs(self) -> tuple[str, ...]:
        """Names of the runs."""
        return self.header.runs

    @property
    def vehicles(self) -> tuple[str, ...]:
        """Ids of the vehicles."""
        return self.header.vehicles

    def __len__(self) -> int:
        return sum(self.counts.values())

    def count(self, split: Split) -> int:
        """Return how many transitions a split has."""
        return self.counts[split]

    def blocks(self, names: Collection[str]) -> Iterator[Fields]:
        """Yield the arrays of these names, one group of rows after the other; velocities as `Transitions` has them.

        Raises:
            UserError: the file is damaged.
        """
        derived = "velocity" in names and not self.header.holds("velocity")
        read = dict.fromkeys((*(name for name in names if not derived or name != "velocity"), *(BEFORE * derived)))
        last: Fields = {}
        for group in range(self._groups()):
            fields = self._fields(group, read)
            if derived:
                known = {name: np.concatenate([last.get(name, fields[name][:0]), fields[name]]) for name in BEFORE}
                fields["velocity"] = velocity_before(**known)[len(known["run"]) - len(fields["run"]) :]
                last = {name: known[name][-1:] for name in BEFORE}
            yield {name: fields[name] for name in names}

    def chosen(self, choose: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Transitions:
        """Return, in memory, the transitions that a function of their run and split, (n,) each, chooses by a mask.

        Raises:
            UserError: the file is damaged.
        """
        names = array_fields()
        kept: dict[str, list[np.ndarray]] = {name: [] for name in names}
        for block in self.blocks(names):
            rows = choose(block["run"], block["split"])
            for name in names:
                kept[name].append(block[name][rows])
            del block
        return self.header.transitions({name: np.concatenate(kept.pop(name)) for name in names})

    def whole(self) -> Transitions:
        """Return, in memory, all of them.

        Raises:
            UserError: the file is damaged.
        """
        return read_transitions(self.file, self.remedy)

    def part(self, split: Split) -> Transitions:
        """Return, in memory, the transitions of one split."""
        return self.chosen(lambda _, splits: splits == SPLITS.index(split))

    def digests(self) -> dict[Split, str]:
        """Return the digest of each split's transitions, the same as `Transitions.digest`.

        Raises:
            UserError: the file is damaged.
        """
        contents = {split: hashlib.sha256(repr((self.runs, self.vehicles)).encode()) for split in SPLITS}
        for name in digested_fields(self.robot):
            for block in self.blocks(dict.fromkeys((name, "split"))):
                for number, split in enumerate(SPLITS):
                    contents[split].update(block[name][block["split"] == number].tobytes())
        return {split: content.hexdigest()[:16] for split, content in contents.items()}

    def _groups(self) -> int:
        with readable(self.file, self.remedy):
            return max(1, int(pa.parquet.read_metadata(self.file).num_row_groups))  # none, where nothing is stored

    def _fields(self, group: int, names: Collection[str]) -> dict[str, np.ndarray]:
        columns = [column for name in names for column in self.header.columns_of(name)]
        with readable(self.file, self.remedy), pa.parquet.ParquetFile(self.file) as file:
            if file.num_row_groups:
                table = file.read_row_group(group, columns=columns, use_threads=False)
            else:
                table = file.schema_arrow.empty_table()
            return {name: self.header.field(table, name) for name in names}
