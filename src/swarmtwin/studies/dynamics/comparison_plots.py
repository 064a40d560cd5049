"""The pictures of the comparison of dynamics models, from the folder that the study leaves."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from swarmtwin.dynamics.error_plots import comparison_figure
from swarmtwin.dynamics.evaluation import ErrorFigure
from swarmtwin.simulation.open_loop_plots import runs_figure
from swarmtwin.simulation.open_loop_storage import load_open_loop

DRAWN = ("crnet", "fcnn")


def draw_comparison(made: Path, output: Path) -> None:
    """Draw into `output` the one-step errors of all models in `made`, and the runs of some and of the best.

    Raises:
        UserError: runs are missing or damaged.
    """
    metrics = json.loads((made / "metrics.json").read_text())
    table = pd.read_csv(made / "table.csv")
    best = str(table.model[table.best].iloc[0])
    for name in metrics:
        if name in DRAWN or name == best:
            runs_figure(*load_open_loop(made / "open_loop" / f"{name}.parquet")).savefig(output / f"runs_{name}.png")
    for recording in ("train_vehicle", "other_vehicle"):
        one_step = {name: _error(figures[recording]["one_step"]) for name, figures in metrics.items()}
        floor = metrics[best][recording]["floor"]
        figure = comparison_figure(one_step, _error(floor), floor["kind"] != "exact")
        figure.savefig(output / f"errors_{recording}.png")


def _error(plain: Mapping[str, Any]) -> ErrorFigure:
    position, orientation = plain["position_mm"], plain["orientation_deg"]
    return ErrorFigure(position["mean"], position["sd"], orientation["mean"], orientation["sd"], transitions=0)
