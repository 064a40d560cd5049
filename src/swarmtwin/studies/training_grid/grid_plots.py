"""The pictures of a grid, from the table.csv and the options that it leaves: dots, curves, heat maps, open loop."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, NullLocator

from swarmtwin.files import read_provenance
from swarmtwin.plotting import FLOOR, MEASURED, PREDICTED, style
from swarmtwin.simulation.open_loop_storage import load_open_loop
from swarmtwin.studies.reality_gap.gap_plots import open_loop_figure
from swarmtwin.studies.training_grid.table_file import TITLES, read_table

AXES = {
    "size": "transitions learned from",
    "real": "real transitions",
    "synthetic": "transitions drawn from the generator",
    "measured_share": "share of the transitions that was measured",
    "generator_epochs": "epochs of the generator's training",
    "noise": "standard deviation of the noise added, mm and °",
}
PLACES = {"train_vehicle": "vehicle learned from", "other_vehicle": "another vehicle"}


def draw_grid(made: Path, output: Path) -> None:
    """Draw into `output` what the view in the options of the folder `made` asks for.

    Raises:
        UserError: `made` is not a folder of swarmtwin's.
    """
    _, options = read_provenance(made)
    table, view = read_table(made / "table.csv"), options["view"]
    title = f"{options['title']}: {options['robot']['title']}"
    figures: dict[str, Callable[[], Figure]] = {
        "dots": lambda: dots_figure(table, title),
        "curve": lambda: curve_figure(table, view["x"], title),
        "heat_map": lambda: heat_map_figure(table, title),
        "open_loop": lambda: dots_figure(table, title),
    }
    figures[view["kind"]]().savefig(output / f"{options['name']}.png")
    if (made / "open_loop").exists():
        predicted = {file.stem: load_open_loop(file)[0] for file in sorted((made / "open_loop").glob("*.parquet"))}
        open_loop_figure(predicted).savefig(output / f"{options['name']}_runs.png")


def dots_figure(table: pd.DataFrame, title: str, widest: float = 10.0) -> Figure:
    """Draw each training's errors as dots with their spread over seeds, floors as lines, the paper's as diamonds.

    Args:
        table: table.csv.
        title: of the picture.
        widest: multiples of the least error beyond which a dot is an arrow with its value.
    """
    titles = list(dict.fromkeys(table.title))
    columns = [(place, quantity) for quantity in ("position_mm", "orientation_deg") for place in PLACES]
    if "open_loop" in set(table.recording):
        columns = [("other_vehicle", "position_mm"), ("open_loop", "open_loop_mm")]
    with style():
        figure = Figure(figsize=(2.3 * len(columns) + 3, 0.27 * len(titles) + 1.8), layout="constrained")
        panels = figure.subplots(1, len(columns), sharey=True)
        for panel, (place, quantity) in zip(panels, columns, strict=True):
            own = table[table.recording == place].set_index("title").loc[titles]
            _draw_dots(panel, own, quantity, widest)
            panel.set(xlabel=TITLES[quantity], title=PLACES.get(place, "runs kept for open loop"))  # type: ignore[index]
            panel.set_yticks(range(len(titles)), titles)
        panels[0].invert_yaxis()
        handles = {
            label: handle for panel in panels for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)
        }
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4)
        figure.suptitle(title, fontsize=10)
    return figure


def _draw_dots(panel: Axes, own: pd.DataFrame, quantity: str, widest: float) -> None:
    errors = own[quantity].to_numpy(float) if quantity in own else np.full(len(own), np.nan)
    paper = own.get(f"paper_{quantity}", pd.Series(np.nan, own.index)).to_numpy(float)
    reach = widest * float(np.nanmin(errors)) if np.isfinite(errors).any() else 1.0
    spread = np.nan_to_num(own.get(f"{quantity}_over_seeds", pd.Series(0.0, own.index)).to_numpy(float))
    rows = np.arange(len(own))
    _draw_floors(panel.axvline, own, quantity)
    shown = np.isfinite(errors) & (errors <= reach)
    panel.errorbar(errors[shown], rows[shown], xerr=spread[shown], fmt="o", color=PREDICTED, markersize=4, label="ours")
    known = np.isfinite(paper) & (paper <= reach)
    if known.any():
        panel.plot(
            paper[known],
            rows[known],
            "D",
            color=MEASURED,
            markerfacecolor="none",
            markersize=4,
            label="the paper's robots",
        )
    for values, colour in ((errors, PREDICTED), (paper, MEASURED)):
        for row in rows[values > reach]:
            panel.plot(reach, row, ">", color=colour, markersize=5)
            panel.annotate(f"{values[row]:.1f} ", (reach, row), ha="right", va="center", fontsize=7, color=colour)
    for row in rows[np.isnan(errors)]:
        panel.annotate("dead ", (reach, row), ha="right", va="center", fontsize=8)
    largest = float(np.nanmax(np.minimum([errors, paper], reach), initial=0.0))
    least = float(np.nanmin([errors, paper], initial=np.inf))
    if np.isfinite(least) and largest > 2 * least:
        panel.set_xscale("log")
        _plain_numbers(panel.xaxis)


def _draw_floors(line: Callable[..., Any], own: pd.DataFrame, quantity: str) -> None:
    for known, dashes in (("command", "-"), ("history", ":")):
        values = own.get(f"floor_{known}_{quantity}", pd.Series(dtype=float)).dropna()
        if len(values):
            line(float(values.min()), color=FLOOR, linewidth=1, linestyle=dashes, label=f"floor, given the {known}")


def curve_figure(table: pd.DataFrame, x: str, title: str) -> Figure:
    """Draw position errors over one field of the trainings, a line for each of what else differs, on both vehicles.

    A colour is what is learned from, or the model where all learn from the same; a marker is the model. Lines at equal
    epochs are dashed, and what was not varied along the axis is dotted. Bands are standard deviations over seeds.
    """
    with style():
        figure = Figure(figsize=(11, 5.4), layout="constrained")
        panels = figure.subplots(1, 2, sharey=True)
        for panel, (place, name) in zip(panels, PLACES.items(), strict=True):
            own = table[(table.recording == place)].dropna(subset="position_mm")
            for label, line in _lines(own, x).items():
                _draw_line(panel, line, x, label, _look(line, own))
            _draw_floors(panel.axhline, own, "position_mm")
            panel.set(xlabel=AXES[x], title=name)
            if x in ("size", "real", "synthetic", "generator_epochs"):
                panel.set_xscale("log")
                places = sorted({round(value) for value in own[x].dropna() * _transitions(own, x)})
                panel.set_xticks(places, [f"{place:,}" for place in places])
                panel.xaxis.set_minor_locator(NullLocator())
            errors = own.position_mm
            if len(errors) and errors.max() > 2.5 * errors.min():
                panel.set_yscale("log")
                _plain_numbers(panel.yaxis)
        panels[0].set(ylabel=TITLES["position_mm"])
        figure.legend(*panels[1].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
        figure.suptitle(title, fontsize=10)
    return figure


def _look(line: pd.DataFrame, own: pd.DataFrame) -> dict[str, Any]:
    """Return colour, marker and dashes of a line."""
    generators, models = list(dict.fromkeys(sorted(own.generator))), list(dict.fromkeys(own.model))
    generator = max(line.generator)
    colour = generators.index(generator) if len(generators) > 2 else models.index(line.model.iloc[0])
    dashed = (line.equal == "epochs").all() or (len(generators) <= 2 and not generator)
    return {
        "color": f"C{colour}",
        "marker": "osD^vPX"[models.index(line.model.iloc[0]) % 7],
        "linestyle": "--" if dashed else "-",
    }


def _plain_numbers(axis: Axis) -> None:
    """Let a logarithmic axis say 3 and 20 rather than powers of ten."""
    axis.set_major_locator(LogLocator(subs=(1.0, 1.5, 2.0, 3.0, 5.0, 7.0)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def _lines(own: pd.DataFrame, x: str) -> Mapping[str, pd.DataFrame]:
    """Return the rows of each line, by its name: what is the same in a line, of what differs in the table."""
    differs = [
        name
        for name in ("model", "generator", "equal", "history", "real", "noise")
        if name != x and not (x in ("size", "real") and name in ("real", "synthetic")) and own[name].nunique() > 1
    ]
    if x in ("size", "real", "synthetic", "generator_epochs"):
        differs = [name for name in differs if name != "noise"]
    if x == "measured_share":  # what was measured alone ends every line
        lines = {}
        for generator in [name for name in dict.fromkeys(own.generator) if name]:
            for model in dict.fromkeys(own.model):
                part = own[(own.model == model) & own.generator.isin([generator, ""])]
                lines[f"{model}, {generator}"] = part
        return lines
    if not differs:
        return {str(own.model.iloc[0]): own}
    lines = {}
    for values, part in own.groupby(differs, sort=False, dropna=False):
        of_line = values if isinstance(values, tuple) else (values,)
        lines[_line_name(dict(zip(differs, of_line, strict=True)))] = part
    return lines


def _line_name(values: Mapping[str, Any]) -> str:
    words = []
    for name, value in values.items():
        if name == "generator":
            words.append(f"drawn from {value}" if value else "measured")
        elif name == "equal":
            words.append(f"equal {value}")
        elif name == "history":
            words.append("given the commands before" if value else "")
        elif name == "real":
            words.append(f"{value:.0%} of the real" if value < 1 else "all real")
        else:
            words.append(str(value) if name == "model" else f"{name} {value:g}")
    return ", ".join(word for word in words if word)


def _draw_line(panel: Axes, line: pd.DataFrame, x: str, label: str, look: Mapping[str, Any]) -> None:
    points = line.dropna(subset=x).sort_values(x)
    if points[x].nunique() < 2:
        panel.axhline(float(line.position_mm.iloc[0]), color=look["color"], linestyle=":", label=label)
        return
    place = points[x] * _transitions(points, x)
    panel.plot(place, points.position_mm, markersize=4, label=label, **look)
    spread = points.get("position_mm_over_seeds", pd.Series(0.0, points.index)).fillna(0.0)
    panel.fill_between(
        place, points.position_mm - spread, points.position_mm + spread, color=look["color"], alpha=0.08, linewidth=0
    )


def _transitions(points: pd.DataFrame, x: str) -> pd.Series | float:
    """Return by what a field counted in multiples of all real transitions becomes a number of them."""
    return points.all_real if x in ("size", "real", "synthetic") else 1.0


def heat_map_figure(table: pd.DataFrame, title: str, place: str = "other_vehicle") -> Figure:
    """Draw the position error over real and drawn transitions, a panel a generator; real ones alone in a column."""
    own = table[table.recording == place]
    generators = [name for name in dict.fromkeys(own.generator) if name]
    least, most = float(own.position_mm.min()), float(own.position_mm.max())
    with style():
        figure = Figure(figsize=(4.6 * len(generators) + 1, 3.8), layout="constrained")
        panels = figure.subplots(1, max(1, len(generators)), squeeze=False).ravel()
        for panel, generator in zip(panels, generators, strict=True):
            grid = _heat_map(own, generator)
            image = panel.imshow(
                grid.to_numpy(float), origin="lower", cmap="viridis_r", vmin=least, vmax=most, aspect="auto"
            )
            for (row, column), value in np.ndenumerate(grid.to_numpy(float)):
                shade = "white" if value > (least + most) / 2 else "black"
                panel.annotate(
                    f"{value:.2f}" if np.isfinite(value) else "dead",
                    (column, row),
                    ha="center",
                    va="center",
                    color=shade,
                )
            panel.set_xticks(range(grid.shape[1]), list(grid.columns))
            panel.set_yticks(range(grid.shape[0]), [f"{index:,}" for index in grid.index])
            panel.set(title=f"generator {generator}", xlabel="transitions drawn from it", ylabel="real transitions")
            panel.grid(visible=False)
        figure.colorbar(image, ax=list(panels), label=f"{TITLES['position_mm']}, {PLACES[place]}")
        figure.suptitle(title, fontsize=10)
    return figure


def _heat_map(own: pd.DataFrame, generator: str) -> pd.DataFrame:
    """Return errors by number of real transitions, in rows, and of drawn ones, in columns."""
    drawn = own[(own.generator == generator) & (own.equal == "steps")]
    by_drawn = drawn.assign(drawn=(drawn.synthetic * drawn.all_real).round().astype(int))
    grid = by_drawn.pivot_table(index="real_transitions", columns="drawn", values="position_mm", dropna=False)
    measured = own[(own.generator == "") & (own.equal == "steps") & own.model.isin(set(drawn.model))]
    alone = measured.set_index("real_transitions").position_mm
    shown = grid.rename(columns=lambda number: f"{number:,}")
    if len(alone):
        shown.insert(0, "real alone", alone)
    return shown
