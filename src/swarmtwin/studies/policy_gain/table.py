"""The table and the picture of policies in extended simulations, from the folder that the study leaves."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from swarmtwin.plotting import MEASURED, PREDICTED, style
from swarmtwin.studies.study_table import StudyTable

CAPTION = (
    "policies learned in the simulation as it was, that went on for as long again in it, and in the one that the "
    "diagnosis extended, tried on the same robots from the same starts; nothing hidden: the former where the "
    "simulation is right; reward a vehicle and step; "
    "95 % intervals over seeds of learning and starts; * where the interval of a gain leaves out zero"
)


def gain_table(title: str, table: pd.DataFrame, found: Mapping[tuple[str, str], str]) -> StudyTable:
    """Return a line for each thing hidden in each family of stand-ins.

    Args:
        title: above it.
        table: table.csv.
        found: what the diagnosis said, by family and what was hidden.
    """
    rows, marked = [], []
    for number, row in enumerate(table.to_dict("records")):
        family, hidden = row["family"], row["hidden"]
        cells = [f"{family.replace('_', ' ')}: {hidden}", found.get((family, hidden), "")]
        for quantity, form in (("success", ".0%"), ("reward", ".2f")):
            cells += [_figure(row[f"{when}_{quantity}"], form) for when in ("before", "after")]
            gain, low, high = (row[f"{quantity}_gain{end}"] for end in ("", "_low", "_high"))
            ends = f"\n{_figure(low, f'+{form}')} to {_figure(high, f'+{form}')}" if gain == gain else ""
            cells.append(_figure(gain, f"+{form}") + ends)
            if (low > 0 or high < 0) and number not in marked:
                marked.append(number)
        rows.append(cells)
    headings = ("robots", "found", "success\nbefore", "\nafter", "\ngain", "reward\nbefore", "\nafter", "\ngain")
    return StudyTable(title, headings, rows, CAPTION, marked=marked, left=(1,))


def _figure(value: float, form: str) -> str:
    return "" if pd.isna(value) else f"{value:{form}}"


def draw_gains(made: Path, output: Path) -> None:
    """Draw into `output` the successes of `made`: before, after, and where nothing is hidden."""
    gain_figure(pd.read_csv(made / "table.csv")).savefig(output / "gains.png")


def gain_figure(table: pd.DataFrame) -> Figure:
    """Draw success on the robots with its interval, a panel a family: as learned and extended, by what is hidden."""
    families: Sequence[str] = list(table.family.unique())
    with style():
        figure = Figure(figsize=(4.2 * len(families), 3.2), layout="constrained")
        panels = figure.subplots(1, len(families), sharey=True, squeeze=False).ravel()
        for panel, family in zip(panels, families, strict=True):
            own = table[table.family == family].reset_index(drop=True)
            for when, shift, color, label in (
                ("before", -0.1, MEASURED, "learned in the simulation as it was"),
                ("after", 0.1, PREDICTED, "learned in the extended simulation"),
            ):
                value = 100 * own[f"{when}_success"]
                reach = np.stack([value - 100 * own[f"{when}_success_low"], 100 * own[f"{when}_success_high"] - value])
                place = np.arange(len(own)) + shift
                panel.errorbar(place, value, yerr=reach.clip(0), fmt="o", color=color, capsize=2, label=label)
            panel.set(title=family.replace("_", " "), xticks=range(len(own)), xticklabels=own.hidden)
        panels[0].set(ylabel="success on the robots, %", ylim=(-3, 103))
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure
