"""Policies side by side: what a person reads of the table.csv of their roll-outs in simulation and on stand-ins."""

from typing import NamedTuple

import pandas as pd
from rich import box
from rich.table import Table


class PolicyRow(NamedTuple):
    """One policy as a person reads it; reward a vehicle and step."""

    policy: str
    learned_in: str
    simulation_reward: str
    stand_in_reward: str
    difference: str
    simulation_success: str
    stand_in_success: str
    stand_in_collision: str


HEADINGS = (
    "\npolicy",
    "\nlearned in",
    "reward,\nsimulation",
    "reward,\nstand-ins",
    "difference\n%",
    "success,\nsimulation",
    "success,\nstand-ins",
    "collisions,\nstand-ins",
)


def policy_rows(table: pd.DataFrame) -> list[PolicyRow]:
    """Return each policy of table.csv, in its order."""
    return [
        PolicyRow(
            policy=str(row.policy),
            learned_in=str(row.simulation),
            simulation_reward=f"{row.simulation_reward:.2f} ± {row.simulation_reward_sd:.2f}",
            stand_in_reward=f"{row.stand_in_reward:.2f} ± {row.stand_in_reward_sd:.2f}",
            difference=f"{row.reward_difference_percent_value:+.1f}",
            simulation_success=f"{row.simulation_success:.0%}",
            stand_in_success=(
                f"{row.stand_in_success:.0%} ({row.stand_in_success_low:.0%} to {row.stand_in_success_high:.0%})"
            ),
            stand_in_collision=f"{row.stand_in_collision:.0%}",
        )
        for row in table.itertuples()
    ]


def policy_table(title: str, table: pd.DataFrame) -> Table:
    """Return the terminal's table: a row for each policy."""
    shown = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    shown.title = f"{title}: policies from the same starts in simulation and on stand-ins of other vehicles"
    for number, heading in enumerate(HEADINGS):
        shown.add_column(heading, justify="left" if number < 2 else "right", no_wrap=True)
    for row in policy_rows(table):
        shown.add_row(*row)
    shown.caption = (
        "reward a vehicle and step, mean ± standard deviation over roll-outs; success with its 95 % interval"
    )
    return shown
