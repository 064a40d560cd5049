"""Pictures of dynamics models: training, one-step scatter, and errors against the floor."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from swarmtwin.dynamics.evaluation import ErrorFigure
from swarmtwin.dynamics.provenance import Provenance
from swarmtwin.plotting import FLOOR, MEASURED, PREDICTED, style

COMPONENTS = (("forward", "mm", 1.0), ("left", "mm", 1.0), ("turn", "°", 180 / np.pi))


def draw_training(made: Path, output: Path) -> None:
    """Draw into `output` how the model in `made` learned, from its `history.csv`.

    Raises:
        UserError: there is no model in `made`.
    """
    best_epochs = {outcome.seed: outcome.best_epoch for outcome in Provenance.read(made).seeds}
    history_figure(pd.read_csv(made / "history.csv"), best_epochs).savefig(output / "history.png")


def history_figure(history: pd.DataFrame, best_epochs: Mapping[int, int]) -> Figure:
    """Draw training and validation errors of every seed over the epochs; a dot marks the epoch that was kept.

    Args:
        history: history.csv, a row for each epoch of each seed.
        best_epochs: the epoch kept of each seed, counted from 1; 0 for none.
    """
    with style():
        figure = Figure(figsize=(8, 3), layout="constrained")
        panels = figure.subplots(1, 2)
        for panel, name, unit in zip(panels, ("position", "orientation"), ("mm", "deg"), strict=True):
            for number, (seed, best_epoch) in enumerate(best_epochs.items()):
                epochs = history[history.seed == seed]
                _draw_history(panel, epochs, best_epoch, f"{name}_{unit}", labelled=number == 0)
            panel.set(xlabel="epoch", ylabel=f"{name} error, {'°' if unit == 'deg' else unit}", yscale="log")
            panel.yaxis.set_major_formatter("{x:g}")
            panel.yaxis.set_minor_formatter("{x:g}")
        panels[0].legend()
    return figure


def scatter_figure(predicted: np.ndarray, measured: np.ndarray, most: int = 5000) -> Figure:
    """Draw predicted against measured displacements (N, 3), one panel a component; of many, `most` evenly spaced."""
    chosen = np.linspace(0, len(measured) - 1, min(most, len(measured))).astype(int)
    with style():
        figure = Figure(figsize=(9, 3.3), layout="constrained")
        for column, (panel, (name, unit, factor)) in enumerate(zip(figure.subplots(1, 3), COMPONENTS, strict=True)):
            x, y = factor * measured[chosen, column], factor * predicted[chosen, column]
            low, high = min(x.min(), y.min()), max(x.max(), y.max())
            panel.plot([low, high], [low, high], color=MEASURED, linewidth=0.8)
            panel.scatter(x, y, s=3, color=PREDICTED, alpha=0.25, linewidths=0, rasterized=True)
            panel.set(title=f"{name}, {unit}", xlabel="measured", ylabel="predicted", box_aspect=1)
    return figure


def comparison_figure(errors: Mapping[str, ErrorFigure], floor: ErrorFigure, floor_is_estimate: bool) -> Figure:
    """Draw the one-step errors of several models, each as a bar that starts at 0, with the floor as a line."""
    names = list(errors)
    with style():
        figure = Figure(figsize=(8, 0.32 * len(names) + 1.2), layout="constrained")
        panels = figure.subplots(1, 2, sharey=True)
        for panel, (quantity, unit) in zip(panels, (("position", "mm"), ("orientation", "deg")), strict=True):
            values = [getattr(errors[name], f"{quantity}_{unit}") for name in names]
            lowest = getattr(floor, f"{quantity}_{unit}")
            panel.barh(names, values, color=PREDICTED, alpha=0.75, height=0.65)
            panel.axvline(lowest, color=FLOOR, label="floor (estimate)" if floor_is_estimate else "floor")
            for row, value in enumerate(values):
                panel.annotate(f" {value:.2f}, ×{value / lowest:.3f}", (value, row), va="center", fontsize=8)
            panel.set(
                xlabel=f"{quantity} error, {'°' if unit == 'deg' else unit}", xlim=(0, 1.35 * max(*values, lowest))
            )
            panel.grid(visible=False, axis="y")
        panels[0].invert_yaxis()
        figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center")
    return figure


def _draw_history(panel: Axes, epochs: pd.DataFrame, best_epoch: int, quantity: str, labelled: bool) -> None:
    for part, colour in (("train", FLOOR), ("validation", PREDICTED)):
        label = part if labelled else None
        panel.plot(epochs.epoch, epochs[f"{part}_{quantity}"], color=colour, alpha=0.8, linewidth=1, label=label)
    if best_epoch:
        kept = epochs.loc[epochs.epoch == best_epoch, f"validation_{quantity}"]
        panel.plot(best_epoch, kept.item(), "o", color=PREDICTED, markersize=4)
