"""The table and the picture of learning with many seeds, from the folder that the study leaves."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from swarmtwin.plotting import style
from swarmtwin.studies.policy_seeds.options import SIMULATION
from swarmtwin.studies.study_table import StudyTable
from swarmtwin.world.rollout import Rate


def reached(table: pd.DataFrame, asked: Mapping[str, float]) -> pd.Series:
    """Return by seed whether its policy succeeds as often as asked, wherever something is asked.

    Args:
        table: table.csv.
        asked: least success, by where.
    """
    success = table.pivot(index="seed", columns="where", values="success").reindex(columns=list(asked))
    least = pd.Series(asked, dtype=float)
    return (success >= least).all(axis=1)


def seeds_table(title: str, table: pd.DataFrame, asked: Mapping[str, float]) -> StudyTable:
    """Return a line for each seed, and below them how many reach what is asked."""
    places = [place for place in table["where"].unique() if isinstance(place, str)]
    does = reached(table, asked)
    rows = []
    for seed, own in table.groupby("seed"):
        first, by_place = own.iloc[0], own.set_index("where")
        cells = [str(seed), "" if pd.isna(first.cpu_s) else f"{first.cpu_s:.0f} s"]
        for place in places:
            if place not in by_place.index:
                cells += ["", "", ""]
                continue
            line = by_place.loc[place]
            ends = f"{100 * line.success_low:.1f} to {100 * line.success_high:.1f}"
            cells += [f"{100 * line.success:.1f} %\n{ends}"]
            cells += [f"{100 * line.collision:.1f} %", f"{100 * line.left_arena:.1f} %"]
        remark = first.failed if isinstance(first.failed, str) else ""
        rows.append([*cells, remark or ("yes" if does[seed] else "no")])
    headings = ["seed", "learning"]
    for place in places:
        headings += [f"{_words(place)}:\nsuccess", "\ncollisions", "\nleft the\narena"]
    return StudyTable(title, (*headings, "as asked"), rows, _caption(table, asked, does))


def _caption(table: pd.DataFrame, asked: Mapping[str, float], does: pd.Series) -> str:
    rate = Rate.of(does.to_numpy())
    least = " and ".join(f"{100 * share:g} % {_at(place)}" for place, share in asked.items())
    counts = table.groupby("where").rollouts.first()
    tried = ", ".join(f"{int(count)} {_at(str(place))}" for place, count in counts.items())
    untimed = ", empty where it was broken off and went on" if table.cpu_s.isna().any() else ""
    return (
        f"{int(does.sum())} of {len(does)} seeds succeed in at least {least}, "
        f"so that another one does in {100 * rate.low:.0f} to {100 * rate.high:.0f} % of cases; new roll-outs of each "
        f"policy, by which nothing was chosen: {tried}; with 95 % intervals; learning: "
        f"processor time, evaluations included{untimed}"
    )


def _at(place: str) -> str:
    return f"{'in' if place == SIMULATION else 'on'} {_words(place)}"


def _words(name: str) -> str:
    return name.replace("_", " ")


def draw_seeds(made: Path, output: Path, asked: Mapping[str, float]) -> None:
    """Draw into `output` how often the policies of `made` succeed."""
    seeds_figure(pd.read_csv(made / "table.csv"), asked).savefig(output / "seeds.png")


def seeds_figure(table: pd.DataFrame, asked: Mapping[str, float]) -> Figure:
    """Draw each seed's success with its 95 % interval, a colour for where, and what is asked as a dashed line."""
    seeds = sorted(table.seed.unique())
    places = sorted(table["where"].dropna().unique(), key=lambda place: place != SIMULATION)
    with style():
        figure = Figure(figsize=(max(4.2, 0.55 * len(seeds) + 1.6), 3.2), layout="constrained")
        panel = figure.subplots()
        for number, place in enumerate(places):
            own = table[table["where"] == place].set_index("seed").reindex(seeds)
            value = 100 * own.success
            reach = np.stack([value - 100 * own.success_low, 100 * own.success_high - value]).clip(0)
            shift = 0.2 * (number - (len(places) - 1) / 2)
            spots, color = np.arange(len(seeds)) + shift, f"C{number}"
            panel.errorbar(spots, value, yerr=reach, fmt="o", color=color, capsize=2, label=_words(place))
            if place in asked:
                panel.axhline(100 * asked[place], color=color, linestyle="--", linewidth=0.8)
        lowest = 100 * min(float(table.success_low.min(skipna=True)), *asked.values(), 0.9)
        panel.set(xlabel="seed", xticks=range(len(seeds)), xticklabels=seeds)
        room = 0.05 * (100 - lowest)  # for markers at the ends
        panel.set(ylabel="success, %", ylim=(lowest - room, 100 + room))
        figure.legend(*panel.get_legend_handles_labels(), loc="outside lower center", ncols=len(places))
    return figure
