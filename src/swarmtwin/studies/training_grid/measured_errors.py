"""How a trained model measures on a recording: its errors run by run, which intervals are made of, and in all."""

import numpy as np
import pandas as pd

from swarmtwin.geometry import orientation_error_rad, position_error_mm
from swarmtwin.robot import StrictModel
from swarmtwin.simulation.evaluation import Measurement
from swarmtwin.simulation.open_loop import OpenLoop
from swarmtwin.studies.training_grid.table_file import Quantity


class RunErrors(StrictModel):
    """Mean errors of R runs, all vehicles of a run together.

    Attributes:
        runs: their names.
        transitions: how many each has.
        position_mm: mean distance between predicted and measured displacement, of each run.
        orientation_deg: mean absolute wrapped difference.
        open_loop_mm: root mean square distance along the whole run, predicted from its first pose and its commands;
            None where it cannot be predicted.
    """

    runs: tuple[str, ...]
    transitions: tuple[int, ...]
    position_mm: tuple[float, ...]
    orientation_deg: tuple[float, ...]
    open_loop_mm: tuple[float | None, ...]

    def values(self, quantity: Quantity) -> np.ndarray:
        """Return (R,) errors, NaN where there is none."""
        return np.array([np.nan if value is None else value for value in getattr(self, quantity)])

    def weights(self, quantity: Quantity) -> np.ndarray:
        """Return (R,) by what runs weigh in a mean: transitions for one-step errors, a whole run counts once."""
        if quantity == "open_loop_mm":
            return np.isfinite(self.values(quantity)).astype(float)
        return np.array(self.transitions, dtype=float)


class MeasuredErrors(StrictModel):
    """One trained model on one recording.

    Attributes:
        figures: over all transitions by name and unit, with standard deviations over transitions (`_sd`): one-step and
            open loop; on a stand-in also the distance to its exact mean displacement, the model error.
        floors: what the best possible model would still err, by what it is given: `command`, that is the robot's
            situation, and `history`, the commands before as well.
        floor_kinds: whether these are known or estimated, and how.
        by_run: the errors of each run.
    """

    figures: dict[str, float]
    floors: dict[str, dict[str, float]]
    floor_kinds: dict[str, str]
    by_run: RunErrors

    @classmethod
    def of(cls, measurement: Measurement) -> "MeasuredErrors":
        """Sum a measurement up."""
        overall = measurement.overall
        figures = overall.one_step._asdict()
        if overall.model_error:
            figures |= {f"model_error_{name}": value for name, value in overall.model_error._asdict().items()}
        if overall.open_loop:
            figures |= {"open_loop_mm": overall.open_loop.rmse_mm, "open_loop_sd_mm": overall.open_loop.rmse_sd_mm}
        figures.pop("model_error_transitions", None)
        named = {"situation": "command", "history": "history"}
        floors = {named[known]: floor for known, floor in overall.floors.items()}
        return cls(
            figures={name: float(value) for name, value in figures.items()},
            floors={
                known: {"position_mm": floor.error.position_mm, "orientation_deg": floor.error.orientation_deg}
                for known, floor in floors.items()
            },
            floor_kinds={known: floor.kind for known, floor in floors.items()},
            by_run=_by_run(measurement),
        )


def _by_run(measurement: Measurement) -> RunErrors:
    transitions, predicted = measurement.transitions, measurement.predicted
    errors = pd.DataFrame(
        {
            "run": np.array(transitions.runs)[transitions.run],
            "position_mm": position_error_mm(predicted, transitions.displacement),
            "orientation_deg": np.degrees(orientation_error_rad(predicted, transitions.displacement)),
        }
    )
    means = errors.groupby("run", sort=True).mean()
    counts = errors.groupby("run", sort=True).size()
    loops = _open_loop_by_run(measurement.runs)
    return RunErrors(
        runs=tuple(str(run) for run in means.index),
        transitions=tuple(int(count) for count in counts),
        position_mm=tuple(float(value) for value in means.position_mm),
        orientation_deg=tuple(float(value) for value in means.orientation_deg),
        open_loop_mm=tuple(loops.get(str(run)) for run in means.index),
    )


def _open_loop_by_run(runs: tuple[OpenLoop, ...]) -> dict[str, float]:
    """Return the mean over a run's vehicles, of the runs that can be predicted."""
    found: dict[str, list[float]] = {}
    for one in runs:
        if np.isfinite(one.rmse_mm):
            found.setdefault(one.track.run, []).append(one.rmse_mm)
    return {run: float(np.mean(errors)) for run, errors in found.items()}
