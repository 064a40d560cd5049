"""Policies side by side: what a person reads of the table.csv of their roll-outs in simulation and on stand-ins."""

from typing import Any

import pandas as pd

from swarmtwin.policies.rollout_comparison import MOTION_NAMES
from swarmtwin.studies.study_table import StudyTable


def policy_table(title: str, table: pd.DataFrame) -> StudyTable:
    """Return each policy of table.csv, two lines for each: what is rolled out in simulation, and on stand-ins."""
    rows = [
        [
            row["policy"],
            "\n".join(MOTION_NAMES.values()),
            *map("\n".join, zip(*(_figures(row, motion) for motion in MOTION_NAMES), strict=True)),
            f"\n{row['reward_difference_percent_value']:+.1f}",
        ]
        for row in table.to_dict("records")
    ]
    return StudyTable(
        f"{title}: policies of {' and '.join(table.simulation.unique())} on {table.rollouts.iloc[0]} equal starts",
        ("\npolicy", "\nin", "\nreward", "\nsuccess", "colli-\nsions", "time\ns", "diffe-\nrence %"),
        rows,
        "stand-ins: other vehicles than the one recorded; reward a vehicle and step, mean ± standard deviation; "
        "success with its 95 % interval: all vehicles reach the target, and nothing ever collides or leaves the arena; "
        "difference: of the reward, stand-ins against simulation",
        left=(1,),
    )


def _figures(row: dict[Any, Any], motion: str) -> tuple[str, str, str, str]:
    low, high = (100 * row[f"{motion}_success_{end}"] for end in ("low", "high"))
    return (
        f"{row[f'{motion}_reward']:.2f} ± {row[f'{motion}_reward_sd']:.2f}",
        f"{row[f'{motion}_success']:.0%} ({low:.0f} to {high:.0f})",
        f"{row[f'{motion}_collision']:.0%}",
        f"{row[f'{motion}_reach_time_s']:.0f}",
    )
