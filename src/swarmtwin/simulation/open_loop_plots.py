"""Pictures of open loop: measured runs in the arena, and what was predicted of them."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from swarmtwin.plotting import FLOOR, MEASURED, PREDICTED, style
from swarmtwin.robot import Arena
from swarmtwin.simulation.open_loop import OpenLoop


def runs_figure(runs: Sequence[OpenLoop], arena: Arena, most: int = 6) -> Figure:
    """Draw measured runs and their open-loop predictions, from the best to the worst RMSE, each panel a square.

    Of more runs than `most`, those at evenly spaced ranks are shown, so that the picture flatters nobody.
    """
    known = sorted((run for run in runs if np.isfinite(run.rmse_mm)), key=lambda run: run.rmse_mm)
    shown = [known[rank] for rank in np.linspace(0, len(known) - 1, min(most, len(known))).round().astype(int)]
    columns = min(3, max(1, len(shown)))
    rows = max(1, -(-len(shown) // columns))
    with style():
        figure = Figure(figsize=(3 * columns, 3.1 * rows + 0.3), layout="constrained")
        panels = list(figure.subplots(rows, columns, squeeze=False).flat)
        for panel, run in zip(panels, shown, strict=False):
            _draw_run(panel, run, arena)
        for panel in panels[len(shown) :]:
            panel.set_visible(False)
        if shown:
            figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def _draw_run(panel: Axes, run: OpenLoop, arena: Arena) -> None:
    measured, predicted = run.track.pose, run.predicted
    start = predicted[np.isfinite(predicted).all(axis=1)][0]
    walls = Rectangle((arena.x[0], arena.y[0]), np.ptp(arena.x), np.ptp(arena.y), label="arena")
    walls.set(facecolor="none", edgecolor=FLOOR)
    panel.add_patch(walls)
    panel.plot(measured[:, 0], measured[:, 1], color=MEASURED, label="measured")
    panel.plot(predicted[:, 0], predicted[:, 1], color=PREDICTED, label="predicted")
    panel.plot(start[0], start[1], "o", color=MEASURED, markersize=5, label="start")
    both = np.concatenate([measured, predicted])[:, :2]
    low, high = np.nanmin(both, axis=0), np.nanmax(both, axis=0)
    reach = 0.55 * (high - low).max() + 10
    window = np.stack([(low + high) / 2 - reach, (low + high) / 2 + reach])
    panel.set(xlim=window[:, 0], ylim=window[:, 1], box_aspect=1)
    panel.set(title=f"{run.track.run}: RMSE {run.rmse_mm:.0f} mm", xlabel="x, mm", ylabel="y, mm")
