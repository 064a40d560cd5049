"""Policies side by side: what a person reads of the table.csv of their roll-outs in simulation and on stand-ins."""

from typing import Any

import pandas as pd
from rich import box
from rich.table import Table

from swarmtwin.policies.rollout_comparison import MOTION_NAMES


def policy_rows(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Return each policy of table.csv as a person reads it; of two figures the simulation's stands first."""
    return [
        {
            "policy": row["policy"],
            "learned_in": row["simulation"],
            "where": list(MOTION_NAMES.values()),
            "reward": [f"{row[f'{motion}_reward']:.2f} ± {row[f'{motion}_reward_sd']:.2f}" for motion in MOTION_NAMES],
            "difference": f"{row['reward_difference_percent_value']:+.1f}",
            "success": [_rate(row, f"{motion}_success") for motion in MOTION_NAMES],
            "collisions": [f"{row[f'{motion}_collision']:.0%}" for motion in MOTION_NAMES],
            "time_s": [f"{row[f'{motion}_reach_time_s']:.0f}" for motion in MOTION_NAMES],
        }
        for row in table.to_dict("records")
    ]


def policy_table(title: str, table: pd.DataFrame) -> Table:
    """Return the terminal's table: two lines for each policy."""
    shown = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    shown.title = f"{title}: policies on {int(table.rollouts.iloc[0])} equal starts"
    shown.add_column("\npolicy", no_wrap=True)
    shown.add_column("\nin", no_wrap=True)
    for heading in ("\nreward", "\nsuccess", "colli-\nsions", "time\ns", "diffe-\nrence %"):
        shown.add_column(heading, justify="right", no_wrap=True)
    for row in policy_rows(table):
        pairs = ("\n".join(row[column]) for column in ("where", "reward", "success", "collisions", "time_s"))
        shown.add_row(row["policy"], *pairs, f"\n{row['difference']}")
    shown.caption = (
        "stand-ins: other vehicles than the one recorded; reward a vehicle and step, mean ± standard deviation; "
        "success with its 95 % interval; difference: of the reward, stand-ins against simulation"
    )
    return shown


def _rate(row: dict[Any, Any], name: str) -> str:
    return f"{row[name]:.0%} ({100 * row[f'{name}_low']:.0f} to {100 * row[f'{name}_high']:.0f})"
