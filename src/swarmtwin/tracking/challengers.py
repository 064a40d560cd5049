"""Challengers among dynamics models: their errors on held-out runs, kept in MLflow, decide who is one.

What was measured of a version stays with the run that made it, one figure a held-out run, so that whatever comes later
is compared pair by pair without loading the model.
"""

import mlflow
import numpy as np

from swarmtwin.errors import UserError
from swarmtwin.tracking import registry
from swarmtwin.tracking.gate import Errors, judge_dynamics
from swarmtwin.tracking.runs import TrackedRun
from swarmtwin.tracking.store import store_errors, use_store

HELD_OUT = "held_out.digest"
FIGURES = {figure: f"held_out_{figure}" for figure in ("position_mm", "orientation_deg", "transitions")}


def challenge_by_errors(tracked: TrackedRun, version: registry.Version, errors: Errors, held_out: str) -> str:
    """Make a dynamics model the challenger if it is measurably better; return what was done, as a sentence.

    It is compared with a challenger that was measured on the same transitions. In place of one that was not, it becomes
    the challenger, and the sentence says so.

    Args:
        tracked: the run that made it, where its errors are kept.
        version: as it was registered.
        errors: of the model, on transitions that it was not fitted to, and that are not of a test split.
        held_out: identifies these transitions.
    """
    tracked.tag(HELD_OUT, held_out)
    by_run = zip(*(getattr(errors, figure) for figure in FIGURES), strict=True)
    tracked.history(
        (run, dict(zip(FIGURES.values(), map(float, values), strict=True))) for run, values in enumerate(by_run)
    )

    def compare(challenger: registry.Version) -> tuple[bool, str]:
        known = _errors_of(challenger, held_out)
        if known is None:
            return True, "not compared, since the two were not measured on the same held-out runs"
        try:
            verdict = judge_dynamics(errors, known)
        except UserError as error:
            return True, f"not compared ({error})"
        return verdict.passed, f"{verdict} on the same held-out runs"

    return registry.challenge(version, compare)


@store_errors()
def _errors_of(version: registry.Version, held_out: str) -> Errors | None:
    """Return what was measured of a version on certain transitions; None where nothing was."""
    use_store()
    found = mlflow.search_runs(
        search_all_experiments=True,
        filter_string=f"attributes.run_id = '{version.run_id}' and tags.`{HELD_OUT}` = '{held_out}'",
        output_format="list",
    )
    if not found:
        return None
    client = mlflow.MlflowClient()
    histories = (client.get_metric_history(found[0].info.run_id, key) for key in FIGURES.values())
    by_run = (sorted(history, key=lambda metric: metric.step) for history in histories)
    return Errors(*(np.array([metric.value for metric in history]) for history in by_run))
