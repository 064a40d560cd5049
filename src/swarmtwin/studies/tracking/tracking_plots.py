"""The pictures of the tracking study, from the folder that it leaves."""

from pathlib import Path

import cv2
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from swarmtwin.files import read_provenance
from swarmtwin.plotting import FLOOR, MEASURED, PREDICTED, style

COLOURS = {
    "tracker": PREDICTED,
    "measured_height": "#8a2846",
    "measured_place": "#d9705a",
    "measured_lens": "#c98bb9",
    "perfect": MEASURED,
    "subpixel": FLOOR,
    "contour": "#7fb7be",
    "homography": "#b0b0b0",
}


def draw_tracking(made: Path, output: Path) -> None:
    """Draw into `output` the errors of `made` by case and method, and what the cases look like."""
    table = pd.read_csv(made / "table.csv")
    _, options = read_provenance(made)
    goals = {"p99_mm": float(options["goal_mm"]), "p99_deg": float(options["goal_deg"])}
    errors_figure(table, goals).savefig(output / "errors.png", bbox_inches="tight")
    titles = dict(zip(table.case, table.case_title, strict=True))
    samples = {
        title: np.asarray(cv2.imread(str(made / "samples" / f"{name}.png"), cv2.IMREAD_GRAYSCALE))
        for name, title in titles.items()
    }
    samples_figure(samples).savefig(output / "samples.png", bbox_inches="tight")


def errors_figure(table: pd.DataFrame, goals: dict[str, float]) -> Figure:
    """Return position and heading errors: a dot for the 99th percentile, a line from the median; dashed: the goal."""
    cases = list(dict.fromkeys(table.case_title))
    methods = dict(zip(table.method, table.method_title, strict=True))
    with style():
        figure, axes = plt.subplots(1, 2, figsize=(9, 0.55 * len(cases) + 1.6), sharey=True)
        for axis, unit, label in zip(axes, ("mm", "deg"), ("position error, mm", "heading error, °"), strict=True):
            for index, method in enumerate(methods):
                rows = table[table.method == method].set_index("case_title").reindex(cases)
                height = np.arange(len(cases)) + 0.12 * (index - (len(methods) - 1) / 2)
                axis.hlines(height, rows[f"p50_{unit}"], rows[f"p99_{unit}"], color=COLOURS[method], lw=1.2)
                axis.plot(rows[f"p99_{unit}"], height, "o", ms=3.5, color=COLOURS[method], label=methods[method])
            axis.axvline(goals[f"p99_{unit}"], color="#888888", ls="--", lw=1)
            axis.set(xscale="log", xlabel=f"{label}: median to 99th percentile")
        axes[0].set_yticks(range(len(cases)), cases)
        axes[0].invert_yaxis()
        figure.legend(*axes[0].get_legend_handles_labels(), loc="lower center", ncols=2, bbox_to_anchor=(0.5, 1.0))
        figure.tight_layout()
        plt.close(figure)
    return figure


def samples_figure(samples: dict[str, np.ndarray], columns: int = 4) -> Figure:
    """Return one picture of each case, by its title."""
    rows = -(-len(samples) // columns)
    with style():
        figure, axes = plt.subplots(rows, columns, figsize=(2.3 * columns, 2.5 * rows), squeeze=False)
        for axis in axes.flat:
            axis.set_axis_off()
        for axis, (title, sample) in zip(axes.flat, samples.items(), strict=False):
            axis.imshow(sample, cmap="gray", vmin=0, vmax=255)
            axis.set_title(title)
        figure.tight_layout()
        plt.close(figure)
    return figure
