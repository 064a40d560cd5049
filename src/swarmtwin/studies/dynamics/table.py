"""A robot's models side by side: the columns of table.csv, and what a person reads of them."""

from typing import Any

import pandas as pd

from swarmtwin.simulation.evaluation import Figures
from swarmtwin.studies.study_table import StudyTable


def figure_columns(figures: Figures) -> dict[str, Any]:
    """Return figures as columns of table.csv, units in their names; `floor` is given the robot's situation."""
    situation = figures.floors.get("situation", figures.best)
    columns: dict[str, Any] = {"transitions": figures.one_step.transitions}
    for name, figure in (
        ("one_step", figures.one_step),
        ("floor", situation.error),
        ("floor_given_history", figures.floors["history"].error if "history" in figures.floors else None),
        ("model_error", figures.model_error),
    ):
        for field in ("position_mm", "position_sd_mm", "orientation_deg", "orientation_sd_deg"):
            columns[f"{name}_{field}"] = round(getattr(figure, field), 4) if figure else None
    loop = figures.open_loop
    columns |= {"open_loop_mm": round(loop.rmse_mm, 2), "open_loop_sd_mm": round(loop.rmse_sd_mm, 2)} if loop else {}
    kinds = {"floor_kind": situation.kind}
    if history := figures.floors.get("history"):
        kinds["floor_given_history_kind"] = history.kind
    return {**columns, **kinds}


def model_table(title: str, table: pd.DataFrame) -> StudyTable:
    """Return the floors, given the situation and given the commands before as well, then each model of table.csv.

    Errors are mean ± standard deviation, first in mm, then in degrees.
    """
    models = list(table.model.unique())
    first = table[table.model == models[0]].set_index("recording")
    rows = []
    for name, column in (("floor", "floor"), ("floor, history", "floor_given_history")):
        if f"{column}_kind" in first and pd.notna(kind := first[f"{column}_kind"].iloc[0]):
            places = (_errors(first.loc[place], column) for place in ("train_vehicle", "other_vehicle"))
            rows.append([name if kind == "exact" else f"{name} ≈", *places, "", "", ""])
    floors = len(rows)
    marked = []
    for model in models:
        own = table[table.model == model].set_index("recording")
        train, other, loop = (own.loc[name] for name in ("train_vehicle", "other_vehicle", "open_loop"))
        marked += [len(rows)] if bool(train.best) else []
        rows.append(
            [
                f"{model}\n{train.parameters:,}",
                _errors(train, "one_step"),
                _errors(other, "one_step"),
                _errors(train, "model_error"),
                f"{loop.open_loop_mm:.0f} ± {loop.open_loop_sd_mm:.0f}",
                f"{train.dead_seeds} of {train.seeds}",
            ]
        )
    figures = ("train vehicle\nmm, °", "other vehicle\nmm, °", "model error\nmm, °", "open loop\nmm")
    return StudyTable(
        f"{title}: errors on runs the models have not seen",
        ("model\nparameters", *figures, "dead\nseeds"),
        rows,
        "mean ± standard deviation, position above orientation; * least error on the validation runs, by which it was "
        "chosen; floor: of the best model with the robot's situation, with the commands before as well; ≈ "
        "estimated; model error: distance to the stand-in's exact mean displacement",
        floors=floors,
        marked=marked,
    )


def _errors(row: pd.Series, name: str) -> str:
    if pd.isna(row[f"{name}_position_mm"]):
        return ""
    position = f"{row[f'{name}_position_mm']:.2f} ± {row[f'{name}_position_sd_mm']:.2f}"
    return f"{position}\n{row[f'{name}_orientation_deg']:.2f} ± {row[f'{name}_orientation_sd_deg']:.2f}"
