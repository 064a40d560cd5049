"""Tables 5 and 6 as a person reads them: rewards in simulation and on stand-ins, and the paper's own beside them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
from rich import box
from rich.table import Table

from swarmtwin.studies.reality_gap.gap_rollouts import LEARNED, RANDOM, SCRIPTED
from swarmtwin.studies.reality_gap.options import PublishedRow

HEADINGS = (
    *("policy", "simulation", "simulator: reward", "success"),
    *("real world", "reward", "success", "reality gap"),
)


class Line(NamedTuple):
    """A line of the table: a policy of one simulation on one group of stand-ins, or what the paper states of it."""

    policy: str
    simulation: str
    simulated_reward: str
    simulated_success: str
    where: str
    reward: str
    success: str
    gap: str


def gap_lines(
    table: pd.DataFrame, failed: Mapping[str, str | None], published: Mapping[str, PublishedRow]
) -> list[Line]:
    """Return all lines: learned policies with the paper's beneath them, then the baselines.

    Args:
        table: table.csv.
        failed: why there is no policy, by simulation; None where there is one. In the order of the table.
        published: what the paper states, by simulation.
    """
    lines = []
    for simulation, reason in failed.items():
        lines += _policy_lines(table, LEARNED, simulation)
        if reason:
            lines.append(Line(LEARNED, simulation, "no policy", "", "", "", "", reason))
        if simulation in published:
            lines.append(_published_line(simulation, published[simulation]))
    for baseline in (SCRIPTED, RANDOM):
        for simulation in failed:
            lines += _policy_lines(table, baseline, simulation)
    return lines


def _policy_lines(table: pd.DataFrame, policy: str, simulation: str) -> list[Line]:
    rows = table[(table.policy == policy) & (table.simulation == simulation)].to_dict("records")
    if not rows:
        return []
    simulated, *real = rows
    return [
        Line(
            policy,
            simulation,
            _spread(simulated["reward"], simulated["reward_sd"]),
            _rate(simulated),
            str(row["where"]),
            _spread(row["reward"], row["reward_sd"]),
            _rate(row),
            f"{row['gap']:+.3f} ({row['gap_low']:+.3f} to {row['gap_high']:+.3f})",
        )
        for row in real
    ]


def _published_line(simulation: str, row: PublishedRow) -> Line:
    success = "" if row.success is None else f"{row.success:.0%}"
    gap = f"{row.real_world[0] - row.simulator[0]:+.2f}"
    return Line(
        "the paper's", simulation, _spread(*row.simulator), "", "robots", _spread(*row.real_world), success, gap
    )


def _spread(mean: float, deviation: float) -> str:
    return f"{mean:.2f} ± {deviation:.2f}"


def _rate(row: dict[Any, Any]) -> str:
    return f"{row['success']:.0%} ({100 * row['success_low']:.0f} to {100 * row['success_high']:.0f})"


def gap_table(title: str, lines: Sequence[Line], rollouts: int) -> Table:
    """Return the terminal's table: of each policy a line for its simulation, and under it one a group of stand-ins."""
    shown = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, show_edge=False, title=title)
    shown.add_column("policy, where", no_wrap=True)
    for heading in ("reward", "success", "reality gap"):
        shown.add_column(heading, justify="right", no_wrap=True)
    above: tuple[str, ...] = ()
    for line in lines:
        if line[:2] != above:
            shown.add_row(" ".join(line[:2]), line.simulated_reward, line.simulated_success)
            above = line[:2]
        if line.where:
            shown.add_row(f"  {line.where}", line.reward, line.success, line.gap)
    failed = [f"no policy in {line.simulation}: {line.gap}" for line in lines if not line.where]
    shown.caption = "\n".join([*failed, caption(rollouts)])
    return shown


def gap_markdown(title: str, lines: Sequence[Line], rollouts: int, pictures: Sequence[str]) -> str:
    """Return report.md; `pictures` are names of files beside it."""
    rows = [HEADINGS, ("---",) * len(HEADINGS), *lines]
    table = "\n".join(f"| {' | '.join(row)} |" for row in rows)
    shown = "".join(f"\n![{Path(name).stem.replace('_', ' ')}]({name})\n" for name in pictures)
    heading = title[:1].upper() + title[1:]
    return f"# {heading}\n\n{table}\n\n{caption(rollouts)}\n{shown}"


def caption(rollouts: int) -> str:
    """Say what the figures are."""
    return (
        f"{rollouts} roll-outs from the same starts, in the simulation and on stand-ins; reward a vehicle and step, "
        "mean ± standard deviation over roll-outs; reality gap: the reward on stand-ins less that in the simulation; "
        "it and success with 95 % intervals; the paper's: ten roll-outs on its robots, without intervals; "
        "scripted and random: one and the same policy in every simulation"
    )
