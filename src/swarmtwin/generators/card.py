"""The card of a generator: what a stranger needs to know before sampling from it."""

from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined

from swarmtwin.generators.quality import Quality
from swarmtwin.robot import DISPLACEMENT_COLUMNS, Robot

MEANINGS = {
    "x_mm": "where the vehicle is at the start of the period, in the arena's frame",
    "y_mm": "likewise",
    "heading_rad": "where it looks then, counter-clockwise from the arena's x axis, (−π, π]",
    "forward_mm": "how far it moves over the period along its nose, in its frame at the start",
    "left_mm": "how far to its left, likewise",
    "turn_rad": "how far it turns, counter-clockwise positive",
}


def card(description: dict[str, Any], robot: Robot, quality: Quality) -> str:
    """Write the card of a generator from the content of its `generator.yaml`."""
    environment = Environment(
        loader=PackageLoader("swarmtwin.generators", "."),
        undefined=StrictUndefined,
        keep_trailing_newline=True,
        trim_blocks=True,
    )
    limits = {name: f"command, {column.low:g} to {column.high:g}" for name, column in robot.command.items()}
    return environment.get_template("card.md.jinja").render(
        robot=robot,
        kind=description["generator"]["name"],
        columns=[(name, unit, limits.get(name) or MEANINGS[name]) for name, unit in description["columns"].items()],
        lineage=description["lineage"],
        quality=quality,
        spreads=[_spread_row(name, quality) for name in DISPLACEMENT_COLUMNS],
    )


def _spread_row(name: str, quality: Quality) -> tuple[str, str, str, str]:
    """Return a displacement in a unit people read, and its spreads in generated, learned and held-out rows."""
    in_degrees = name == "turn_rad"
    factor = 180 / np.pi if in_degrees else 1.0
    sets = (quality.synthetic.spread, quality.real.spread, quality.held_out_spread)
    generated, learned, held_out = (f"{factor * spread[name]:.2f}" for spread in sets)
    return "turn, °" if in_degrees else name.replace("_mm", ", mm"), generated, learned, held_out
