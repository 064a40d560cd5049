"""What came of a grid as a table: table.csv, and what a person reads of it, with the paper's own figures beneath."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from swarmtwin.robot import StrictModel
from swarmtwin.studies.study_table import StudyTable
from swarmtwin.studies.training_grid.measured_errors import MeasuredErrors
from swarmtwin.studies.training_grid.training_store import TrainingOutcome
from swarmtwin.studies.training_grid.trainings import Selector, Training, chosen

Four = tuple[float, float | None, float | None, float | None]


class Published(StrictModel):
    """What the paper states of trainings.

    Attributes:
        of: which.
        train_vehicle: position error, mean and standard deviation in mm, and orientation error in degrees, likewise.
        other_vehicle: the same on its test vehicle.
        open_loop_mm: root mean square errors of the runs that it shows, in its order.
    """

    of: Selector
    train_vehicle: Four | None = None
    other_vehicle: Four | None = None
    open_loop_mm: tuple[float, ...] = ()


SeedErrors = Mapping[int, Mapping[str, MeasuredErrors]]
"""How the live seeds of a training measured, by seed and then by recording."""


def training_rows(
    training: Training,
    outcomes: Sequence[TrainingOutcome],
    errors: SeedErrors,
    recordings: Sequence[str],
    real: int,
    published: Sequence[Published],
) -> list[dict[str, Any]]:
    """Return a training's rows of table.csv, one a recording: figures are means over live seeds.

    Columns:
        title, and all fields of the training; all_real: how many real transitions there are; real_transitions: how
            many of them it, or its generator, was given.
        epochs, steps, learned_from: of the first live seed.
        seeds, dead_seeds, dead_because.
        *_mm, *_deg: over transitions; *_over_seeds: standard deviation over seeds; *_sd_*: over transitions.
        floor_command_*, floor_history_*: of the best possible model, given the robot's situation, or the commands
            before as well; `_kind`: whether it is known exactly or estimated, and how.
        paper_*: what the paper states of its own robots.
    """
    live = next((outcome for outcome in outcomes if outcome.dead is None), outcomes[0])
    about = {
        "title": training.title(real),
        **training.model_dump(),
        "size": training.size,
        "measured_share": training.measured_share,
        "all_real": real,
        "real_transitions": round(training.real * real),
        "epochs": live.epochs,
        "steps": live.steps,
        "learned_from": live.learned_from,
        "seeds": len(outcomes),
        "dead_seeds": sum(outcome.dead is not None for outcome in outcomes),
        "dead_because": next((outcome.dead for outcome in outcomes if outcome.dead), None),
    }
    stated = [one for one in published if chosen([training], one.of)]
    rows = []
    for recording in recordings:
        own = [by_recording[recording] for by_recording in errors.values()]
        rows.append({**about, "recording": recording, **_means(own), **_stated(stated, recording)})
    return rows


def _means(errors: Sequence[MeasuredErrors]) -> dict[str, Any]:
    row: dict[str, Any] = {}
    for name in errors[0].figures if errors else ():
        values = [one.figures[name] for one in errors if name in one.figures]
        row[name] = float(np.mean(values))
        if "sd" not in name and name != "transitions" and len(values) > 1:
            row[f"{name}_over_seeds"] = float(np.std(values, ddof=1))
    for known, floor in errors[0].floors.items() if errors else ():
        row |= {f"floor_{known}_{name}": value for name, value in floor.items()}
        row[f"floor_{known}_kind"] = errors[0].floor_kinds[known]
    return row


def _stated(published: Sequence[Published], recording: str) -> dict[str, float]:
    row: dict[str, float] = {}
    names = ("position_mm", "position_sd_mm", "orientation_deg", "orientation_sd_deg")
    for one in published:
        four = getattr(one, recording, None) or ()
        row |= {f"paper_{name}": value for name, value in zip(names, four, strict=False) if value is not None}
        if recording == "open_loop" and one.open_loop_mm:
            row["paper_open_loop_mm"] = float(np.mean(one.open_loop_mm))
    return row


def shown_table(table: pd.DataFrame, title: str) -> StudyTable:
    """Return the table that a person reads: the floors, then each training with the paper's figures beneath it."""
    recordings = list(dict.fromkeys(table.recording))
    headings = ["trained", "real", "steps"]
    headings += [f"{_place(one)}, mm and °" for one in recordings if one != "open_loop"]
    headings += ["model error, mm", "open loop, mm", "dead seeds"]
    rows = [_floor_row(table, recordings, known) for known in ("command", "history")]
    for _, own in table.groupby("title", sort=False):
        by_recording = {row["recording"]: row for row in own.to_dict("records")}
        rows.append(_training_row(by_recording, recordings))
        if any(
            pd.notna(row.get(name)) for row in by_recording.values() for name in row if str(name).startswith("paper_")
        ):
            rows.append(_paper_row(by_recording, recordings))
    return StudyTable(title, headings, [row for row in rows if row])


def _floor_row(table: pd.DataFrame, recordings: Sequence[str], known: str) -> list[str]:
    """Return the floors: one for all models on a stand-in, else the least that any of them makes known."""
    cells = []
    for recording in (one for one in recordings if one != "open_loop"):
        own = table[table.recording == recording]
        if f"floor_{known}_position_mm" not in own or own[f"floor_{known}_position_mm"].isna().all():
            return []
        least = (own[f"floor_{known}_{name}"].min() for name in ("position_mm", "orientation_deg"))
        cells.append("; ".join(f"{figure:.2f}" for figure in least))
    return [_floor_name(table, known), "", "", *cells, "", "", ""]


def _floor_name(table: pd.DataFrame, known: str) -> str:
    """Return what a floor is called; ≈ where it is an estimate."""
    kinds = table.get(f"floor_{known}_kind", pd.Series(dtype=str)).dropna()
    return f"floor, given the {known}{'' if set(kinds) <= {'exact'} else ' ≈'}"


def _training_row(by_recording: Mapping[str, Mapping[Any, Any]], recordings: Sequence[str]) -> list[str]:
    first = by_recording[recordings[0]]
    dead = int(first["dead_seeds"])
    errors = [
        f"{_error(by_recording[one], 'position', 'mm')}; {_error(by_recording[one], 'orientation', 'deg')}"
        if pd.notna(by_recording[one].get("position_mm"))
        else "dead"
        for one in recordings
        if one != "open_loop"
    ]
    loop = by_recording[recordings[-1]]
    return [
        str(first["title"]),
        f"{int(first['real_transitions']):,}",
        f"{int(first['steps']):,}",
        *errors,
        _number(first.get("model_error_position_mm")),
        _with_seeds(loop, "open_loop_mm", 0),
        f"{dead} of {int(first['seeds'])}" if dead else "",
    ]


def _paper_row(by_recording: Mapping[str, Mapping[Any, Any]], recordings: Sequence[str]) -> list[str]:
    cells = []
    for row in (by_recording[one] for one in recordings if one != "open_loop"):
        pairs = (("paper_position_mm", "paper_position_sd_mm"), ("paper_orientation_deg", "paper_orientation_sd_deg"))
        stated = [[row.get(name) for name in pair] for pair in pairs]
        cells.append("; ".join(_spread(*pair) for pair in stated if pd.notna(pair[0])))
    return [
        "· the paper's robots",
        "",
        "",
        *cells,
        "",
        _number(by_recording[recordings[-1]].get("paper_open_loop_mm"), 0),
        "",
    ]


def _error(row: Mapping[Any, Any], name: str, unit: str) -> str:
    over_seeds = row.get(f"{name}_{unit}_over_seeds")
    spread = f" ({over_seeds:.2f})" if over_seeds is not None and pd.notna(over_seeds) else ""
    return f"{_spread(row[f'{name}_{unit}'], row[f'{name}_sd_{unit}'])}{spread}"


def _with_seeds(row: Mapping[Any, Any], name: str, digits: int) -> str:
    over_seeds = row.get(f"{name}_over_seeds")
    spread = f" ({over_seeds:.{digits}f})" if over_seeds is not None and pd.notna(over_seeds) else ""
    return f"{_number(row.get(name), digits)}{spread}"


def _spread(mean: Any, deviation: Any) -> str:
    return f"{mean:.2f} ± {deviation:.2f}" if deviation is not None and pd.notna(deviation) else f"{mean:.2f}"


def _number(value: Any, digits: int = 2) -> str:
    return f"{value:.{digits}f}" if value is not None and pd.notna(value) else ""


def _place(recording: str) -> str:
    return {"train_vehicle": "train vehicle", "other_vehicle": "other vehicle"}.get(recording, recording)


CAPTION = (
    "Errors of one step: mean ± standard deviation over transitions, as the paper has them, and in brackets the "
    "standard deviation over seeds; position in mm, orientation in degrees. Train vehicle: held-out runs of the "
    "vehicle learned from. Model error: distance to the stand-in's exact mean displacement, on the train vehicle. "
    "Open loop: RMSE over whole runs predicted from the first pose and the commands alone, on the last recording. "
    "Floor: of the best possible model; ≈ is estimated. The paper's figures are of its own robots, from single "
    "trainings."
)


def brief_table(table: pd.DataFrame, title: str) -> StudyTable:
    """Return what fits a terminal: the errors on another vehicle, the floors, and the paper's own beside them."""
    own = table[table.recording == "other_vehicle"]
    rows = []
    for known in ("command", "history"):
        names = [f"floor_{known}_{name}" for name in ("position_mm", "orientation_deg")]
        if names[0] in own and own[names[0]].notna().any():
            figures = [_number(own[name].min()) for name in names]
            rows.append([_floor_name(table, known), "", *figures, "", ""])
    loops = table[table.recording == list(dict.fromkeys(table.recording))[-1]].set_index("title")
    for row in own.to_dict("records"):
        errors = [_with_seeds(row, "position_mm", 2) or "dead", _with_seeds(row, "orientation_deg", 2)]
        stated = [_number(row.get(f"paper_{name}")) for name in ("position_mm", "orientation_deg")]
        loop = _with_seeds(loops.loc[row["title"]].to_dict(), "open_loop_mm", 0)
        dead = f" ({row['dead_seeds']} of {row['seeds']} dead)" if row["dead_seeds"] else ""
        rows.append(
            [
                f"{row['title']}{dead}",
                f"{int(row['real_transitions']):,}",
                *errors,
                loop,
                "; ".join(filter(None, stated)),
            ]
        )
    headings = ["trained", "real\nseen", "other\nvehicle\nmm", "\n\n°", "open\nloop\nmm", "the\npaper's\nmm; °"]
    if not any(row[-1] for row in rows):
        headings, rows = headings[:-1], [row[:-1] for row in rows]
    return StudyTable(title, headings, rows)
