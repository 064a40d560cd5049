"""A simulation measured on a recording: one-step, floors, model error and open loop, for each vehicle."""

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from swarmtwin.dynamics.evaluation import ErrorFigure
from swarmtwin.dynamics.predictor import NetworkDynamics
from swarmtwin.dynamics.provenance import Provenance
from swarmtwin.dynamics.spread import Mixture, SpreadFigure
from swarmtwin.errors import UserError
from swarmtwin.learning.situation import Situation
from swarmtwin.recordings.blocks import run_of
from swarmtwin.recordings.exact_means import EXACT_MEANS_FILE, has_exact_means, read_exact_means
from swarmtwin.recordings.recording import Recording, Track
from swarmtwin.robot import Robot, SituationPart
from swarmtwin.simulation import simulation_folder
from swarmtwin.simulation.best_prediction import BestPrediction, FloorKind, best_prediction, neighbour_estimate
from swarmtwin.simulation.estimated_floor import EstimatedFloor, estimated_floor
from swarmtwin.simulation.open_loop import OpenLoop, OpenLoopFigure, open_loop, summary
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.transitions import Transitions, from_recording


@dataclasses.dataclass(frozen=True)
class Floor:
    """What the best possible model would still err, given some inputs.

    Attributes:
        kind: whether the best model is known or estimated, and how.
        given: what it looks at.
        error: its error.
        estimate: on a real robot, the same with its interval; None on a stand-in.
    """

    kind: FloorKind
    given: tuple[SituationPart, ...]
    error: ErrorFigure
    estimate: EstimatedFloor | None = None

    def plain(self) -> dict[str, Any]:
        """Return the floor as plain data."""
        figures = _plain(self.error)
        if self.estimate:
            for name in ("position_mm", "orientation_deg"):
                figures[name] |= dict(zip(("low", "high"), getattr(self.estimate, name), strict=True))
        return {"kind": self.kind, "given": list(self.given), **figures}


@dataclasses.dataclass(frozen=True)
class Figures:
    """The error figures that always stand together.

    Attributes:
        one_step: predicted against measured displacements.
        best: what the best model with the same inputs would still err.
        floors: the same by what is known: `situation`, as the robot's models are given it, and `history`, the commands
            of the two periods before as well; none where there are too few data to estimate them from.
        model_error: predicted against exact mean displacements on a stand-in, given the robot's situation, and the
            commands before where the model looks at them.
        open_loop: over whole runs; None where no run can be predicted.
        spread: how well the spread is that which was measured, of a model that states one itself.
    """

    one_step: ErrorFigure
    best: Floor
    floors: Mapping[str, Floor]
    model_error: ErrorFigure | None
    open_loop: OpenLoopFigure | None
    spread: SpreadFigure | None = None

    @property
    def floor(self) -> ErrorFigure:
        """What the best model with the same inputs would still err."""
        return self.best.error

    @property
    def floor_kind(self) -> FloorKind:
        """Whether that is known or estimated, and how."""
        return self.best.kind

    def plain(self) -> dict[str, Any]:
        """Return the figures as plain data, as they stand in metrics.json."""
        loop = self.open_loop
        return {
            "transitions": self.one_step.transitions,
            "one_step": _plain(self.one_step),
            "floor": self.best.plain(),
            "floors": {known: floor.plain() for known, floor in self.floors.items()},
            "model_error": _plain(self.model_error) if self.model_error else None,
            "open_loop": {"rmse_mm": {"mean": loop.rmse_mm, "sd": loop.rmse_sd_mm}, "runs": loop.runs}
            if loop
            else None,
            **({"spread": {"coverage": self.spread.coverage, **self.spread.named()}} if self.spread else {}),
        }

    def tracked(self) -> dict[str, float]:
        """Return the figures by name and unit, as MLflow keeps them."""
        named = {"one_step": self.one_step, "floor": self.floor, "model_error": self.model_error}
        named |= {f"floor_{known}": floor.error for known, floor in self.floors.items()}
        by_name = {}
        for name, figure in named.items():
            if figure:
                by_name[f"{name}_position_mm"] = figure.position_mm
                by_name[f"{name}_orientation_deg"] = figure.orientation_deg
        if self.open_loop:
            by_name["open_loop_mm"] = self.open_loop.rmse_mm
        if self.spread:
            by_name |= {f"spread_{name}": figure for name, figure in self.spread.named().items()}
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


def load_simulation(folder: Path, robot: Robot) -> tuple[Simulation, Provenance]:
    """Load a simulation of `robot`, and where it comes from.

    Raises:
        UserError: there is none, it is damaged, or of another robot.
    """
    simulation = simulation_folder.load_simulation(folder)
    if simulation.robot.name != robot.name:
        raise UserError(f"{folder} is a model of robot {simulation.robot.name!r}: add robot={simulation.robot.name}")
    same = simulation.robot.command_columns == robot.command_columns and simulation.robot.period_s == robot.period_s
    if not same:
        raise UserError(f"{folder} was trained for other commands or another period than conf/robot states: train anew")
    return simulation, Provenance.read(folder)


@dataclasses.dataclass(frozen=True)
class Measured:
    """A recording to measure models on.

    Attributes:
        recording: its runs.
        transitions: all that can be made of them.
        exact: on a stand-in, the exact means of each transition, as `read_exact_means` gives them; else None.
        best: what the best models would predict, given the situation and given the history.
    """

    recording: Recording
    transitions: Transitions
    exact: pd.DataFrame | None
    best: Mapping[str, BestPrediction]

    @classmethod
    def of(cls, recording: Recording, folder: Path) -> "Measured":
        """Take a recording, which lies in `folder`, with its exact means if it has them.

        Raises:
            UserError: no transition can be made, or the exact means belong to other runs.
        """
        transitions, _ = from_recording(recording)
        exact = _exact_means(transitions, folder) if has_exact_means(folder) else None
        situation = recording.robot.situation
        history = dict.fromkeys((*situation, "previous_command", "earlier_command"))
        known: dict[str, tuple[SituationPart, ...]] = {"situation": situation, "history": tuple(history)}
        best = {}
        for name, given in known.items():
            with contextlib.suppress(UserError):
                best[name] = best_prediction(transitions, given, exact)
        return cls(recording, transitions, exact, best)

    def best_for(self, given: Sequence[SituationPart], scored: np.ndarray) -> BestPrediction:
        """Return what the best model with these inputs would predict of the transitions `scored` (N,).

        Raises:
            UserError: there are too few transitions to estimate it from.
        """
        if self.exact is None:
            return neighbour_estimate(self.transitions, given, scored)
        known = next((best for best in self.best.values() if set(best.given) == set(given)), None)
        return known or best_prediction(self.transitions, given, self.exact)

    def mean_for(self, given: Sequence[SituationPart], best: BestPrediction) -> BestPrediction | None:
        """Return the exact mean that a model with these inputs is measured against; None on a real robot.

        That of the robot's situation, so that models which look at less of it are compared with the same; `best`, given
        the model's own inputs, for one that looks at the commands before as well.
        """
        if not best.is_exact_mean:
            return None
        looks_at_less = set(given) < set(self.recording.robot.situation)
        return self.best.get("situation", best) if looks_at_less else best


def measure(simulation: Simulation, provenance: Provenance, measured: Measured) -> Measurement:
    """Measure a simulation on what its dynamics model has not seen of a recording.

    Raises:
        UserError: the model has seen everything, or there are too few transitions to estimate a floor from.
    """
    unseen = provenance.unseen_part(measured.recording)
    transitions = measured.transitions
    runs = open_loop(simulation, [_believable(track, transitions) for track in unseen.tracks])
    scored = _of_tracks(transitions, unseen)
    if not scored.any():
        raise UserError(f"recording {provenance.recording!r}: its held-out runs hold no usable transition: record more")
    best = measured.best_for(simulation.inputs, scored)
    mean = measured.mean_for(simulation.inputs, best)
    predicted = np.full_like(transitions.displacement, np.nan)
    predicted[scored] = _predict(simulation, transitions.where(scored))

    def figures(chosen: np.ndarray, own_runs: Sequence[OpenLoop]) -> Figures:
        displacement = transitions.displacement[chosen]

        def floor(of: BestPrediction) -> Floor:
            mean = of.mean[chosen]
            if of.is_exact_mean:
                return Floor(of.kind, of.given, ErrorFigure.between(mean, displacement))
            models = [mean, *([predicted[chosen]] if set(simulation.inputs) <= set(of.given) else [])]
            estimate = estimated_floor(transitions.where(chosen), of.given, models)
            return Floor(of.kind, of.given, estimate.error, estimate)

        return Figures(
            one_step=ErrorFigure.between(predicted[chosen], displacement),
            best=floor(best),
            floors={name: floor(known) for name, known in measured.best.items()},
            model_error=ErrorFigure.between(predicted[chosen], mean.mean[chosen]) if mean else None,
            open_loop=summary(own_runs) if any(np.isfinite(run.rmse_mm) for run in own_runs) else None,
            spread=_spread(simulation, transitions.where(chosen)),
        )

    vehicles = {}
    for number, vehicle in enumerate(transitions.vehicles):
        own = scored & (transitions.vehicle == number)
        if own.any():
            vehicles[vehicle] = figures(own, [run for run in runs if run.track.vehicle == vehicle])
    return Measurement(
        overall=figures(scored, runs),
        vehicles=vehicles,
        held_out=unseen is not measured.recording,
        runs=tuple(runs),
        transitions=transitions.where(scored),
        predicted=predicted[scored],
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


def _spread(simulation: Simulation, transitions: Transitions) -> SpreadFigure | None:
    """Compare the spread that a bare probabilistic model states with what was measured; None of any other."""
    dynamics = simulation.dynamics
    if simulation.is_extended or not isinstance(dynamics, NetworkDynamics) or not dynamics.drawn_members:
        return None
    return SpreadFigure.of(Mixture.of(dynamics, transitions))


def _predict(simulation: Simulation, transitions: Transitions) -> np.ndarray:
    """Predict the displacements (N, 3) of measured situations."""
    return simulation.predict(Situation.from_transitions(transitions, simulation.inputs)).numpy().astype(float)


def _plain(figure: ErrorFigure) -> dict[str, Any]:
    return {
        "position_mm": {"mean": figure.position_mm, "sd": figure.position_sd_mm},
        "orientation_deg": {"mean": figure.orientation_deg, "sd": figure.orientation_sd_deg},
    }


def _exact_means(transitions: Transitions, folder: Path) -> pd.DataFrame:
    """Return the exact means of each transition."""
    stored = read_exact_means(folder)
    asked = pd.DataFrame(
        {
            "run": np.array([run_of(name) for name in transitions.runs])[transitions.run],
            "vehicle": np.array(transitions.vehicles)[transitions.vehicle],
            "time_s": transitions.time_s.round(3),
        }
    )
    found = asked.merge(stored.assign(time_s=stored.time_s.round(3)), how="left", on=list(asked), validate="one_to_one")
    if found.isna().any(axis=None):
        raise UserError(f"{folder / EXACT_MEANS_FILE} does not belong to the runs beside it: record them again")
    return found
