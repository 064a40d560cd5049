"""Generators side by side: table.csv of `experiment name=table4` as a person reads it."""

from typing import Any

import pandas as pd
from rich import box
from rich.table import Table


def generator_rows(table: pd.DataFrame) -> list[dict[str, str]]:
    """Return each row of table.csv as a person reads it: what stands under which heading."""
    return [
        {
            "generator": row["generator"],
            "student, mm": _pair(row, "position_mm", "position_sd_mm") if pd.isna(row["dead"]) else "dead",
            "student, °": _pair(row, "orientation_deg", "orientation_sd_deg") if pd.isna(row["dead"]) else "dead",
            "spread, × real": " ".join(f"{row[f'spread_{part}_ratio']:.2f}" for part in ("forward", "left", "turn")),
            "precision": f"{row['precision']:.3f}",
            "recall": f"{row['recall']:.3f}",
            "distance": f"{row['neighbour_distance']:.4f}",
            "told apart": f"{row['told_apart']:.3f}",
            "nearer to learned": _or_nothing(row["nearer_to_learned"], "{:.3f}"),
            "copies": _or_nothing(row["exact_copies"], "{:.0f}"),
        }
        for row in table.to_dict("records")
    ]


def generator_table(title: str, table: pd.DataFrame, student: str, judged_on: str) -> Table:
    """Return the terminal's table: real transitions, then each generator."""
    title = f"{title}: {student} trained on transitions of each generator, judged on {judged_on} runs"
    shown = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, title=title)
    rows = generator_rows(table)
    for heading in rows[0]:
        shown.add_column(heading, justify="left" if heading == "generator" else "right", no_wrap=heading == "generator")
    for row in rows:
        shown.add_row(*row.values())
    shown.caption = (
        "real: trained on real transitions, and how real ones measure among themselves; student: mean ± standard "
        "deviation; spread: of displacements around what the situation lets expect, forward, left and turn; distance: "
        "to the 8 nearest real rows, columns scaled 0…1; told apart by boosted trees and nearer to rows learned from "
        "than to others: ideal 0.5. Quality is measured on validation runs"
    )
    return shown


def _pair(row: dict[Any, Any], mean: str, spread: str) -> str:
    return f"{row[mean]:.2f} ± {row[spread]:.2f}"


def _or_nothing(value: float | None, text: str) -> str:
    return "" if value is None or pd.isna(value) else text.format(value)
