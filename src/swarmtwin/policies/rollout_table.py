"""What a person reads of a policy's roll-outs in simulation and on stand-ins."""

from typing import Any

import numpy as np
from rich import box
from rich.table import Table

from swarmtwin.policies.rollout_comparison import MOTION_NAMES, Difference
from swarmtwin.world.rollout import Rollout, figures_of


def comparison_table(name: str, rollouts: dict[str, Rollout], metrics: dict[str, Any]) -> Table:
    """Return the terminal's table: a column for the simulation and one for the stand-ins."""
    count = len(next(iter(rollouts.values())))
    shown = Table(box=box.SIMPLE_HEAD, title=f"{name}: {count} roll-outs from the same starts")
    shown.add_column("")
    for motion in rollouts:
        shown.add_column(MOTION_NAMES[motion], justify="right", no_wrap=True)
    figures = [figures_of(rollout) for rollout in rollouts.values()]
    shown.add_row("reward a vehicle and step", *(f"{f.reward:.2f} ± {f.reward_sd:.2f}" for f in figures))
    labels = {"success": "success", "collision": "with a collision", "left_arena": "left the arena"}
    for quantity, label in labels.items():
        rates = [getattr(each, quantity) for each in figures]
        shown.add_row(label, *(f"{rate.value:.0%} ({rate.low:.0%} to {rate.high:.0%})" for rate in rates))
    shown.add_row("time to reach, s", *(_spread(f.reach_time_s, f.reach_time_sd_s, 1, "none did") for f in figures))
    shown.add_row(
        "distance in the end, mm",
        *(_spread(f.final_distance_mm, f.final_distance_sd_mm, 0, "no target") for f in figures),
    )
    shown.caption = "mean ± standard deviation over roll-outs; rates with 95 % intervals"
    if difference := metrics.get("reward_difference_percent"):
        found = Difference(difference["value"], difference["low"], difference["high"])
        shown.caption += f"\nreward on stand-ins against simulation: {found}"
    return shown


def _spread(mean: float, deviation: float, digits: int, missing: str) -> str:
    return missing if np.isnan(mean) else f"{mean:.{digits}f} ± {deviation:.{digits}f}"
