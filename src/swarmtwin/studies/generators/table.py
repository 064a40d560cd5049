"""Generators side by side: table.csv of `experiment name=generators` as a person reads it."""

from typing import Any

import pandas as pd
from rich import box
from rich.table import Table


def generator_rows(table: pd.DataFrame) -> list[dict[str, str]]:
    """Return each row of table.csv as a person reads it: what stands under which heading, one figure a line."""
    return [
        {
            "\ngenerator": row["generator"],
            "student\nmm, °": _student(row),
            "spread\n× real": " ".join(f"{row[f'spread_{part}_ratio']:.2f}" for part in ("forward", "left"))
            + f"\n{row['spread_turn_ratio']:.2f}",
            "precision\nrecall": f"{row['precision']:.3f}\n{row['recall']:.3f}",
            "told apart\nnearer": f"{row['told_apart']:.3f}\n{_or_nothing(row['nearer_to_learned'], '{:.3f}')}",
            "distance\ncopies": f"{row['neighbour_distance']:.4f}\n{_or_nothing(row['exact_copies'], '{:.0f}')}",
        }
        for row in table.to_dict("records")
    ]


def generator_table(title: str, table: pd.DataFrame, student: str, judged_on: str) -> Table:
    """Return the terminal's table: real transitions, then each generator."""
    title = f"{title}: {student} trained on each generator's transitions, judged on {judged_on} runs"
    shown = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, title=title)
    rows = generator_rows(table)
    for number, heading in enumerate(rows[0]):
        shown.add_column(heading, justify="right" if number else "left", no_wrap=True)
    for row in rows:
        shown.add_row(*row.values())
    shown.caption = (
        "real: trained on real transitions, and how they measure among themselves; student: mean ± standard deviation; "
        "spread: of displacements around what the situation lets expect, forward and left above, turn below; told "
        "apart by boosted trees, and nearer to rows learned from than to others: ideal 0.5; distance: to the 8 nearest "
        "real rows, columns scaled 0…1. All but the student is measured on validation runs"
    )
    return shown


def _student(row: dict[Any, Any]) -> str:
    if not pd.isna(row["dead"]):
        return "dead"
    return f"{_pair(row, 'position_mm', 'position_sd_mm')}\n{_pair(row, 'orientation_deg', 'orientation_sd_deg')}"


def _pair(row: dict[Any, Any], mean: str, spread: str) -> str:
    return f"{row[mean]:.2f} ± {row[spread]:.2f}"


def _or_nothing(value: float | None, text: str) -> str:
    return "" if value is None or pd.isna(value) else text.format(value)
