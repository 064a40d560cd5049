"""Models trained on real and on synthetic transitions side by side: what a person reads of their table.csv."""

from typing import Any, NamedTuple

import pandas as pd
from rich import box
from rich.table import Table

ERRORS = ("position_mm", "orientation_deg")


class CaseRow(NamedTuple):
    """One case as a person reads it; errors first in mm, then in degrees, and × those of CR-Net-R on all real data."""

    title: str
    inputs: str
    real: str
    steps: str
    train_vehicle: list[str]
    other_vehicle: list[str]
    dead_seeds: str


def case_rows(table: pd.DataFrame) -> list[CaseRow]:
    """Return the floor and then each case of table.csv, in its order."""
    rows = {place: {row["case"]: row for row in part.to_dict("records")} for place, part in table.groupby("recording")}
    train, other = rows["train_vehicle"], rows["other_vehicle"]
    shown = [CaseRow("floor", "", "", "", _floor(train["real"]), _floor(other["real"]), "")]
    for case, row in train.items():
        shown.append(
            CaseRow(
                title=str(row["title"]),
                inputs=str(row["inputs"]),
                real=f"{row['real']:,}",
                steps=f"{row['steps']:,}",
                train_vehicle=_compared(row, train["real"]),
                other_vehicle=_compared(other[case], other["real"]),
                dead_seeds=f"{row['dead_seeds']} of {row['seeds']}",
            )
        )
    return shown


def case_table(title: str, table: pd.DataFrame) -> Table:
    """Return the terminal's table: the floor, then a row for each case."""
    title = f"{title}: trained on real and on synthetic transitions"
    shown = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, title=title)
    shown.add_column("case\n  given", no_wrap=True)
    for heading in ("real\nseen", "\nsteps", "train vehicle\nmm, °", "other vehicle\nmm, °", "dead\nseeds"):
        shown.add_column(heading, justify="right", no_wrap=True)
    for row in case_rows(table):
        cells = ["\n".join(cell) if isinstance(cell, list) else cell for cell in row[2:]]
        given = f"\n  {row.inputs}" if row.inputs else ""
        shown.add_row(f"{row.title}{given}", *cells, style="dim" if row.title == "floor" else None)
    shown.caption = (
        "on runs nobody has seen; ×: compared with CR-Net-R on all real transitions; given: what the model looks at; "
        "the ensemble is what the generator of CR-Net-S predicts the mean with, here used directly"
    )
    return shown


def _floor(row: dict[Any, Any]) -> list[str]:
    return [f"{row[f'floor_{name}']:.2f}       " for name in ERRORS]


def _compared(row: dict[Any, Any], reference: dict[Any, Any]) -> list[str]:
    if any(pd.isna(row[name]) for name in ERRORS):
        return ["dead"]
    return [f"{row[name]:.2f} ×{row[name] / reference[name]:.3f}" for name in ERRORS]
