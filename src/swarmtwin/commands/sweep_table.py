"""The table that a sweep ends with: one row a run, the options swept, its headline figures, and what it left."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich import box
from rich.table import Table

from swarmtwin.commands.catalogue import Ranking


def keep_row(folder: Path, number: int, overrides: Sequence[str], headline: Mapping[str, Any]) -> None:
    """Keep what a run came to in a folder: the runs of a sweep may be spread over processes.

    Args:
        folder: of the sweep.
        number: of the run.
        overrides: the options it was given, `name=value`.
        headline: its figures by name and unit, and its `output`; or why it `failed`.
    """
    folder.mkdir(exist_ok=True)
    options = dict(override.split("=", 1) for override in overrides if "=" in override)
    (folder / f"{number:06}.json").write_text(json.dumps({"options": options, "headline": dict(headline)}))


def read_rows(folder: Path) -> list[dict[str, Any]]:
    """Return the rows that a sweep's runs kept, in the order of the runs."""
    return [json.loads(file.read_text()) for file in sorted(folder.rglob("*.json"))]


def sweep_table(rows: Sequence[Mapping[str, Any]], ranking: Ranking) -> Table:
    """Return the table: the best run first, the failed ones last; in the runs' order where none is better."""
    known = dict.fromkeys(name for row in rows for name in row["options"] if name != "output")
    swept = [name for name in known if len({row["options"].get(name) for row in rows}) > 1]
    named = dict.fromkeys(name for row in rows for name in row["headline"])
    figures = [name for name in named if name not in ("output", "failed")]
    title = f"{len(rows)} runs" + (", best first" if ranking.by else "")
    table = Table(title=title, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for name in swept:
        table.add_column(name, overflow="fold")
    for name in figures:
        table.add_column(_heading(name), justify="right", overflow="fold")
    table.add_column("output", overflow="fold")
    ended = [row["headline"] for row in rows if "failed" not in row["headline"]]
    for row in sorted(rows, key=lambda row: _rank(row["headline"], ended, ranking)):
        options, headline = row["options"], row["headline"]
        left = f"failed: {headline['failed']}" if "failed" in headline else headline.get("output", "")
        values = [*(options.get(name, "") for name in swept), *(_text(headline.get(name)) for name in figures)]
        table.add_row(*values, left)
    return table


def _rank(headline: Mapping[str, Any], ended: Sequence[Mapping[str, Any]], ranking: Ranking) -> float:
    """Add the figures up, each in units of the best there is, so that they weigh alike; what failed comes last."""
    if "failed" in headline:
        return math.inf
    total = 0.0
    for name in ranking.by:
        values = [one[name] for one in ended if name in one]
        if len(values) == len(ended):
            unit = max(values) if ranking.highest_first else min(values)
            total += headline[name] / max(unit, 1e-12)
    return -total if ranking.highest_first else total


def _heading(name: str) -> str:
    """Write a figure's name as people do, its unit in a line of its own: position_mm → position, mm."""
    words, _, last = name.rpartition("_")
    unit = {"mm": "mm", "deg": "°", "s": "s", "percent": "%"}.get(last)
    return f"{words.replace('_', ' ')}\n{unit}" if words and unit else name.replace("_", " ")


def _text(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.4g}" if isinstance(value, float) else str(value)
