"""The table of the tracking study as a person reads it."""

from collections.abc import Mapping

import pandas as pd
from rich import box
from rich.table import Table


def tracking_table(title: str, table: pd.DataFrame, figures: Mapping[str, float]) -> Table:
    """Return the terminal's table: a block for each case, a row for each method."""
    shown = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, title=f"{title}: poses from pictures")
    shown.add_column("case\n  method", ratio=1)
    for heading in ("found\n%", "p50\nmm", "p99\nmm", "bias\nmm", "p50\n°", "p99\n°", "a picture\nms"):
        shown.add_column(heading, justify="right", no_wrap=True, min_width=5)
    for _, rows in table.groupby("case", sort=False):
        shown.add_row(f"[bold]{rows.case_title.iloc[0]}[/bold]")
        for row in rows.to_dict("records"):
            cells = [_number(row[name], digits) for name, digits in COLUMNS.items()]
            style = None if row["method"] in ("tracker", "measured_height", "measured_lens") else "dim"
            shown.add_row(f"  {row['method_title']}", f"{100 * row['found_share']:.1f}", *cells, style=style)
    poses = int(table.poses.iloc[0])
    shown.caption = (
        f"{poses} random poses a case, each picture looked at by itself; following vehicles that drive on "
        f"takes the tracker {figures['following_ms']:.1f} ms; bias: mean error of the worst camera"
    )
    return shown


COLUMNS = {"p50_mm": 3, "p99_mm": 3, "bias_mm": 3, "p50_deg": 3, "p99_deg": 3, "picture_ms": 1}
"""Decimals of each."""


def _number(value: float, digits: int) -> str:
    return "" if pd.isna(value) else f"{value:.{digits}f}"
