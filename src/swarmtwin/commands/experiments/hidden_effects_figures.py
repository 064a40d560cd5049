"""The pictures of the study: who is taken for whom, what size is found, how right the parameters are."""

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from swarmtwin.commands.experiments.hidden_effects_counts import (
    fitted_names,
    grouped,
    is_covered,
    of_kind,
    relative_error_percent,
    rule_names,
)
from swarmtwin.commands.experiments.hidden_effects_rates import Share
from swarmtwin.commands.experiments.hidden_effects_results import Parameter, Result
from swarmtwin.commands.experiments.hidden_effects_sizes import CATALOGUE, OUTSIDE
from swarmtwin.plotting import FLOOR, MEASURED, PREDICTED, style

RISES_PERCENT = (0.0, 1.0, 2.0, 3.0, 5.0, 10.0, 20.0, 40.0, 1000.0)
TICKS_PERCENT = (0.3, 1, 3, 10, 30, 100)
NOTHING, NO_NAME = "nothing wrong", "no name"
NamesOf = Callable[[Result], tuple[str, ...]]


def confusion(results: Sequence[Result]) -> tuple[list[str], list[str], np.ndarray]:
    """Return the rows (what was hidden), the columns (what was named first), and how often (rows, columns)."""
    hidden = of_kind(results, "single") + of_kind(results, "outside") + of_kind(results, "clean")
    present = set(map(hidden_name, hidden))
    rows = [name for name in (*CATALOGUE, *OUTSIDE, NOTHING) if name in present]
    columns = [*CATALOGUE, NO_NAME, NOTHING]
    counts = np.zeros((len(rows), len(columns)), int)
    for result in hidden:
        named = result.names[0] if result.names else NO_NAME if result.is_found else NOTHING
        counts[rows.index(hidden_name(result)), columns.index(named)] += 1
    return rows, columns, counts


def hidden_name(result: Result) -> str:
    """Return what was hidden in a session."""
    return NOTHING if result.case.kind == "clean" else result.case.variety


def confusion_figure(results: Sequence[Result]) -> Figure:
    """Draw who is taken for whom; what is right stands on the diagonal and in the last two columns."""
    rows, columns, counts = confusion(results)
    share = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    with style():
        figure = Figure(figsize=(9, 0.24 * len(rows) + 2.6), layout="constrained")
        axes = figure.subplots()
        axes.imshow(share, cmap="Blues", vmin=0, vmax=1, aspect="auto")
        for row, column in np.argwhere(counts):
            colour = "white" if share[row, column] > 0.6 else MEASURED
            axes.text(column, row, str(counts[row, column]), ha="center", va="center", fontsize=7, color=colour)
        axes.set_xticks(range(len(columns)), columns, rotation=60, ha="right")
        axes.set_yticks(range(len(rows)), rows)
        axes.set(xlabel="named first", ylabel="hidden")
        axes.grid(False)
    return figure


def by_rise(results: Sequence[Result], happened: Callable[[Result], bool]) -> list[tuple[float, Share]]:
    """Return how often something happened, by how much the effect raised the error: middle of each bin, and share."""
    rates = []
    for low, high in pairwise(RISES_PERCENT):
        inside = [result for result in results if low <= max(result.rise_percent, 0.0) < high]
        if inside:
            middle = float(np.median([max(result.rise_percent, 0.3) for result in inside]))
            rates.append((middle, Share.of(happened(result) for result in inside)))
    return rates


def detection_figure(results: Sequence[Result]) -> Figure:
    """Draw how often single effects are found and named, by how much they raise the error, beside other methods."""
    single = of_kind(results, "single")
    compared = [result for result in single if result.baselines]
    lines: dict[str, tuple[str, str, list[tuple[float, Share]]]] = {
        "found": (FLOOR, "--", by_rise(single, lambda result: result.is_found)),
        "named first": (PREDICTED, "-", by_rise(single, lambda result: result.is_named_first)),
    }
    if compared:
        lines["named first: parameter fitting"] = (MEASURED, "-", by_rise(compared, _first(fitted_names)))
        lines["named first: correlation rules"] = ("#8d99ae", "-", by_rise(compared, _first(rule_names)))
    with style():
        figure = Figure(figsize=(6.5, 4), layout="constrained")
        axes = figure.subplots()
        for label, (colour, line, rates) in lines.items():
            _draw_rates(axes, rates, colour, line, label)
        axes.set(xscale="log", ylim=(-0.02, 1.02), ylabel="share of sessions, 95 % interval")
        axes.set_xticks(TICKS_PERCENT, [f"{tick:g}" for tick in TICKS_PERCENT])
        axes.minorticks_off()
        axes.set_xlabel("one-step error raised by the effect, %")
        axes.set_title(f"{len(single)} sessions with one effect of the catalogue")
        figure.legend(loc="outside lower center", ncols=2)
    return figure


def _first(names_of: NamesOf) -> Callable[[Result], bool]:
    return lambda result: names_of(result)[:1] == result.case.true_names


def _draw_rates(axes: Axes, rates: list[tuple[float, Share]], colour: str, line: str, label: str) -> None:
    at = [middle for middle, _ in rates]
    value = np.array([share.share or 0.0 for _, share in rates])
    below = np.clip(value - [share.low for _, share in rates], 0.0, None)
    above = np.clip([share.high for _, share in rates] - value, 0.0, None)
    axes.errorbar(
        at, value, yerr=[below, above], color=colour, linestyle=line, marker="o", markersize=4, capsize=2, label=label
    )


def parameters_figure(results: Sequence[Result]) -> Figure:
    """Draw each parameter's relative errors, a dot a session; those outside their interval in red."""
    found = [parameter for result in of_kind(results, "single") for parameter in result.parameters]
    sized = [parameter for parameter in found if relative_error_percent(parameter) is not None]
    groups: Mapping[str, list[Parameter]] = grouped(sized, lambda parameter: f"{parameter.cause}: {parameter.name}")
    names = sorted(groups)
    with style():
        figure = Figure(figsize=(7, 0.24 * len(names) + 1.6), layout="constrained")
        axes = figure.subplots()
        for row, name in enumerate(names):
            errors = np.array([relative_error_percent(parameter) for parameter in groups[name]], float).clip(0.02)
            inside = np.array([is_covered(parameter) for parameter in groups[name]])
            for chosen, colour in ((inside, FLOOR), (~inside, PREDICTED)):
                axes.plot(errors[chosen], np.full(chosen.sum(), row), "o", markersize=3, alpha=0.6, color=colour)
            axes.plot(np.median(errors), row, "|", markersize=12, color=MEASURED)
        axes.axvline(3.0, color=MEASURED, linewidth=0.8, linestyle=":")
        axes.set(xscale="log", xlabel="error, % of the true value (bar: median; red: outside its interval)")
        axes.set_yticks(range(len(names)), names)
    return figure


def clean_figure(results: Sequence[Result]) -> Figure:
    """Draw how often a cause was named where nothing is wrong, by kind of session, with upper bounds."""
    groups = grouped(of_kind(results, "clean"), lambda result: result.case.variety)
    names = [*groups, "all"]
    every = {**groups, "all": of_kind(results, "clean")}
    with style():
        figure = Figure(figsize=(6, 0.3 * len(names) + 1.2), layout="constrained")
        axes = figure.subplots()
        bounds = []
        for row, name in enumerate(names):
            share = Share.of(bool(result.causes) for result in every[name])
            bounds.append(share.at_most)
            axes.plot([share.share or 0.0, share.at_most], [row, row], color=FLOOR)
            axes.plot(share.share or 0.0, row, "o", color=PREDICTED if share.count else FLOOR)
            axes.annotate(f" {share.count} of {share.total}", (share.at_most, row), va="center", fontsize=8)
        axes.axvline(0.01, color=MEASURED, linewidth=0.8, linestyle=":")
        axes.set(
            xlabel="share of clean sessions in which a cause is named; line: upper 95 % bound", xlim=(-0.005, None)
        )
        axes.set_yticks(range(len(names)), names)
        axes.invert_yaxis()
    return figure
