"""Pictures of synthetic transitions beside real ones that the generator has never seen, and of its training."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from swarmtwin.files import read_provenance
from swarmtwin.generators.quality import Quality
from swarmtwin.plotting import FLOOR, MEASURED, PREDICTED, style

COLOURS = {"held out": MEASURED, "learned from": FLOOR, "synthetic": PREDICTED}


def draw_synthesis(made: Path, output: Path) -> None:
    """Draw into `output` what `swarmtwin generate` left in `made`; nothing where it only drew from a given generator.

    Raises:
        UserError: `made` is not a folder of swarmtwin's, or `quality.json` is of another version.
    """
    if not (made / "quality.json").exists():
        return
    _, options = read_provenance(made)
    quality = Quality.parse(json.loads((made / "quality.json").read_text()), str(made / "quality.json"))
    title = f"{options['robot']['title']}: synthetic transitions by {options['generator']['name']}"
    quality_figure(pd.read_csv(made / "marginals.csv"), quality, title).savefig(output / "quality.png")
    training_figure(pd.read_csv(made / "history.csv")).savefig(output / "history.png")


def quality_figure(marginals: pd.DataFrame, quality: Quality, title: str) -> Figure:
    """Draw each column's distribution, as `quality.marginals` gives it, the noise's spread, coverage, and copies."""
    units = dict(zip(marginals.column, marginals.unit, strict=True))
    panels_needed = len(units) + 3
    across = 4
    rows = -(-panels_needed // across)
    with style():
        figure = Figure(figsize=(2.9 * across, 2.4 * rows + 0.6), layout="constrained")
        panels = list(figure.subplots(rows, across, squeeze=False).flat)
        for panel, (name, unit) in zip(panels, units.items(), strict=False):
            gap = quality.synthetic.largest_marginal_gap[name]
            _draw_marginal(panel, marginals[marginals.column == name])
            panel.set(title=f"{name}, {unit}   (gap {gap:.3f})", yticks=[])
            panel.xaxis.set_major_locator(MaxNLocator(5))
        _draw_spread(panels[len(units)], quality)
        _draw_shares(panels[len(units) + 1], quality)
        _draw_verdicts(panels[len(units) + 2], quality)
        for panel in panels[panels_needed:]:
            panel.set_visible(False)
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
        figure.suptitle(title, fontsize=10)
    return figure


def training_figure(history: pd.DataFrame) -> Figure:
    """Draw each loss and validation figure of a history.csv over the steps."""
    names = [name for name in map(str, history) if name != "step"]
    with style():
        figure = Figure(figsize=(2.6 * len(names), 2.6), layout="constrained")
        for panel, name in zip(figure.subplots(1, len(names), squeeze=False).flat, names, strict=True):
            known = history[history[name].notna()]
            panel.plot(known.step, known[name], color=PREDICTED if "validation" in name else FLOOR)
            panel.set(title=name.replace("_", " "), xlabel="step")
    return figure


def _draw_marginal(panel: Axes, bins: pd.DataFrame) -> None:
    edges = [*bins.low, bins.high.iloc[-1]]
    for label, colour in COLOURS.items():
        density = bins[label.replace(" ", "_")]
        if label == "held out":
            panel.stairs(density, edges, fill=True, color=colour, alpha=0.2, label=label)
        else:
            panel.stairs(density, edges, color=colour, linewidth=1.3, label=label)
    panel.set_ylim(0, None)


def _draw_spread(panel: Axes, quality: Quality) -> None:
    """Draw the noise given the situation, as a multiple of that of held-out rows: below 1 it has collapsed."""
    known = quality.held_out_spread
    names = [name.rpartition("_")[0] for name in known]
    for offset, (label, spread) in zip(
        (-0.2, 0.2), (("learned from", quality.real.spread), ("synthetic", quality.synthetic.spread)), strict=True
    ):
        ratios = [spread[name] / known[name] for name in known]
        positions = np.arange(len(names)) + offset
        panel.bar(positions, ratios, 0.36, color=COLOURS[label], alpha=0.8)
        for position, ratio in zip(positions, ratios, strict=True):
            panel.annotate(f"{ratio:.2f}", (position, ratio), ha="center", va="bottom", fontsize=7)
    panel.axhline(1, color=MEASURED, linewidth=0.8)
    panel.set(title="noise given the situation, × held out", xticks=range(len(names)), xticklabels=names, ylim=(0, 1.4))
    panel.grid(visible=False, axis="x")


def _draw_shares(panel: Axes, quality: Quality) -> None:
    names = ("precision", "recall")
    for offset, label, part in ((-0.2, "learned from", quality.real), (0.2, "synthetic", quality.synthetic)):
        shares = [getattr(part, name) for name in names]
        panel.bar(np.arange(2) + offset, shares, 0.36, color=COLOURS[label], alpha=0.8)
        for position, share in enumerate(shares):
            panel.annotate(f"{share:.2f}", (position + offset, share), ha="center", va="bottom", fontsize=7)
    panel.set(title="coverage", xticks=range(2), xticklabels=["few invented", "few missed"], ylim=(0, 1.15))
    panel.grid(visible=False, axis="x")


def _draw_verdicts(panel: Axes, quality: Quality) -> None:
    """Draw what should be a half: told apart by a classifier, and nearer to rows learned from (copying)."""
    entries = [
        ("told apart:\nlearned from", quality.real.told_apart.value, "learned from"),
        ("told apart:\nsynthetic", quality.synthetic.told_apart.value, "synthetic"),
        ("nearer to\nlearned from", quality.nearer_to_learned, "synthetic"),
    ]
    for position, (_, value, label) in enumerate(entries):
        panel.bar(position, value, 0.5, color=COLOURS[label], alpha=0.8)
        panel.annotate(f"{value:.2f}", (position, value), ha="center", va="bottom", fontsize=7)
    panel.axhline(0.5, color=MEASURED, linewidth=0.8)
    panel.set(title=f"ideal ½; exact copies: {quality.exact_copies}", xticks=range(3), ylim=(0, 1.1))
    panel.set_xticklabels([name for name, *_ in entries], fontsize=7)
    panel.grid(visible=False, axis="x")
