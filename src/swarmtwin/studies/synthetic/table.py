"""Models trained on real and on synthetic transitions side by side: their table.csv as a person reads it."""

from typing import Any

import pandas as pd
from rich import box
from rich.table import Table

ERRORS = {"position_mm": "position error, mm", "orientation_deg": "orientation error, °"}
PLACES = {"train_vehicle": "vehicle learned from", "other_vehicle": "another vehicle"}


def case_rows(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the floor and then each case of table.csv, in its order, as a person reads it.

    Errors stand first in mm, then in degrees, each × that of CR-Net-R on all real data.
    """
    rows = {place: {row["case"]: row for row in part.to_dict("records")} for place, part in table.groupby("recording")}
    real = {place: rows[place]["real"] for place in PLACES}
    floor = {place: [f"{real[place][f'floor_{name}']:.2f}       " for name in ERRORS] for place in PLACES}
    shown: list[dict[str, Any]] = [
        {"title": "floor", "inputs": "", "real": "", "steps": "", **floor, "dead_seeds": ""},
    ]
    for case, row in rows["train_vehicle"].items():
        shown.append(
            {
                "title": row["title"],
                "inputs": row["inputs"],
                "real": f"{row['real']:,}",
                "steps": f"{row['steps']:,}",
                **{place: _compared(rows[place][case], real[place]) for place in PLACES},
                "dead_seeds": f"{row['dead_seeds']} of {row['seeds']}",
            }
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
        errors = ("\n".join(row[place]) for place in PLACES)
        given = f"\n  {row['inputs']}" if row["inputs"] else ""
        style = "dim" if row["title"] == "floor" else None
        shown.add_row(f"{row['title']}{given}", row["real"], row["steps"], *errors, row["dead_seeds"], style=style)
    shown.caption = (
        "on runs nobody has seen; ×: compared with CR-Net-R on all real transitions; given: what the model looks at; "
        "the ensemble is what the generator of CR-Net-S predicts the mean with, here used directly"
    )
    return shown


def _compared(row: dict[Any, Any], reference: dict[Any, Any]) -> list[str]:
    if any(pd.isna(row[name]) for name in ERRORS):
        return ["dead"]
    return [f"{row[name]:.2f} ×{row[name] / reference[name]:.3f}" for name in ERRORS]
