"""Pictures of policies: how they were learned, and how they do in simulation and on vehicles."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from swarmtwin.plotting import FLOOR, MEASURED, PREDICTED, style
from swarmtwin.policies.rollout_comparison import MOTION_NAMES
from swarmtwin.policies.rollout_folder import ROLLOUTS
from swarmtwin.policies.rollout_plots import draw_film
from swarmtwin.world.rollout import Rate, Rollout
from swarmtwin.world.rollout_storage import load_rollouts

COLOURS = {"simulation": PREDICTED, "stand_in": FLOOR}


def draw_learning(made: Path, output: Path) -> None:
    """Draw into `output` how the policy in `made` was learned, from its `history.csv` and `metrics.json`, and film it.

    A folder of a version that kept no roll-out gets no film.

    Raises:
        UserError: its roll-out cannot be read.
    """
    best = json.loads((made / "metrics.json").read_text())["seeds"]
    history_figure(pd.read_csv(made / "history.csv"), best).savefig(output / "history.png")
    if (made / ROLLOUTS).exists():
        draw_film(output / "rollout.mp4", load_rollouts(made / ROLLOUTS), "typical", speed=4.0)


def history_figure(history: pd.DataFrame, best: Mapping[str, Mapping[str, Any] | None]) -> Figure:
    """Draw success, collisions and reward of every seed in the evaluation scenarios; a dot marks the policy kept.

    The dot says how that one did in the final scenarios.

    Args:
        history: history.csv, a row for each evaluation of each seed.
        best: by seed the evaluation of the policy kept; None for none.
    """
    panels = {"success": "success, %", "collision": "collisions, %", "reward": "reward a vehicle and step"}
    with style():
        figure = Figure(figsize=(10, 2.9), layout="constrained")
        for axes, (quantity, label) in zip(figure.subplots(1, 3), panels.items(), strict=True):
            factor = 1 if quantity == "reward" else 100
            for index, (seed, kept) in enumerate(best.items()):
                own, colour, label = history[history.seed == int(seed)], f"C{index}", f"seed {seed}"
                axes.plot(own.step, factor * own[quantity], color=colour, alpha=0.85, linewidth=1.2, label=label)
                if kept:
                    axes.plot(kept["step"], factor * kept[quantity], "o", color=colour, markersize=5)
            axes.set(xlabel="control periods trained", ylabel=label)
        if len(best) > 1:
            figure.axes[0].legend()
    return figure


def rewards_figure(pairs: Mapping[str, tuple[Rollout, Rollout]]) -> Figure:
    """Draw for each policy the reward of every roll-out on vehicles over that in simulation, from the same start."""
    columns = min(3, len(pairs))
    rows = -(-len(pairs) // columns)
    with style():
        figure = Figure(figsize=(3.3 * columns, 3.7 * rows + 0.4), layout="constrained")
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        for panel, (title, (simulation, vehicles)) in zip(panels, pairs.items(), strict=False):
            _draw_pairs(panel, title, simulation, vehicles)
        for panel in panels[len(pairs) :]:
            panel.set_visible(False)
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def success_figure(rates: Mapping[str, Mapping[str, Rate]]) -> Figure:
    """Draw each policy's success in simulation and on stand-ins, as bars that start at 0, with 95 % intervals."""
    with style():
        figure = Figure(figsize=(7, 0.75 * len(rates) + 1.2), layout="constrained")
        panel = figure.subplots()
        for row, by_motion in enumerate(rates.values()):
            for index, (motion, rate) in enumerate(by_motion.items()):
                _draw_rate(panel, row + 0.36 * (index - 0.5), rate, motion, labelled=row == 0)
        panel.set_yticks(range(len(rates)), list(rates))
        panel.invert_yaxis()
        panel.grid(visible=False, axis="y")
        panel.set(xlim=(0, 112), xlabel="success, % of the roll-outs", xticks=range(0, 101, 20))
        figure.legend(*panel.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def _draw_pairs(panel: Axes, title: str, simulation: Rollout, vehicles: Rollout) -> None:
    x, y, succeeded = simulation.mean_reward, vehicles.mean_reward, vehicles.success
    low, high = min(x.min(), y.min()), max(x.max(), y.max())
    edge = 0.05 * max(high - low, 1e-3)
    panel.plot([low, high], [low, high], color=MEASURED, linewidth=0.8)
    for chosen, colour, label in (
        (succeeded, FLOOR, "succeeded on stand-ins"),
        (~succeeded, PREDICTED, "failed there"),
    ):
        panel.scatter(x[chosen], y[chosen], s=14, color=colour, alpha=0.6, linewidths=0, label=label)
    bounds = (low - edge, high + edge)
    panel.set(title=title, xlabel="reward in simulation", ylabel="reward on stand-ins", xlim=bounds, ylim=bounds)
    panel.set(box_aspect=1)


def _draw_rate(panel: Axes, place: float, rate: Rate, motion: str, labelled: bool) -> None:
    value, low, high = (100 * part for part in rate)
    label = MOTION_NAMES[motion] if labelled else None
    panel.barh(place, value, height=0.32, color=COLOURS[motion], alpha=0.8, label=label)
    error = np.array([[max(0.0, value - low)], [max(0.0, high - value)]])
    panel.errorbar(value, place, xerr=error, color=MEASURED, linewidth=1, capsize=2)
    panel.annotate(f"{value:.0f}", (max(high, value) + 1.5, place), va="center", fontsize=8)
