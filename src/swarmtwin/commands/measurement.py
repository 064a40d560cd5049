"""A simulation model measured on a recording: one-step, floor, model error and open loop, for each vehicle."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd

from swarmtwin.dynamics import evaluation
from swarmtwin.dynamics.base import Dynamics
from swarmtwin.dynamics.evaluation import ErrorFigure
from swarmtwin.dynamics.open_loop import OpenLoop, open_loop
from swarmtwin.dynamics.provenance import Provenance
from swarmtwin.dynamics.store import load_dynamics
from swarmtwin.errors import UserError
from swarmtwin.recordings.recording import Recording
from swarmtwin.robot import DISPLACEMENT_COLUMNS, Robot, StrictModel
from swarmtwin.standin.truth import TRUTH_FILE, read_truth
from swarmtwin.transitions import Transitions, from_recording


class Spread(StrictModel):
    """Mean and standard deviation."""

    mean: float
    sd: float


class Errors(StrictModel):
    """Position errors in mm and orientation errors in degrees, over transitions (DESIGN section 2)."""

    position_mm: Spread
    orientation_deg: Spread

    @classmethod
    def of(cls, figure: ErrorFigure) -> "Errors":
        """Take over a figure."""
        return cls(
            position_mm=Spread(mean=figure.position_mm, sd=figure.position_sd_mm),
            orientation_deg=Spread(mean=figure.orientation_deg, sd=figure.orientation_sd_deg),
        )


class Floor(Errors):
    """What the best possible model would still err: exact on a stand-in, else estimated from nearest neighbours."""

    kind: Literal["exact", "nearest_neighbours"]


class OpenLoopErrors(Spread):
    """Root mean square errors in mm, over whole runs."""

    runs: int


class Figures(StrictModel):
    """The three error figures that always stand together, and on a stand-in the model error."""

    transitions: int
    one_step: Errors
    floor: Floor
    model_error: Errors | None
    open_loop_mm: OpenLoopErrors | None


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

    def metrics(self) -> dict[str, object]:
        """Return the figures as plain data: those over all vehicles, and those of each."""
        by_vehicle = {vehicle: figures.model_dump(mode="json") for vehicle, figures in self.vehicles.items()}
        return {**self.overall.model_dump(mode="json"), "held_out_runs": self.held_out, "vehicles": by_vehicle}


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
    if exact is None:
        floor_figure, kind = evaluation.neighbour_floor(dynamics, part).error, "nearest_neighbours"
        model_error = None
    else:
        floor_figure, kind = evaluation.floor(exact[chosen], part), "exact"
        model_error = Errors.of(evaluation.model_error(dynamics, part, exact[chosen]))
    rmse_mm = np.array([run.rmse_mm for run in runs if np.isfinite(run.rmse_mm)])
    return Figures(
        transitions=len(part),
        one_step=Errors.of(evaluation.one_step(dynamics, part)),
        floor=Floor(kind=kind, **Errors.of(floor_figure).model_dump()),
        model_error=model_error,
        open_loop_mm=OpenLoopErrors(mean=rmse_mm.mean(), sd=rmse_mm.std(), runs=len(rmse_mm)) if len(rmse_mm) else None,
    )


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
