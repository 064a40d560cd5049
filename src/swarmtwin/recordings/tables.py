"""Files of runs, CSV or Parquet, parsed into columns of numbers; what cannot be parsed is told by row and column."""

import csv
import difflib
import functools
import itertools
import operator
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet

from swarmtwin.configuration import config_files
from swarmtwin.errors import UserError
from swarmtwin.files import check_regular
from swarmtwin.recordings.recording import fault
from swarmtwin.robot import POSE_COLUMNS, Robot

RUN_COLUMN = "run"


def run_columns(robot: Robot) -> tuple[str, ...]:
    """Return the columns of a run's file, in the order they are written."""
    return ("time_s", "vehicle", *robot.command_columns, *POSE_COLUMNS)


def check_columns(found: Sequence[str], robot: Robot, file: Path) -> tuple[str, ...]:
    """Check that the columns `found` in `file` hold those of `robot`; return the ones that nothing reads.

    Raises:
        UserError: a column is missing or stands twice.
    """
    if repeated := [name for name, count in Counter(found).items() if count > 1]:
        raise fault(file, f"column {repeated[0]!r} stands twice", "keep one of them", row=1)
    required = run_columns(robot)
    missing = [name for name in required if name not in found]
    if missing:
        raise _missing_column(missing[0], found, robot, file)
    return tuple(name for name in found if name not in required)


def _missing_column(missing: str, found: Sequence[str], robot: Robot, file: Path) -> UserError:
    for other in known_robots() if missing in robot.command_columns else ():
        if other.name != robot.name and set(run_columns(other)) <= set(found):
            what = f"the columns are those of robot {other.name!r}, not of {robot.name!r}"
            return fault(file, what, f"put the file in a recording of {other.name!r}, and read that one", row=1)
    unread = [name for name in found if name not in run_columns(robot)]
    meant = difflib.get_close_matches(missing, unread, n=1, cutoff=0.6)
    remedy = f"rename {meant[0]!r} to {missing!r}" if meant else f"add it; {robot.name!r} needs them all"
    return fault(file, f"column {missing!r} is missing, there are {', '.join(found)}", remedy, row=1)


@functools.cache
def known_robots() -> tuple[Robot, ...]:
    """Return the robots of `conf/robot/`, here and beside the user's plug-ins."""
    return tuple(Robot.load(file) for _, file in sorted(config_files("robot").items()))


_BAD_CELL = re.compile(r"In CSV column #(\d+): Row #(\d+): .*invalid value '(.*)'", re.DOTALL)
_BAD_LENGTH = re.compile(r"Row #(\d+): Expected (\d+) columns, got (\d+)")


@dataclass(frozen=True)
class RunTable:
    """The R rows of one run's file, in the file's order; a cell that is empty is NaN.

    Attributes:
        file: where they stand.
        time_s: (R,).
        vehicle: (R,) index into `vehicles`.
        command: (R, m) in the robot's units.
        pose: (R, 3) x_mm, y_mm, heading_rad in the arena's frame.
        vehicles: the ids, as text.
        truncated: the file broke off within its last row, which is left out.
        unread: columns that nothing reads.
        row_number: gives the row, as an editor shows it, of an index into the arrays.
    """

    file: Path
    time_s: np.ndarray
    vehicle: np.ndarray
    command: np.ndarray
    pose: np.ndarray
    vehicles: tuple[str, ...]
    truncated: bool
    unread: tuple[str, ...]
    row_number: Callable[[int], int]

    def __len__(self) -> int:
        return len(self.time_s)

    def at(self, rows: np.ndarray, truncated: bool) -> Self:
        """Return those rows (S,), which keep their numbers; whether the file broke off after them is to be said."""
        whole = self.row_number
        return replace(
            self,
            time_s=self.time_s[rows],
            vehicle=self.vehicle[rows],
            command=self.command[rows],
            pose=self.pose[rows],
            truncated=truncated,
            row_number=lambda index: whole(int(rows[index])),
        )

    def with_headings_in_degrees(self) -> Self:
        """Return it with headings taken for degrees."""
        return replace(self, pose=np.column_stack([self.pose[:, :2], np.deg2rad(self.pose[:, 2])]))


def parse_run(file: Path, content: bytes, robot: Robot) -> RunTable:
    """Parse the `content` of `file`, a run of `robot`.

    Raises:
        UserError: the content is damaged, or its columns are not the robot's.
    """
    if not content:
        raise fault(file, "the file is empty", "record the run again, or remove the file")
    return _parse_parquet(file, content, robot) if file.suffix == ".parquet" else _parse_csv(file, content, robot)


def _parse_csv(file: Path, content: bytes, robot: Robot) -> RunTable:
    _check_text(file, content)
    complete = content[: max(content.rfind(b"\n"), content.rfind(b"\r")) + 1]
    found = _csv_header(file, content, complete)
    unread = check_columns(found, robot, file)
    table = _read_csv(file, complete, found, robot)
    if not len(table) and len(complete) == len(content):
        raise fault(file, "there is a header and no rows", "record the run again, or remove the file")

    def row_number(index: int) -> int:
        return _line_number(complete, index + 1)

    return _run_table(file, [table], robot, len(complete) < len(content), unread, row_number)


def _check_text(file: Path, content: bytes) -> None:
    """Refuse what only damage puts into a CSV file: NUL, bytes that are no text, open quotes."""
    remedy = "the file is damaged or no CSV file; copy it again from where it was recorded"
    if (position := content.find(b"\0")) >= 0:
        raise fault(file, "a NUL byte", remedy, row=_line_at(content, position))
    try:
        content.decode()
    except UnicodeDecodeError as error:
        text = f"save it as UTF-8; or {remedy}"
        raise fault(file, "bytes that are not UTF-8 text", text, row=_line_at(content, error.start)) from None
    if b'"' in content:
        for number, line in enumerate(content.splitlines(), start=1):
            if line.count(b'"') % 2:
                raise fault(file, "a quotation mark without its partner", "remove it", row=number)


def _csv_header(file: Path, content: bytes, complete: bytes) -> list[str]:
    header = next((line for line in complete.splitlines() if line), None)
    if header is None:
        what = "the file breaks off in its header" if content.strip() else "the file is empty"
        raise fault(file, what, "record the run again, or remove the file")
    text = header.decode("utf-8-sig")
    found = next(csv.reader([text]))
    if len(found) == 1 and (signs := [name for sign, name in ((";", "semicolons"), ("\t", "tabs")) if sign in text]):
        raise fault(file, f"columns are separated by {signs[0]}", "save it again with commas, and points in numbers", 1)
    return found


def _read_csv(file: Path, complete: bytes, found: list[str], robot: Robot) -> pa.Table:
    columns = run_columns(robot)
    types = {name: pa.string() if name == "vehicle" else pa.float64() for name in columns}
    empty = ["", "nan", "NaN", "NAN"]
    convert = pa.csv.ConvertOptions(column_types=types, include_columns=columns, null_values=empty)
    # One thread, so that pyarrow knows the rows' numbers; streamed, which spares small files a change of thread.
    options = pa.csv.ReadOptions(use_threads=False, block_size=min(len(complete) + 1, 16 * 2**20))
    try:
        return pa.csv.open_csv(pa.py_buffer(complete), read_options=options, convert_options=convert).read_all()
    except pa.ArrowInvalid as error:
        raise _csv_fault(file, complete, found, str(error)) from None


def _csv_fault(file: Path, complete: bytes, found: list[str], message: str) -> UserError:
    if cell := _BAD_CELL.search(message):
        column, row, value = found[int(cell[1])], _line_number(complete, int(cell[2]) - 1), cell[3]
        return fault(file, f"{value!r} is not a number", "write a number, or leave the cell empty", row, column)
    if length := _BAD_LENGTH.search(message):
        what = f"{length[3]} fields instead of {length[2]}"
        row = _line_number(complete, int(length[1]) - 1)
        return fault(file, what, "give every row the header's columns, separated by commas", row)
    return fault(file, message.splitlines()[0], "the file is damaged; copy it again from where it was recorded")


def _line_at(content: bytes, position: int) -> int:
    return len(content[:position].splitlines()) + (content[:position].endswith((b"\n", b"\r")) or position == 0)


def _line_number(content: bytes, index: int) -> int:
    """Return the number, from 1, of the line that is the `index`-th not empty, from 0; empty lines are no rows."""
    filled = (number for number, line in enumerate(content.splitlines(), start=1) if line)
    return next(number for position, number in enumerate(filled) if position == index)


def _parse_parquet(file: Path, content: bytes, robot: Robot) -> RunTable:
    try:
        parquet = pa.parquet.ParquetFile(pa.BufferReader(content), page_checksum_verification=True)
        unread = check_columns(parquet.schema_arrow.names, robot, file)
        stored = parquet.read(columns=list(run_columns(robot)), use_threads=False)
        stored.validate(full=True)
    except (pa.ArrowException, OSError, ValueError) as error:
        raise _unreadable(file, error) from None
    if not len(stored):
        raise fault(file, "there are no rows", "record the run again, or remove the file")
    return _run_table(file, [_cast_columns(file, stored, robot)], robot, False, unread, lambda index: index + 1)


def parse_runs_together(file: Path, robot: Robot) -> Iterator[tuple[str, RunTable]]:
    """Parse a Parquet file of many runs, one row group after another; yield each run's name and rows.

    Raises:
        UserError: the file is damaged, its columns are not those of the robot and `run`, or a run's rows do not stand
            together.
    """
    check_regular(file)
    try:
        parquet = pa.parquet.ParquetFile(file, buffer_size=2**20, page_checksum_verification=True)
        names = parquet.schema_arrow.names
    except (pa.ArrowException, OSError, ValueError) as error:
        raise _unreadable(file, error) from None
    with parquet:
        unread = tuple(name for name in check_columns(names, robot, file) if name != RUN_COLUMN)
        if RUN_COLUMN not in names:
            raise fault(file, f"column {RUN_COLUMN!r} is missing", "add it: the name of the run that each row is of")
        done: set[str] = set()
        for run, first_row, pieces in _rows_by_run(file, parquet, robot):
            if run in done:
                raise fault(file, f"the rows of run {run!r} do not stand together", "sort the rows by run", first_row)
            done.add(run)
            yield run, _run_table(file, pieces, robot, False, unread, functools.partial(operator.add, first_row))
    if not done:
        raise fault(file, "there are no rows", "record again, or remove the file")


def count_runs(file: Path, most: int) -> int:
    """Return how many runs a Parquet file of many runs holds; `most` where it is more, or where it cannot be read."""
    names: set[str] = set()
    try:
        with pa.parquet.ParquetFile(file, buffer_size=2**20) as parquet:
            for batch in parquet.iter_batches(250_000, columns=[RUN_COLUMN], use_threads=False):
                names.update(filter(None, pc.unique(batch.column(0).cast(pa.string())).to_pylist()))
                if len(names) >= most:
                    break
    except (pa.ArrowException, OSError, ValueError, IndexError):
        return most  # whoever reads it says what is wrong
    return min(len(names), most)


def _rows_by_run(
    file: Path, parquet: pa.parquet.ParquetFile, robot: Robot
) -> Iterator[tuple[str, int, list[pa.Table]]]:
    """Yield runs of equal names as they stand: name, number of the first row from 1, rows in pieces."""
    begun: list[pa.Table] = []
    name, first_row, row = "", 1, 1
    for stored in _stored_rows(file, parquet, [RUN_COLUMN, *run_columns(robot)]):
        runs = _cast(file, RUN_COLUMN, stored.column(RUN_COLUMN)).combine_chunks().dictionary_encode()
        names = runs.dictionary.to_pylist()
        code = pc.fill_null(runs.indices, -1).to_numpy(zero_copy_only=False)
        nameless = (code < 0) | np.isin(code, [index for index, text in enumerate(names) if not text.strip()])
        if nameless.any():
            raise fault(file, "no run is named", "write the run's name", row + int(np.argmax(nameless)), RUN_COLUMN)
        table = _cast_columns(file, stored, robot)
        edges = [0, *(np.flatnonzero(code[1:] != code[:-1]) + 1).tolist(), len(code)] if len(code) else [0]
        for start, end in itertools.pairwise(edges):
            if begun and names[code[start]] != name:
                yield name, first_row, begun
                begun = []
            if not begun:
                name, first_row = names[code[start]], row + start
            begun.append(table.slice(start, end - start))
        row += len(code)
    if begun:
        yield name, first_row, begun


def _stored_rows(
    file: Path, parquet: pa.parquet.ParquetFile, columns: Sequence[str], most: int = 250_000
) -> Iterator[pa.Table]:
    """Yield the rows of a file, at most so many at a time: others than we write one row group of millions.

    Row groups are read some at a time, since what is read ahead of one is kept until all of them have passed by.
    """
    for groups in _groups_together(parquet.metadata, most):
        batches = parquet.iter_batches(most, row_groups=groups, columns=list(columns), use_threads=False)
        while True:
            try:
                batch = next(batches, None)
                if batch is None:
                    break
                batch.validate(full=True)
            except (pa.ArrowException, OSError, ValueError) as error:
                raise _unreadable(file, error) from None
            yield pa.Table.from_batches([batch])


def _groups_together(metadata: pa.parquet.FileMetaData, rows: int) -> Iterator[list[int]]:
    """Yield numbers of row groups, some at a time that hold so many rows or are one."""
    together: list[int] = []
    held = 0
    for group in range(metadata.num_row_groups):
        together.append(group)
        held += metadata.row_group(group).num_rows
        if held >= rows:
            yield together
            together, held = [], 0
    if together:
        yield together


def _cast_columns(file: Path, stored: pa.Table, robot: Robot) -> pa.Table:
    return pa.table({name: _cast(file, name, stored.column(name)) for name in run_columns(robot)})


def _unreadable(file: Path, error: Exception) -> UserError:
    damaged = "the file is damaged or cut off; copy it again from where it was recorded"
    return fault(file, f"no Parquet file can be read ({str(error).splitlines()[0]})", damaged)


def _cast(file: Path, name: str, column: pa.ChunkedArray) -> pa.ChunkedArray:
    kind = column.type.value_type if pa.types.is_dictionary(column.type) else column.type
    text = pa.types.is_string(kind) or pa.types.is_large_string(kind)
    is_name = name in ("vehicle", RUN_COLUMN)
    fits = text if is_name else pa.types.is_floating(kind) or pa.types.is_null(kind)
    if not fits and not pa.types.is_integer(kind):
        wanted = "text" if is_name else "numbers"
        raise fault(file, f"values of type {kind} instead of {wanted}", f"store {wanted}", column=name)
    return column.cast(pa.string() if is_name else pa.float64(), safe=False)


def _run_table(
    file: Path,
    pieces: list[pa.Table],
    robot: Robot,
    truncated: bool,
    unread: tuple[str, ...],
    row_number: Callable[[int], int],
) -> RunTable:
    """Put the rows of a run together, which come in pieces; each is let go, so that a long run is in memory once."""
    count = sum(map(len, pieces))
    vehicle, numbers = np.empty(count, np.int32), np.empty((count, 1 + len(robot.command_columns) + len(POSE_COLUMNS)))
    vehicles: dict[str | None, int] = {}
    first = 0
    pieces.reverse()
    while pieces:
        piece = pieces.pop()
        rows = slice(first, first + len(piece))
        vehicle[rows] = _codes(piece.column("vehicle"), vehicles)
        for place, name in enumerate(("time_s", *robot.command_columns, *POSE_COLUMNS)):
            numbers[rows, place] = piece.column(name).to_numpy()
        first += len(piece)
    pa.default_memory_pool().release_unused()
    nameless = [code for name, code in vehicles.items() if not (name or "").strip()]
    if nameless:
        row = row_number(int(np.argmax(np.isin(vehicle, nameless))))
        raise fault(file, "no vehicle is named", "write the vehicle's id", row, "vehicle")
    return RunTable(
        file=file,
        time_s=numbers[:, 0],
        vehicle=vehicle,
        command=numbers[:, 1 : -len(POSE_COLUMNS)],
        pose=numbers[:, -len(POSE_COLUMNS) :],
        vehicles=tuple(name for name in vehicles if name is not None),
        truncated=truncated,
        unread=unread,
        row_number=row_number,
    )


def _codes(names: pa.ChunkedArray, known: dict[str | None, int]) -> np.ndarray:
    """Return (R,) the number of each name, None for an empty cell; those that are new are added to what is `known`."""
    encoded = names.combine_chunks().dictionary_encode(null_encoding="encode")
    numbers = [known.setdefault(name, len(known)) for name in encoded.dictionary.to_pylist()]
    codes: np.ndarray = np.array(numbers, np.int32)[encoded.indices.to_numpy(zero_copy_only=False)]
    return codes
