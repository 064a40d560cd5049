"""Pictures of dynamics models: training, one-step scatter, and errors against the floor."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from swarmtwin.dynamics.evaluation import ErrorFigure
from swarmtwin.dynamics.training import SeedResult
from swarmtwin.plotting import FLOOR, MEASURED, PREDICTED, style

COMPONENTS = (("forward", "mm", 1.0), ("left", "mm", 1.0), ("turn", "°", 180 / np.pi))


def history_figure(results: Sequence[SeedResult]) -> Figure:
    """Draw training and validation errors of every seed over the epochs; a dot marks the epoch that was kept."""
    with style():
        figure = Figure(figsize=(8, 3), layout="constrained")
        panels = figure.subplots(1, 2)
        for panel, name, unit in zip(panels, ("position", "orientation"), ("mm", "deg"), strict=True):
            for result in results:
                _draw_history(panel, result, f"{name}_{unit}", labelled=result is results[0])
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


def _draw_history(panel: Axes, result: SeedResult, quantity: str, labelled: bool) -> None:
    epochs = np.arange(1, len(result.history) + 1)
    for part, colour in (("train", FLOOR), ("validation", PREDICTED)):
        errors = [getattr(epoch, f"{part}_{quantity}") for epoch in result.history]
        panel.plot(epochs, errors, color=colour, alpha=0.8, linewidth=1, label=part if labelled else None)
    if result.best:
        kept = getattr(result.history[result.best - 1], f"validation_{quantity}")
        panel.plot(result.best, kept, "o", color=PREDICTED, markersize=4)
