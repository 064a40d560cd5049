"""The pictures of the study: which cause is taken for which, what size is found, how right the parameters are."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from swarmtwin.plotting import FLOOR, MEASURED, PREDICTED, style
from swarmtwin.studies.hidden_effects.effect_sizes import CATALOGUE
from swarmtwin.studies.hidden_effects.hideable_effects import SIZES
from swarmtwin.studies.hidden_effects.proportions import Proportion


def confusion(results: pd.DataFrame) -> pd.DataFrame:
    """Count what was hidden in sessions with at most one effect (rows) against what was named first (columns).

    After the catalogue's causes come those that the diagnosis knows beside them, such as a user's own, then no name,
    nothing wrong, and diagnoses that failed.
    """
    one = results[results.kind.isin(["one", "misspecified", "outside", "clean"])]
    hidden = one.about.where(one.kind != "clean", "nothing wrong")
    silent = one.verdict.map({"unexplained": "no name", "explained": "no name", "no_gap": "nothing wrong"})
    silent = silent.mask(~one.found.astype(bool) & silent.notna(), "nothing wrong")
    first = one.named.str.split("+").str[0]
    named = first.where(first != "", silent.fillna("failed"))
    others = sorted(set(first) - {"", *CATALOGUE})
    failed = ["failed"] if (named == "failed").any() else []
    effects = [name for own in SIZES.values() for name in own]
    rows = [name for name in (*effects, "nothing wrong") if name in set(hidden)]
    columns = [*CATALOGUE, *others, "no name", "nothing wrong", *failed]
    return pd.crosstab(hidden, named).reindex(index=rows, columns=columns, fill_value=0)


def confusion_figure(results: pd.DataFrame) -> Figure:
    """Draw which cause is taken for which; what is right stands on the diagonal and in the last columns."""
    counts = confusion(results)
    share = counts.to_numpy() / counts.sum(axis=1).to_numpy()[:, None]
    with style():
        figure = Figure(figsize=(9, 0.24 * len(counts) + 2.6), layout="constrained")
        axes = figure.subplots()
        axes.imshow(share, cmap="Blues", vmin=0, vmax=1, aspect="auto")
        for row, column in np.argwhere(share):
            colour = "white" if share[row, column] > 0.6 else MEASURED
            text = str(counts.iloc[row, column])
            axes.text(column, row, text, ha="center", va="center", fontsize=7, color=colour)
        axes.set_xticks(range(len(counts.columns)), list(counts.columns), rotation=60, ha="right")
        axes.set_yticks(range(len(counts)), list(counts.index))
        groups = np.cumsum([sum(name in own for name in counts.index) for own in SIZES.values()])
        for below in set(groups.tolist()) - {0, len(counts)}:
            axes.axhline(below - 0.5, color=MEASURED, linewidth=0.8)
        axes.axvline(list(counts.columns).index("no name") - 0.5, color=MEASURED, linewidth=0.8)
        axes.set(xlabel="named first", ylabel="hidden: effects of the catalogue, by other laws, of none, nothing")
        axes.grid(False)
    return figure


RISE_PERCENT_EDGES = (0.0, 1.0, 3.0, 10.0, 30.0, np.inf)
TIMES_LIMIT_EDGES = (0.0, 0.5, 1.0, 2.0, 4.0, np.inf)


def share_by_size(
    results: pd.DataFrame, happened: str, size: str, edges: Sequence[float]
) -> list[tuple[float, Proportion]]:
    """Return how often a column is true by the size of the effect: the median size of each bin, and the share."""
    sizes = results[size].astype(float)
    inside = [sizes.clip(lower=0.0).between(low, high, inclusive="left") for low, high in pairwise(edges)]
    return [(float(sizes[one].median()), Proportion.of(results[happened][one])) for one in inside if one.any()]


def detection_figure(results: pd.DataFrame) -> Figure:
    """Draw how often single effects are found and named, beside other methods, by their size.

    The upper row has by how much they raise the error, the lower one their size over the detection limit of their
    session, above which nine of ten are to be named. Each column is a family of stand-ins.
    """
    single = results[results.kind == "one"]
    families = list(single.family.unique())
    sizes = {
        "rise_percent": ("one-step error raised by the effect, %", RISE_PERCENT_EDGES, (0.3, 1, 3, 10, 30, 100)),
        "times_limit": ("size of the effect over its detection limit", TIMES_LIMIT_EDGES, (0.1, 0.3, 1, 3, 10, 30)),
    }
    with style():
        figure = Figure(figsize=(3.6 * max(len(families), 1) + 0.4, 6), layout="constrained")
        panels = figure.subplots(len(sizes), max(len(families), 1), sharey=True, squeeze=False)
        for axes_row, (size, (meaning, edges, ticks)) in zip(panels, sizes.items(), strict=True):
            for axes, family in zip(axes_row, families, strict=False):
                own = single[single.family == family]
                _draw_shares(axes, own[own[size].notna()], size, edges, ticks[0])
                axes.set(xscale="log", ylim=(-0.02, 1.02), xlabel=meaning, xlim=(ticks[0] / 1.3, 1.3 * ticks[-1]))
                axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
                axes.minorticks_off()
                counted = int(own[size].notna().sum())
                axes.set_title(f"{family}: {counted} sessions with one effect")
            axes_row[0].set_ylabel("share of sessions, 95 % interval")
        for axes in panels[1]:
            axes.axvline(1.0, color=MEASURED, linewidth=0.8, linestyle=":")
        handles, labels = panels[0][0].get_legend_handles_labels()
        if handles:
            figure.legend(handles, labels, loc="outside lower center", ncols=2)
    return figure


def _draw_shares(axes: Axes, single: pd.DataFrame, size: str, edges: Sequence[float], least: float) -> None:
    """Draw which share of sessions with one effect each method names, a little beside each other, from `least` on.

    Methods that judged less than half of them are left out: curves of a few sessions say nothing.
    """
    compared = single[single.with_baselines]
    lines = [("alarm", FLOOR, single, "found"), ("named, and nothing beside it", PREDICTED, single, "exact")]
    if 2 * len(compared) >= len(single):
        lines += [
            ("parameter fitting: named first", MEASURED, compared, "fitting_first"),
            ("rules on correlations: named first", "#8d99ae", compared, "rule_first"),
        ]
    for place, (label, colour, sessions, happened) in enumerate(lines):
        rates = share_by_size(sessions, happened, size, edges)
        if rates:
            value, low, high = np.array([(rate.share, rate.low, rate.high) for _, rate in rates], float).T
            around = np.clip([value - low, high - value], 0.0, None)
            at = [max(middle, least) * 1.05**place for middle, _ in rates]  # the axis is logarithmic
            axes.errorbar(at, value, around, fmt="o-", color=colour, label=label, markersize=4, capsize=2)


def parameters_figure(parameters: pd.DataFrame) -> Figure:
    """Draw errors, in percent of what they change, of parameters told as they are hidden; red: outside the interval."""
    sized = parameters[parameters.error_percent.notna() & parameters.same_unit]
    groups = list(sized.groupby(sized.cause + ": " + sized.name))
    with style():
        figure = Figure(figsize=(7, 0.24 * len(groups) + 1.6), layout="constrained")
        axes = figure.subplots()
        for row, (_, group) in enumerate(groups):
            errors, inside = group.error_percent.clip(lower=0.02), group.covered.astype(bool)
            for chosen, colour in ((inside, FLOOR), (~inside, PREDICTED)):
                axes.plot(errors[chosen], np.full(chosen.sum(), row), "o", markersize=3, alpha=0.6, color=colour)
            axes.plot(errors.median(), row, "|", markersize=12, color=MEASURED)
        axes.axvline(2.0, color=MEASURED, linewidth=0.8, linestyle=":")
        axes.set(
            xscale="log", xlabel="error, % of what the parameter changes\n(bar: median; red: outside its interval)"
        )
        axes.set_yticks(range(len(groups)), [str(name) for name, _ in groups])
    return figure


def clean_figure(results: pd.DataFrame) -> Figure:
    """Draw how often a cause was named where nothing is wrong, by kind of session, with upper bounds."""
    clean = results[results.kind == "clean"]
    groups = [*clean.groupby("about", sort=False), ("all", clean)]
    with style():
        figure = Figure(figsize=(6, 0.3 * len(groups) + 1.2), layout="constrained")
        axes = figure.subplots()
        for row, (_, group) in enumerate(groups):
            share = Proportion.of(group.named != "")
            axes.plot([share.share or 0.0, share.at_most], [row, row], color=FLOOR)
            axes.plot(share.share or 0.0, row, "o", color=PREDICTED if share.count else FLOOR)
            axes.annotate(f" {share.count} of {share.total}", (share.at_most, row), va="center", fontsize=8)
        axes.axvline(0.003, color=MEASURED, linewidth=0.8, linestyle=":")
        axes.set(
            xlabel="share of clean sessions in which a cause is named; line: upper 95 % bound", xlim=(-0.005, None)
        )
        axes.set_yticks(range(len(groups)), [str(name) for name, _ in groups])
        axes.invert_yaxis()
    return figure


def calibration_figure(confidences: pd.DataFrame, bins: int = 10) -> Figure:
    """Draw how often causes named with a confidence are there, in the bins of `expected_calibration_error`."""
    with style():
        figure = Figure(figsize=(4.5, 4), layout="constrained")
        axes = figure.subplots()
        axes.plot([0, 1], [0, 1], color=MEASURED, linewidth=0.8, linestyle=":")
        colours = (PREDICTED, FLOOR, MEASURED)
        for (family, own), colour in zip(confidences.groupby("family", sort=False), colours, strict=False):
            for _, part in own.groupby(np.minimum((own.confidence * bins).astype(int), bins - 1)):
                share = Proportion.of(part.true)
                said = float(part.confidence.mean())
                axes.plot([said, said], [share.low, share.high], color=colour, linewidth=0.8)
                axes.plot(said, share.share or 0.0, "o", color=colour, markersize=4)
            axes.plot([], [], "o", color=colour, label=str(family))
        axes.set(xlabel="confidence that a cause is named with", ylabel="share of them that is there, 95 % interval")
        if axes.get_legend_handles_labels()[0]:
            axes.legend(loc="upper left")
    return figure
