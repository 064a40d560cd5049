"""A robot's models side by side: the columns of table.csv, and what a person reads of them."""

from typing import Any

import pandas as pd
from rich import box
from rich.table import Table

from swarmtwin.simulation.evaluation import Figures


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


def model_rows(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the floors, given the situation and given the commands before as well, then each model of table.csv.

    What a person reads of it, errors as mean ± standard deviation, first in mm, then in degrees; `best` erred least on
    the validation runs.
    """
    models = list(table.model.unique())
    first = table[table.model == models[0]].set_index("recording")
    rows = []
    for title, name in (("floor", "floor"), ("floor, history", "floor_given_history")):
        if f"{name}_kind" in first and pd.notna(first[f"{name}_kind"].iloc[0]):
            floor: dict[str, Any] = {
                "model": title if first[f"{name}_kind"].iloc[0] == "exact" else f"{title} ≈",
                "parameters": "",
                **{place: _errors(first.loc[place], name) for place in ("train_vehicle", "other_vehicle")},
            }
            rows.append(floor | {"model_error": [], "open_loop": "", "dead_seeds": "", "best": False})
    for model in models:
        part = table[table.model == model].set_index("recording")
        train, other, loop = (part.loc[name] for name in ("train_vehicle", "other_vehicle", "open_loop"))
        rows.append(
            {
                "model": model,
                "parameters": f"{train.parameters:,}",
                "train_vehicle": _errors(train, "one_step"),
                "other_vehicle": _errors(other, "one_step"),
                "model_error": _errors(train, "model_error"),
                "open_loop": f"{loop.open_loop_mm:.0f} ± {loop.open_loop_sd_mm:.0f}",
                "dead_seeds": f"{train.dead_seeds} of {train.seeds}",
                "best": bool(train.best),
            }
        )
    return rows


def model_table(title: str, table: pd.DataFrame) -> Table:
    """Return the terminal's table: the floors, then a row for each model."""
    title = f"{title}: errors on runs the models have not seen"
    shown = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, title=title)
    shown.add_column("\nmodel", no_wrap=True, min_width=14)
    figures = ("train vehicle\nmm, °", "other vehicle\nmm, °", "model error\nmm, °", "open loop\nmm")
    for heading in (*figures, "dead\nseeds"):
        shown.add_column(heading, justify="right", no_wrap=True)
    for row in model_rows(table):
        name = f"{row['model']} *" if row["best"] else row["model"]
        errors = ("\n".join(row[column]) for column in ("train_vehicle", "other_vehicle", "model_error"))
        style = "dim" if name.startswith("floor") else None
        shown.add_row(name, *errors, row["open_loop"], row["dead_seeds"], style=style)
    shown.caption = (
        "mean ± standard deviation, position above orientation; * best on validation runs; floor: of the best model "
        "with the robot's situation, with the commands before as well; ≈ estimated"
    )
    return shown


def _errors(row: pd.Series, name: str) -> list[str]:
    if pd.isna(row[f"{name}_position_mm"]):
        return []
    position = f"{row[f'{name}_position_mm']:.2f} ± {row[f'{name}_position_sd_mm']:.2f}"
    return [position, f"{row[f'{name}_orientation_deg']:.2f} ± {row[f'{name}_orientation_sd_deg']:.2f}"]
