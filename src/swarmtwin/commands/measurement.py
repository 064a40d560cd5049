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
from swarmtwin.errors import UserError
from swarmtwin.gap.store import load_dynamics
from swarmtwin.recordings.recording import Recording, Track
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


@dataclasses.dataclass(frozen=True)
class Measured:
    """A recording to measure models on.

    Attributes:
        recording: its runs.
        transitions: all that can be made of them.
        truth: on a stand-in, (N, 6) the exact mean displacements given the situation, and given everything; else None.
    """

    recording: Recording
    transitions: Transitions
    truth: pd.DataFrame | None

    @classmethod
    def of(cls, recording: Recording, folder: Path) -> "Measured":
        """Take a recording, which lies in `folder`, with its answer book if it has one.

        Raises:
            UserError: no transition can be made, or the answer book belongs to other runs.
        """
        transitions, _ = from_recording(recording)
        truth = _exact_means(transitions, folder) if (folder / TRUTH_FILE).exists() else None
        return cls(recording, transitions, truth)

    def exact_means(self, dynamics: Dynamics) -> np.ndarray | None:
        """Return (N, 3) the stand-in's mean displacements, given what the model is given; None on a real robot."""
        if self.truth is None:
            return None
        known = "everything" if "previous_command" in dynamics.parts else "situation"
        return self.truth[[f"{known}_{column}" for column in DISPLACEMENT_COLUMNS]].to_numpy(float)


def measure(dynamics: Dynamics, provenance: Provenance, measured: Measured) -> Measurement:
    """Measure a model on what it has not seen of a recording.

    Raises:
        UserError: the model has seen everything.
    """
    unseen = provenance.unseen_part(measured.recording)
    transitions, exact = measured.transitions, measured.exact_means(dynamics)
    runs = open_loop(dynamics, [_believable(track, transitions) for track in unseen.tracks])
    scored = _of_tracks(transitions, unseen)
    if not scored.any():
        raise UserError(f"recording {provenance.recording!r}: its held-out runs hold no usable transition: record more")
    floors = _floors(dynamics, transitions, exact, scored)
    vehicles = {}
    for number, vehicle in enumerate(transitions.vehicles):
        own = scored & (transitions.vehicle == number)
        if own.any():
            own_runs = [run for run in runs if run.track.vehicle == vehicle]
            vehicles[vehicle] = _figures(dynamics, transitions, exact, own, floors[vehicle], own_runs)
    floor = ErrorFigure.pooled(list(floors.values()))
    overall = _figures(dynamics, transitions, exact, scored, floor, runs)
    part = transitions.where(scored)
    return Measurement(
        overall, vehicles, unseen is not measured.recording, tuple(runs), part, evaluation.predict(dynamics, part)
    )


def _believable(track: Track, transitions: Transitions) -> Track:
    """Return a track without the poses that no transition was made of: misread or swapped markers."""
    own = (transitions.run == transitions.runs.index(track.run)) & (
        transitions.vehicle == transitions.vehicles.index(track.vehicle)
    )
    start = np.searchsorted(track.time_s, transitions.time_s[own])
    believed = np.zeros(len(track), dtype=bool)
    believed[start] = believed[start + 1] = True
    return dataclasses.replace(track, pose=np.where(believed[:, None], track.pose, np.nan))


def _of_tracks(transitions: Transitions, recording: Recording) -> np.ndarray:
    """Return (N,) which transitions lie on a track of `recording`."""
    chosen = np.zeros((len(transitions.runs), len(transitions.vehicles)), dtype=bool)
    for track in recording.tracks:
        chosen[transitions.runs.index(track.run), transitions.vehicles.index(track.vehicle)] = True
    return chosen[transitions.run, transitions.vehicle]


def _floors(
    dynamics: Dynamics, transitions: Transitions, exact: np.ndarray | None, scored: np.ndarray
) -> dict[str, ErrorFigure]:
    """Return the floor of each vehicle: exact, or estimated from all of its transitions, each on those scored."""
    floors = {}
    for number, vehicle in enumerate(transitions.vehicles):
        own = transitions.vehicle == number
        if not (own & scored).any():
            continue
        if exact is None:
            floors[vehicle] = evaluation.neighbour_floor(dynamics, transitions.where(own), scored[own]).error
        else:
            floors[vehicle] = evaluation.floor(exact[own & scored], transitions.where(own & scored))
    return floors


def _figures(
    dynamics: Dynamics,
    transitions: Transitions,
    exact: np.ndarray | None,
    chosen: np.ndarray,
    floor: ErrorFigure,
    runs: Sequence[OpenLoop],
) -> Figures:
    part = transitions.where(chosen)
    predictable = any(np.isfinite(run.rmse_mm) for run in runs)
    return Figures(
        one_step=evaluation.one_step(dynamics, part),
        floor=floor,
        floor_kind="nearest_neighbours" if exact is None else "exact",
        model_error=None if exact is None else evaluation.model_error(dynamics, part, exact[chosen]),
        open_loop=summary(runs) if predictable else None,
    )


def _plain(figure: ErrorFigure) -> dict[str, Any]:
    return {
        "position_mm": {"mean": figure.position_mm, "sd": figure.position_sd_mm},
        "orientation_deg": {"mean": figure.orientation_deg, "sd": figure.orientation_sd_deg},
    }


def _exact_means(transitions: Transitions, folder: Path) -> pd.DataFrame:
    """Return the answer book's row for each transition."""
    truth = read_truth(folder)
    asked = pd.DataFrame(
        {
            "run": np.array(transitions.runs)[transitions.run],
            "vehicle": np.array(transitions.vehicles)[transitions.vehicle],
            "time_s": transitions.time_s.round(3),
        }
    )
    found = asked.merge(truth.assign(time_s=truth.time_s.round(3)), how="left", on=list(asked), validate="one_to_one")
    if found.isna().any(axis=None):
        raise UserError(f"{folder / TRUTH_FILE} does not belong to the runs beside it: record them again")
    return found
