"""Pictures of a diagnosis: where the residual is, its spread, and held-out runs, before and after the extension."""

import textwrap
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from swarmtwin.diagnosis.report.residual_fields import Axis, Field, FieldChoice, binned
from swarmtwin.diagnosis.report.sentences import COMPONENTS
from swarmtwin.plotting import FLOOR, MEASURED, PREDICTED, style
from swarmtwin.robot import Arena
from swarmtwin.simulation.open_loop import OpenLoop

BEFORE, AFTER = "the simulation", "extended"
COLOURS = {BEFORE: PREDICTED, AFTER: FLOOR}
TOO_FEW = "#e3e6ea"
LESS_AND_MORE = LinearSegmentedColormap.from_list("less_and_more", [FLOOR, "#ffffff", PREDICTED])
WIDTH_INCHES = 6.8
BINS = np.linspace(-5, 5, 41)

Parts = Mapping[str, np.ndarray]


def field_figure(choice: FieldChoice, parts: Mapping[str, Parts], block: np.ndarray, arena: Arena) -> Figure:
    """Draw the residual's component over its axes, one panel for each simulation, all on one scale.

    Args:
        choice: what is drawn.
        parts: the residual's components (N,) of each simulation, by its title.
        block: (N,) of each transition, for the errors.
        arena: its walls are drawn around places.
    """
    fields = {title: binned(choice.axes, values[choice.component], block) for title, values in parts.items()}
    scale = _scale(fields.values())
    with style():
        width = WIDTH_INCHES if len(parts) > 1 else 0.62 * WIDTH_INCHES
        figure = Figure(figsize=(width, _height(choice)), layout="constrained")
        panels = figure.subplots(1, len(parts), sharex=True, sharey=True, squeeze=False)[0]
        for panel, (title, field) in zip(panels, fields.items(), strict=True):
            draw_field(panel, choice, field, scale, COLOURS[title])
            if choice.is_place:
                _draw_arrows(panel, choice, [binned(choice.axes, parts[title][name], block) for name in ("x", "y")])
                _draw_walls(panel, choice, arena)
            panel.set_title(title)
        _label_upwards(panels[0], choice)
        if choice.is_map:
            figure.colorbar(panels[0].collections[0], ax=list(panels), shrink=0.9, label="error / ordinary noise")
    return figure


def calm_figure(choices: Sequence[FieldChoice], parts: Parts, block: np.ndarray) -> Figure:
    """Draw fields of one simulation, in which nothing is to be seen, side by side on one scale."""
    fields = [binned(choice.axes, parts[choice.component], block) for choice in choices]
    scale = max(1.0, _scale(fields))
    with style():
        figure = Figure(figsize=(WIDTH_INCHES, 3.2), layout="constrained")
        for panel, choice, field in zip(
            figure.subplots(1, len(choices), squeeze=False)[0], choices, fields, strict=True
        ):
            draw_field(panel, choice, field, scale, FLOOR)
            _label_upwards(panel, choice)
            panel.set_title(textwrap.fill(COMPONENTS[choice.component], 26), fontsize=8)
            if choice.is_place:
                panel.set_aspect("equal")
            if choice.is_map:
                figure.colorbar(panel.collections[0], ax=panel, location="bottom", label="error / ordinary noise")
    return figure


def draw_field(panel: Axes, choice: FieldChoice, field: Field, scale: float, colour: str) -> None:
    """Draw one field: a curve with its 95 % band, or a map; grey where there is too little to say."""
    if choice.is_map:
        panel.set_facecolor(TOO_FEW)
        panel.grid(visible=False)
        edges = [axis.edges for axis in choice.axes]
        panel.pcolormesh(*edges, field.mean.T, cmap=LESS_AND_MORE, vmin=-scale, vmax=scale, rasterized=True)
        panel.set_xlabel(choice.axes[0].label, parse_math=False)
    else:
        _draw_curve(panel, choice.axes[0], field, scale, colour)


def spread_figure(residuals: Mapping[str, np.ndarray]) -> Figure:
    """Draw how residuals (N, 3) of each simulation are spread, beside the ordinary noise."""
    with style():
        figure = Figure(figsize=(WIDTH_INCHES, 2.9), layout="constrained")
        for column, (panel, name) in enumerate(zip(figure.subplots(1, 3), ("forward", "left", "turn"), strict=True)):
            far, peaks = [], [0.5]
            for title, residual in residuals.items():
                values = residual[np.isfinite(residual[:, column]), column]
                share = np.histogram(values.clip(BINS[0], BINS[-1]), BINS)[0] / max(1, len(values))
                density = share / (BINS[1] - BINS[0])
                panel.stairs(density, BINS, linewidth=1.4, color=COLOURS[title], label=title)
                far.append(f"{100 * (np.abs(values) > 3).sum() / max(1, len(values)):.1f} %")
                peaks.append(1.05 * density[1:-1].max())
            normal = np.exp(-(BINS**2) / 2) / np.sqrt(2 * np.pi)
            panel.plot(BINS, normal, color=MEASURED, linewidth=0.9, label="ordinary noise")
            panel.set(title=f"{name}\nbeyond ±3: {' → '.join(far)}", xlabel="error / ordinary noise")
            panel.set(ylim=(0, max(peaks)), yticks=[])
        figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def runs_figure(before: Sequence[OpenLoop], after: Sequence[OpenLoop]) -> Figure | None:
    """Draw two held-out runs as measured and as predicted: a typical one and a bad one; None where there is none.

    Where `after` is empty only the simulation is drawn.
    """
    known = sorted(
        (index for index, run in enumerate(before) if np.isfinite(run.rmse_mm)), key=lambda i: before[i].rmse_mm
    )
    if not known:
        return None
    shown = dict.fromkeys(known[round(share * (len(known) - 1))] for share in (0.5, 0.9))
    with style():
        figure = Figure(figsize=(WIDTH_INCHES, 3.9), layout="constrained")
        panels = figure.subplots(1, 2)
        for panel, index in zip(panels, shown, strict=False):
            _draw_run(panel, before[index], after[index] if after else None)
        for panel in panels[len(shown) :]:
            panel.set_visible(False)
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=5)
    return figure


def _height(choice: FieldChoice) -> float:
    if not choice.is_place:
        return 3.3 if choice.is_map else 2.5
    x, y = (np.ptp(axis.edges) for axis in choice.axes)
    return float(np.clip(0.42 * WIDTH_INCHES * y / x, 1.4, 6.0)) + 0.8


def _label_upwards(panel: Axes, choice: FieldChoice) -> None:
    panel.set_ylabel(choice.axes[1].label if choice.is_map else "error / ordinary noise", parse_math=False)


def _draw_curve(panel: Axes, axis: Axis, field: Field, scale: float, colour: str) -> None:
    middles = (axis.edges[1:] + axis.edges[:-1]) / 2
    band = 1.96 * field.standard_error
    known = np.isfinite(field.mean)
    panel.axhline(0, color=MEASURED, linewidth=0.9)
    if axis.names:
        panel.errorbar(middles, field.mean, band, fmt="o", color=colour, capsize=3)
        panel.set_xticks(middles, axis.names, parse_math=False)
    else:
        panel.fill_between(middles, field.mean - band, field.mean + band, color=colour, alpha=0.2, linewidth=0)
        panel.plot(middles, field.mean, "o-", color=colour, markersize=3)
    for low, high in zip(axis.edges[:-1][~known], axis.edges[1:][~known], strict=True):
        panel.axvspan(low, high, color=TOO_FEW, linewidth=0)
    panel.set_xlabel(axis.label, parse_math=False)
    panel.set(xlim=(axis.edges[0], axis.edges[-1]), ylim=(-scale, scale))


def _draw_arrows(panel: Axes, choice: FieldChoice, carried: Sequence[Field]) -> None:
    """Draw where vehicles are carried to, along x and y, where that is more than chance; of size 1, a bin long."""
    x, y = carried
    middles = [(axis.edges[1:] + axis.edges[:-1]) / 2 for axis in choice.axes]
    bin_mm = min(axis.edges[1] - axis.edges[0] for axis in choice.axes)
    size, error = np.hypot(x.mean, y.mean), np.hypot(x.standard_error, y.standard_error)
    clear = (size > 3.5 * error) & (size > 0.25)  # beyond chance even among a hundred bins
    along, across = (np.where(clear, field.mean / np.maximum(size, 1), np.nan).T * bin_mm for field in carried)
    panel.quiver(
        *middles, along, across, angles="xy", scale_units="xy", scale=1, pivot="mid", color=MEASURED, width=0.005
    )


def _draw_walls(panel: Axes, choice: FieldChoice, arena: Arena) -> None:
    """Draw the walls, unless the vehicles stayed in a small part between them."""
    low, high = (np.array([axis.edges[end] for axis in choice.axes]) for end in (0, -1))
    size_mm = arena.high_mm - arena.low_mm
    if np.prod(size_mm) <= 3 * np.prod(high - low):
        panel.add_patch(Rectangle(tuple(arena.low_mm), *size_mm, facecolor="none", edgecolor="#8a8a8a"))
        low, high = np.minimum(low, arena.low_mm - 0.02 * size_mm), np.maximum(high, arena.high_mm + 0.02 * size_mm)
    panel.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")


def _scale(fields: Iterable[Field]) -> float:
    """Return the end of a common scale, never so small that chance looks like something."""
    ends = [_end(field) for field in fields]
    return max(0.6, 1.05 * max(ends))


def _end(field: Field) -> float:
    """Return the largest mean with its band; of a map's many bins, what two in a hundred go beyond."""
    sizes = np.abs(field.mean)
    if field.mean.ndim == 1:
        sizes = sizes + 1.96 * field.standard_error
    known = sizes[np.isfinite(sizes)]
    return float(np.quantile(known, 1.0 if field.mean.ndim == 1 else 0.98)) if len(known) else 0.0


def _known(poses: np.ndarray) -> np.ndarray:
    return poses[np.isfinite(poses).all(axis=1)]


def _draw_run(panel: Axes, before: OpenLoop, after: OpenLoop | None) -> None:
    predictions = {BEFORE: before} | ({AFTER: after} if after else {})
    tracks = {"measured": _known(before.track.pose)}  # unscored poses leave no gap in the line
    tracks |= {title: _known(run.predicted) for title, run in predictions.items()}
    colours = {"measured": MEASURED} | COLOURS
    for title, track in tracks.items():
        panel.plot(*track[:, :2].T, color=colours[title], linewidth=1.6 if title == "measured" else 1.1, label=title)
    panel.plot(*tracks[BEFORE][0, :2], "o", color=MEASURED, markersize=5, label="start")
    for number, (title, track) in enumerate(tracks.items()):
        panel.plot(*track[-1, :2], "s", color=colours[title], markersize=5, label=None if number else "end")
    shown = np.concatenate(list(tracks.values()))[:, :2]
    low, high = shown.min(axis=0), shown.max(axis=0)
    reach = 0.55 * (high - low).max() + 10
    window = np.stack([(low + high) / 2 - reach, (low + high) / 2 + reach])
    panel.set(xlim=window[:, 0], ylim=window[:, 1], box_aspect=1, xlabel="x, mm", ylabel="y, mm")
    errors = " → ".join(f"{run.rmse_mm:.0f}" for run in predictions.values())
    panel.set_title(f"{before.track.run}: RMSE {errors} mm", loc="left", parse_math=False)
