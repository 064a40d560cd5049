"""The table of the loop: what each policy did on the fleet, and what was found between."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from rich import box
from rich.table import Table

from swarmtwin.robot import StrictModel


class Stage(StrictModel):
    """Deployments of one policy by one simulation.

    Attributes:
        name: of the folders.
        words: for the table.
        policy: a folder, or a registered policy.
        simulation: that predicts, looks ahead and watches.
    """

    name: str
    words: str
    policy: str
    simulation: Path


def loop_table(title: str, stages: Sequence[Stage], deployments: pd.DataFrame, diagnosis: dict[str, Any]) -> Table:
    """Return the table that a person reads: a row for each stage."""
    shown = Table(box=box.SIMPLE_HEAD, title=f"{title}: the loop closed")
    shown.add_column("policy", ratio=1)
    for column in ("drives", "reached", "stopped", "reward", "time, s", "weakened", "alarms"):
        shown.add_column(column, justify="right", no_wrap=True)
    for stage in stages:
        rows = deployments[deployments["stage"] == stage.name]
        shown.add_row(
            stage.words,
            str(len(rows)),
            f"{int(rows['success'].sum())}",
            f"{int((rows['ending'] != 'done').sum())}",
            _spread(rows["reward"]),
            _spread(rows["reach_time_s"].dropna()),
            f"{rows['weakened'].mean():.0f}",
            f"{rows['alarms'].mean():.1f}",
        )
    shown.caption = f"found between: {_found(diagnosis)}"
    return shown


def _found(diagnosis: dict[str, Any]) -> str:
    causes = []
    for cause in diagnosis["causes"]:
        values = (
            f"{name} {one['value']:.3g} ({one['low']:.3g} to {one['high']:.3g})"
            for name, one in cause["parameters"].items()
        )
        causes.append(f"{cause['name']}: {', '.join(values)}")
    return "; ".join(causes) or f"no cause ({diagnosis['verdict']})"


def _spread(values: pd.Series) -> str:
    if values.empty:
        return "none"
    return f"{values.mean():.2f} ± {values.std(ddof=0):.2f}"
