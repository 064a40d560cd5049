"""The picture of the comparison of real and synthetic transitions."""

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from swarmtwin.files import read_provenance
from swarmtwin.plotting import FLOOR, MEASURED, PREDICTED, style
from swarmtwin.studies.synthetic.table import ERRORS, PLACES


def draw_cases(made: Path, output: Path) -> None:
    """Draw into `output` the table.csv in `made`.

    Raises:
        UserError: `made` is not a folder of swarmtwin's.
    """
    _, options = read_provenance(made)
    cases_figure(pd.read_csv(made / "table.csv"), options["robot"]["title"]).savefig(output / "errors.png")


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
