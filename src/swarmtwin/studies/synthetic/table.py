"""Models trained on real and on synthetic transitions side by side: their table.csv to read, and as a picture."""

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich import box
from rich.table import Table

from swarmtwin.plotting import FLOOR, MEASURED, PREDICTED, style

ERRORS = {"position_mm": "position error, mm", "orientation_deg": "orientation error, °"}
PLACES = {"train_vehicle": "vehicle learned from", "other_vehicle": "another vehicle"}


def case_rows(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the floor and then each case of table.csv, in its order, as a person reads it.

    Errors stand first in mm, then in degrees, each × that of CR-Net-R on all real data.
    """
    rows = {place: {row["case"]: row for row in part.to_dict("records")} for place, part in table.groupby("recording")}
    real = {place: rows[place]["real"] for place in PLACES}
    floor = {place: [f"{real[place][f'floor_{name}']:.2f}       " for name in ERRORS] for place in PLACES}
    shown: list[dict[str, Any]] = [
        {"title": "floor", "inputs": "", "real": "", "steps": "", **floor, "dead_seeds": ""},
    ]
    for case, row in rows["train_vehicle"].items():
        shown.append(
            {
                "title": row["title"],
                "inputs": row["inputs"],
                "real": f"{row['real']:,}",
                "steps": f"{row['steps']:,}",
                **{place: _compared(rows[place][case], real[place]) for place in PLACES},
                "dead_seeds": f"{row['dead_seeds']} of {row['seeds']}",
            }
        )
    return shown


def case_table(title: str, table: pd.DataFrame) -> Table:
    """Return the terminal's table: the floor, then a row for each case."""
    title = f"{title}: trained on real and on synthetic transitions"
    shown = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, title=title)
    shown.add_column("case\n  given", no_wrap=True)
    for heading in ("real\nseen", "\nsteps", "train vehicle\nmm, °", "other vehicle\nmm, °", "dead\nseeds"):
        shown.add_column(heading, justify="right", no_wrap=True)
    for row in case_rows(table):
        errors = ("\n".join(row[place]) for place in PLACES)
        given = f"\n  {row['inputs']}" if row["inputs"] else ""
        style = "dim" if row["title"] == "floor" else None
        shown.add_row(f"{row['title']}{given}", row["real"], row["steps"], *errors, row["dead_seeds"], style=style)
    shown.caption = (
        "on runs nobody has seen; ×: compared with CR-Net-R on all real transitions; given: what the model looks at; "
        "the ensemble is what the generator of CR-Net-S predicts the mean with, here used directly"
    )
    return shown


def _compared(row: dict[Any, Any], reference: dict[Any, Any]) -> list[str]:
    if any(pd.isna(row[name]) for name in ERRORS):
        return ["dead"]
    return [f"{row[name]:.2f} ×{row[name] / reference[name]:.3f}" for name in ERRORS]


def cases_figure(table: pd.DataFrame, title: str, mark: float = 1.02, widest: float = 1.3) -> Figure:
    """Draw each case's errors as dots beside the floor.

    Args:
        table: table.csv.
        title: of the robot.
        mark: a band from CR-Net-R's error to this multiple of it marks what counts as equally good.
        widest: multiples of it beyond this are arrows.
    """
    cases = list(dict.fromkeys(table.case))
    labels = [f"{row.title}  ({row.real:,} real)" for row in table.drop_duplicates("case").itertuples()]
    with style():
        figure = Figure(figsize=(11, 0.3 * len(cases) + 1.8), layout="constrained")
        panels = figure.subplots(1, 4, sharey=True)
        columns = [(place, quantity) for quantity in ERRORS for place in PLACES]
        for panel, (place, quantity) in zip(panels, columns, strict=True):
            part = table[table.recording == place].set_index("case").loc[cases]
            reference = float(part[quantity].loc["real"])
            label = f"CR-Net-R to {100 * (mark - 1):.0f} % above"
            panel.axvspan(reference, mark * reference, color=FLOOR, alpha=0.2, label=label)
            panel.axvline(float(part[f"floor_{quantity}"].iloc[0]), color=MEASURED, linewidth=1, label="floor")
            _draw_errors(panel, part, quantity, widest * reference)
            panel.set(xlabel=ERRORS[quantity], title=PLACES[place])
            panel.set_yticks(range(len(cases)), labels)
        panels[0].invert_yaxis()
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
        figure.suptitle(f"{title}: trained on real and on synthetic transitions", fontsize=10)
    return figure


def _draw_errors(panel: Axes, part: pd.DataFrame, quantity: str, widest: float) -> None:
    """Draw a dot a case with its spread over seeds; what lies beyond `widest` is an arrow with its value."""
    errors = part[quantity].to_numpy(float)
    spread = np.nan_to_num(part[f"{quantity}_over_seeds"].to_numpy(float))
    rows, beyond = np.arange(len(errors)), errors > widest
    shown = ~beyond & np.isfinite(errors)
    panel.errorbar(errors[shown], rows[shown], xerr=spread[shown], fmt="o", color=PREDICTED, markersize=5)
    for row in rows[beyond]:
        panel.plot(widest, row, ">", color=PREDICTED, markersize=5)
        panel.annotate(f"{errors[row]:.1f} ", (widest, row), ha="right", va="center", fontsize=8)
    for row in rows[np.isnan(errors)]:
        panel.annotate("dead ", (widest, row), ha="right", va="center", fontsize=8)
    panel.set_xlim(right=1.01 * widest)
