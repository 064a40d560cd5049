"""How a fault of a recording's file is told: which file, which row and column, what is wrong, and the remedy."""

from pathlib import Path

from swarmtwin.errors import UserError


def fault(file: Path, what: str, remedy: str, row: int | None = None, column: str | None = None) -> UserError:
    """Return the error for one fault. `row` counts from 1 as an editor shows it: a CSV file's header is row 1."""
    where = str(file)
    if row is not None:
        where += f", row {row}"
    if column is not None:
        where += f", column {column!r}"
    return UserError(f"{where}: {what}: {remedy}")
