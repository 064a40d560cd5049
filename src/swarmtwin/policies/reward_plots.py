"""Pictures of policies: how they were learned, and how they do in simulation and on vehicles."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from swarmtwin.plotting import FLOOR, MEASURED, PREDICTED, style
from swarmtwin.policies.training import SeedResult
from swarmtwin.world.rollout import Rate, Rollout

COLOURS = {"simulation": PREDICTED, "stand_in": FLOOR}
NAMES = {"simulation": "simulation", "stand_in": "stand-ins"}


def history_figure(results: Sequence[SeedResult]) -> Figure:
    """Draw success, collisions and reward of every seed in the evaluation scenarios; a dot marks the policy kept."""
    panels = {"success": "success, %", "collision": "collisions, %", "reward": "reward a vehicle and step"}
    with style():
        figure = Figure(figsize=(10, 2.9), layout="constrained")
        for axes, (quantity, label) in zip(figure.subplots(1, 3), panels.items(), strict=True):
            factor = 1 if quantity == "reward" else 100
            for index, result in enumerate(results):
                _draw_history(axes, result, quantity, factor, f"C{index}")
            axes.set(xlabel="control periods trained", ylabel=label)
        if len(results) > 1:
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


def _draw_history(axes: Axes, result: SeedResult, quantity: str, factor: int, colour: str) -> None:
    steps = [evaluation.step for evaluation in result.history]
    values = [factor * getattr(evaluation, quantity) for evaluation in result.history]
    axes.plot(steps, values, color=colour, alpha=0.85, linewidth=1.2, label=f"seed {result.seed}")
    if result.best:
        axes.plot(result.best.step, factor * getattr(result.best, quantity), "o", color=colour, markersize=5)


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
    label = NAMES[motion] if labelled else None
    panel.barh(place, value, height=0.32, color=COLOURS[motion], alpha=0.8, label=label)
    error = np.array([[max(0.0, value - low)], [max(0.0, high - value)]])
    panel.errorbar(value, place, xerr=error, color=MEASURED, linewidth=1, capsize=2)
    panel.annotate(f"{value:.0f}", (max(high, value) + 1.5, place), va="center", fontsize=8)
