"""A simulation model measured on a recording: one-step, floor, model error and open loop, for each vehicle."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd

from swarmtwin.dynamics import evaluation
from swarmtwin.dynamics.base import Dynamics
from swarmtwin.dynamics.evaluation import ErrorFigure
from swarmtwin.dynamics.open_loop import OpenLoop, OpenLoopFigure, open_loop, summary
from swarmtwin.dynamics.provenance import Provenance
from swarmtwin.dynamics.store import load_dynamics
from swarmtwin.errors import UserError
from swarmtwin.recordings.recording import Recording
from swarmtwin.robot import DISPLACEMENT_COLUMNS, Robot
from swarmtwin.standin.truth import TRUTH_FILE, read_truth
from swarmtwin.transitions import Transitions, from_recording

FloorKind = Literal["exact", "nearest_neighbours"]


@dataclasses.dataclass(frozen=True)
class Figures:
    """The error figures that always stand together (DESIGN section 2).

    Attributes:
        one_step: predicted against measured displacements.
        floor: what the best possible model would still err.
        floor_kind: exact on a stand-in, else an estimate from nearest neighbours.
        model_error: predicted against exact mean displacements, on a stand-in.
        open_loop: over whole runs; None where no run can be predicted.
    """

    one_step: ErrorFigure
    floor: ErrorFigure
    floor_kind: FloorKind
    model_error: ErrorFigure | None
    open_loop: OpenLoopFigure | None

    def plain(self) -> dict[str, Any]:
        """Return the figures as plain data, as they stand in metrics.json."""
        loop = self.open_loop
        return {
            "transitions": self.one_step.transitions,
            "one_step": _plain(self.one_step),
            "floor": {"kind": self.floor_kind, **_plain(self.floor)},
            "model_error": _plain(self.model_error) if self.model_error else None,
            "open_loop": {"rmse_mm": {"mean": loop.rmse_mm, "sd": loop.rmse_sd_mm}, "runs": loop.runs}
            if loop
            else None,
        }

    def tracked(self) -> dict[str, float]:
        """Return the figures by name and unit, as MLflow keeps them."""
        named = {"one_step": self.one_step, "floor": self.floor, "model_error": self.model_error}
        by_name = {}
        for name, figure in named.items():
            if figure:
                by_name[f"{name}_position_mm"] = figure.position_mm
                by_name[f"{name}_orientation_deg"] = figure.orientation_deg
        if self.open_loop:
            by_name["open_loop_mm"] = self.open_loop.rmse_mm
        return by_name


@dataclasses.dataclass(frozen=True)
class Measurement:
    """One model on one recording.

    Attributes:
        overall: over all vehicles.
        vehicles: for each vehicle.
        held_out: whether only held-out runs of the model's own recording were used.
        runs: every run predicted open loop.
        transitions: those predicted.
        predicted: (N, 3) their predicted displacements.
    """

    overall: Figures
    vehicles: dict[str, Figures]
    held_out: bool
    runs: tuple[OpenLoop, ...]
    transitions: Transitions
    predicted: np.ndarray

    def metrics(self) -> dict[str, Any]:
        """Return the figures as plain data: those over all vehicles, and those of each."""
        by_vehicle = {vehicle: figures.plain() for vehicle, figures in self.vehicles.items()}
        return {**self.overall.plain(), "held_out_runs": self.held_out, "vehicles": by_vehicle}


def load_simulation(folder: Path, robot: Robot) -> tuple[Dynamics, Provenance]:
    """Load a dynamics model of `robot`.

    Raises:
        UserError: there is none, it is damaged, or of another robot.
    """
    dynamics = load_dynamics(folder)
    if dynamics.robot.name != robot.name:
        raise UserError(f"{folder} is a model of robot {dynamics.robot.name!r}: add robot={dynamics.robot.name}")
    if dynamics.robot.command_columns != robot.command_columns or dynamics.robot.period_s != robot.period_s:
        raise UserError(f"{folder} was trained for other commands or another period than conf/robot states: train anew")
    return dynamics, Provenance.read(folder)


def measure(dynamics: Dynamics, provenance: Provenance, recording: Recording, folder: Path) -> Measurement:
    """Measure a model on what it has not seen of a recording, which lies in `folder`.

    Raises:
        UserError: the model has seen everything, or no transition can be made.
    """
    unseen = provenance.unseen_part(recording)
    transitions, _ = from_recording(unseen)
    exact = _exact_means(dynamics, transitions, folder) if (folder / TRUTH_FILE).exists() else None
    runs = open_loop(dynamics, unseen.tracks)
    vehicles = {
        vehicle: _figures(
            dynamics, transitions, exact, transitions.vehicle == number, [r for r in runs if r.track.vehicle == vehicle]
        )
        for number, vehicle in enumerate(transitions.vehicles)
        if np.any(transitions.vehicle == number)
    }
    overall = _figures(dynamics, transitions, exact, np.full(len(transitions), True), runs)
    predicted = evaluation.predict(dynamics, transitions)
    return Measurement(overall, vehicles, unseen is not recording, tuple(runs), transitions, predicted)


def _figures(
    dynamics: Dynamics, transitions: Transitions, exact: np.ndarray | None, chosen: np.ndarray, runs: Sequence[OpenLoop]
) -> Figures:
    part = transitions.where(chosen)
    kind: FloorKind = "nearest_neighbours" if exact is None else "exact"
    predictable = any(np.isfinite(run.rmse_mm) for run in runs)
    return Figures(
        one_step=evaluation.one_step(dynamics, part),
        floor=evaluation.neighbour_floor(dynamics, part).error
        if exact is None
        else evaluation.floor(exact[chosen], part),
        floor_kind=kind,
        model_error=None if exact is None else evaluation.model_error(dynamics, part, exact[chosen]),
        open_loop=summary(runs) if predictable else None,
    )


def _plain(figure: ErrorFigure) -> dict[str, Any]:
    return {
        "position_mm": {"mean": figure.position_mm, "sd": figure.position_sd_mm},
        "orientation_deg": {"mean": figure.orientation_deg, "sd": figure.orientation_sd_deg},
    }


def _exact_means(dynamics: Dynamics, transitions: Transitions, folder: Path) -> np.ndarray:
    """Return (N, 3) the stand-in's mean displacements, given what the model is given."""
    known = "everything" if "previous_command" in dynamics.parts else "situation"
    columns = [f"{known}_{column}" for column in DISPLACEMENT_COLUMNS]
    truth = read_truth(folder)
    key = ["run", "vehicle", "time_s"]
    asked = pd.DataFrame(
        {
            "run": np.array(transitions.runs)[transitions.run],
            "vehicle": np.array(transitions.vehicles)[transitions.vehicle],
            "time_s": transitions.time_s.round(3),
        }
    )
    found = asked.merge(truth.assign(time_s=truth.time_s.round(3)), on=key, how="left", validate="one_to_one")
    means = found[columns].to_numpy(float)
    if np.isnan(means).any():
        raise UserError(f"{folder / TRUTH_FILE} does not belong to the runs beside it: record them again")
    return means
