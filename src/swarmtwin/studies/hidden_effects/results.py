"""What came of each case: a line in a file that an interrupted study continues, and the tables made of all of them."""

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from pydantic import Field

from swarmtwin.diagnosis.result import Cause, Estimate, Verdict
from swarmtwin.diagnosis.settings import VerdictSettings
from swarmtwin.geometry import wrap_angle
from swarmtwin.robot import StrictModel
from swarmtwin.studies.hidden_effects.cases import Case
from swarmtwin.studies.hidden_effects.held_out_gain import HeldOutGain

THRUST_ROBOTS = ("mur",)
"""Robots of the study whose actuators thrust."""

WEAKENED: Mapping[str, Mapping[tuple[str, str], str]] = {
    "battery_sag": {
        **{("formulas", "mgr"): "speed", ("unruly", "mgr"): "speed"},
        **{("rigid_body", "mgr"): "effort", ("rigid_body", "mur"): "effort"},
    },
    "gain_change": {
        **{("formulas", "mgr"): "speed", ("unruly", "mgr"): "speed"},
        **{("rigid_body", "mgr"): "speed", ("rigid_body", "mur"): "effort"},
    },
    "surface_patch": {("rigid_body", "mur"): "vehicle"},
    "wall_effect": {("rigid_body", "mur"): "vehicle"},
}
"""What stand-ins weaken, by cause, family and robot: speeds, or efforts, a motor's voltage or a stroke's size.

The fin of the formulas has less thrust, which is neither; weeds and walls slow the rigid body's swimmer as a whole.
"""


class Baselines(StrictModel):
    """What other methods made of the same case.

    Attributes:
        fitted: causes that parameter fitting without model choice holds for proven, the surest first.
        rule: the cause that the largest correlation suggests.
        black_box: what a black-box residual gained.
    """

    fitted: tuple[str, ...]
    rule: str | None
    black_box: HeldOutGain


class TrueModelAnswer(StrictModel):
    """What is made of the same case with the true model in hand.

    Attributes:
        method: `oracle`, the true likelihood of all that may hide; on the rigid body, whose likelihood nobody knows,
            `mujoco.sysid`, with the true model and all its parameters free.
        causes: that it names, with their parameters.
        seconds: that it took.
        failure: why it failed; null where it did not.
    """

    method: Literal["oracle", "mujoco.sysid"]
    causes: dict[str, dict[str, float]] = Field(default_factory=dict)
    seconds: float
    failure: str | None = None


class Result(StrictModel):
    """What came of a case.

    Attributes:
        case: what was asked for.
        effects: what was hidden, as `record` takes it: names and parameters.
        true_causes: the causes that should be named, with what their parameters should be said to be by who names what
            is named here (see `sessions.Truth`).
        rise_percent: by how much that raised a simulation's one-step error: see `sessions.Truth`.
        same_vehicle: whether the vehicle was the reference's.
        transitions: how many were measured.
        verdict: of the diagnosis; null where it failed.
        failure: why it failed.
        causes: in the order named.
        likeliest: the causes that are the likeliest together, whether or not they were named.
        depends_on: what the residual depended on.
        gained: by the extended simulation.
        times_limit: size of a hidden effect over the size from which on the session would have named it with 90 %, as
            its diagnosis says, beside the other causes that it found; 0 where it says that no size would. Of several
            the smallest. Null where it says nothing of one of them, or in another unit.
        baselines: null where they were left out.
        true_model: what is made of it with the true model in hand; null where that was left out.
        seconds: that the diagnosis took, given the reference.
        learning_seconds: that the reference took to learn.
        memory_mb: the most memory that the process had while it learned the reference and diagnosed. All three are null
            where the diagnosis failed.
    """

    case: Case
    effects: tuple[dict[str, Any], ...] = ()
    true_causes: dict[str, dict[str, float]] = Field(default_factory=dict)
    rise_percent: float
    same_vehicle: bool = True
    transitions: int
    verdict: Verdict | None = None
    failure: str | None = None
    causes: tuple[Cause, ...] = ()
    likeliest: tuple[str, ...] = ()
    depends_on: tuple[str, ...] = ()
    gained: HeldOutGain | None = None
    times_limit: float | None = None
    baselines: Baselines | None = None
    true_model: TrueModelAnswer | None = None
    seconds: float | None = None
    learning_seconds: float | None = None
    memory_mb: float | None = None


UNITS_DIFFER: dict[str, tuple[str, ...]] = {"unruly": ("marker_offset",)}
"""Causes by which units of a family differ of themselves: each unruly one has its marker glued on elsewhere."""


def _of_the_unit(result: Result) -> tuple[str, ...]:
    """Return the causes by which the vehicle differs of itself from the one that was learned from."""
    return () if result.same_vehicle else UNITS_DIFFER.get(result.case.family, ())


def _counted(result: Result, names: Sequence[str]) -> tuple[str, ...]:
    """Return the names less those of causes that are there though nobody hid them."""
    return tuple(name for name in names if name in result.case.true_names or name not in _of_the_unit(result))


def results_table(results: Sequence[Result]) -> pd.DataFrame:
    """Return one row a case: what was hidden, what the diagnosis and the other methods made of it.

    Causes by which another unit differs of itself are there, though nobody hid them: they count neither for nor against
    who names them (see `UNITS_DIFFER`).

    Columns:
        found: the diagnosis said that something is wrong, beyond what another unit is itself.
        named_first: the first cause named is a true one.
        listed: every true cause is named, or a rival of one that is.
        times_limit: see `Result`.
        exact: the causes named are the true ones, all of them and no other.
        not_told: the true causes that are not named.
        falsely_named: a cause is named that is not there.
        explained_share: how much the causes named explain of what can be explained; 1 where only the motion's
            randomness is named, NaN where nothing is.
        likeliest: the causes that are the likeliest together; likeliest_true: they are the true ones and no others.
        fitting_first, fitting_exact, rule_first, rule_exact: likewise of the other methods.
        true_model, true_model_first, true_model_exact, true_model_seconds: likewise of what has the true model, which
            is said in `true_model_method`.
    """
    return pd.DataFrame([_row(result) for result in results])


def _row(result: Result) -> dict[str, Any]:
    case, others, true = result.case, result.baselines, result.case.true_names
    named = _counted(result, [cause.name for cause in result.causes])
    accounted_for = result.verdict == "explained" and case.kind == "clean" and not named
    rivals = tuple(rival for cause in result.causes for rival in cause.rivals)
    fitted = _counted(result, others.fitted) if others else ()
    rule = _counted(result, (others.rule,)) if others and others.rule else ()
    black_box = others.black_box if others else None
    return {
        "family": case.family,
        "kind": case.kind,
        "about": case.about,
        "robot": case.robot,
        "rise_percent": result.rise_percent,
        "verdict": result.verdict or "failed",
        "named": "+".join(named),
        "rivals": "+".join(rivals),
        "found": result.verdict in ("explained", "unexplained") and not accounted_for,
        "named_first": bool(set(named[:1]) & set(true)),
        "listed": bool(true) and set(true) <= {*named, *rivals},
        "exact": result.verdict is not None and sorted(named) == sorted(true),
        "not_told": "+".join(name for name in true if name not in named),
        "falsely_named": bool(set(named) - set(true)),
        "explained_share": sum(cause.share_of_gap for cause in result.causes) or (1.0 if named else math.nan),
        "likeliest": "+".join(result.likeliest),
        "likeliest_true": bool(true) and sorted(_counted(result, result.likeliest)) == sorted(true),
        "depends_on": "+".join(result.depends_on),
        **{name: getattr(result.gained, name, None) for name in HeldOutGain.model_fields},
        "times_limit": result.times_limit,
        "with_baselines": others is not None,
        "fitting": "+".join(fitted),
        "fitting_first": bool(set(fitted[:1]) & set(true)),
        "fitting_exact": sorted(fitted) == sorted(true),
        "rule": "+".join(rule),
        "rule_first": bool(set(rule) & set(true)),
        "rule_exact": rule == true,
        **{f"black_box_{name}": getattr(black_box, name, None) for name in ("after_mm", "share", "share_to_floor")},
        **_row_of_true_model(result),
        "same_vehicle": result.same_vehicle,
        "transitions": result.transitions,
        "effects": json.dumps(result.effects),
        "seed": case.seed,
        "seconds": result.seconds,
        "learning_seconds": result.learning_seconds,
        "memory_mb": result.memory_mb,
        "failure": result.failure,
    }


def _row_of_true_model(result: Result) -> dict[str, Any]:
    answer = result.true_model
    if answer is None:
        return {"true_model_method": ""}
    named, true = _counted(result, tuple(answer.causes)), result.case.true_names
    return {
        "true_model_method": answer.method,
        "true_model": "+".join(named),
        "true_model_first": bool(set(named[:1]) & set(true)),
        "true_model_exact": answer.failure is None and sorted(named) == sorted(true),
        "true_model_parameters": json.dumps(answer.causes),
        "true_model_seconds": answer.seconds,
        "true_model_failure": answer.failure,
    }


def is_another_unit(family: str, robot: str, cause: str, parameter: str, told_of: str = "") -> bool:
    """Return whether a parameter of a cause is told in another unit than it is hidden in: see `parameters_table`.

    `told_of` is what a cause of several forms was found to act on, such as speed or effort; empty where nobody said.
    """
    if parameter in ("gain", "loss", "shape"):
        hidden_in = WEAKENED.get(cause, {}).get((family, robot))
        return told_of != hidden_in if hidden_in and told_of else robot in THRUST_ROBOTS
    if parameter == "factor":
        return robot in THRUST_ROBOTS
    return family == "rigid_body" and parameter == "ratio"


def parameters_table(results: Sequence[Result]) -> pd.DataFrame:
    """Return one row a parameter of a cause that was named and true, with its error in several measures.

    `error` is in the parameter's unit; `error_percent` is of how far the true value is from doing nothing, a factor
    from 1, both parts of an offset together, a limit from nothing; NaN for places and directions, which have no such
    size; `covered` says whether the 95 % interval holds the true value; `same_unit` whether what is said and what is
    hidden are the same quantity at all. They are not where a share of the speed is told and the stand-in hides one of
    what actuators are given, or of a fin's thrust, or the other way round: only its physics tell the one of the other.
    Nor are they where the eddies about a fin are stronger, beside which its strokes make motion random as before, nor
    where one motor of the rigid body has less voltage, of which its bearings' friction takes as much as before: a
    diagnosis says how random the motion is, and how fast a wheel turns.
    """
    table = _with_errors([row for result in results for row in _parameters(result)], list(Estimate.model_fields))
    table["covered"] = table.true.between(table.low, table.high)
    return table


def true_model_parameters_table(results: Sequence[Result]) -> pd.DataFrame:
    """Return likewise one row a parameter that was found with the true model in hand; there are no intervals."""
    rows = [
        row
        for result in results
        if result.true_model
        for name, parameters in result.true_model.causes.items()
        for row in _beside_truth(result, name, {key: {"value": one} for key, one in parameters.items()})
    ]
    return _with_errors(rows, ["value"])


def _with_errors(rows: list[dict[str, Any]], said: list[str]) -> pd.DataFrame:
    """Return a table of parameters with their errors in several measures."""
    table = pd.DataFrame(
        rows, columns=["family", "robot", "kind", "seed", "cause", "told_of", "name", "true", "size", *said]
    )
    size = table["size"].astype(float)
    table["error"] = (table.value - table.true.astype(float)).abs()
    table["error_percent"] = 100 * (table.error / size).where(size > 0)
    about = zip(table.family, table.robot, table.cause, table["name"], table.told_of, strict=True)
    table["same_unit"] = np.array([not is_another_unit(*one) for one in about], bool)
    return table


def _parameters(result: Result) -> Iterator[dict[str, Any]]:
    """Return what is said of the parameters of the causes that are true, beside what they are."""
    for cause in result.causes:
        said = {name: estimate.model_dump() for name, estimate in cause.parameters.items()}
        yield from _beside_truth(result, cause.name, said, cause.form.get("acts_on") or cause.form.get("slows", ""))


def _beside_truth(
    result: Result, cause: str, said: Mapping[str, dict[str, Any]], told_of: str = ""
) -> Iterator[dict[str, Any]]:
    """Return what is said of each parameter of a cause, its `value` among it, beside what is true of it.

    What is hidden beside what the unit itself has is not compared: both are told together.
    """
    case = result.case
    for name, estimate in said.items():
        true = result.true_causes.get(cause, {}).get(name)
        if true is None or cause in _of_the_unit(result):
            continue
        if name == "direction_rad":  # the same direction, as near to what is said as it can be told
            true = estimate["value"] + float(wrap_angle(np.array(true - estimate["value"])))
        about = {"family": case.family, "robot": case.robot, "kind": case.kind, "seed": case.seed}
        size = _size(name, result.true_causes[cause])
        yield {**about, "cause": cause, "told_of": told_of, "name": name, "true": true, "size": size, **estimate}


def _size(name: str, true: Mapping[str, float]) -> float:
    """Return how far a parameter of a hidden cause is from doing nothing; NaN where it has no such size."""
    if name in ("x_mm", "y_mm", "direction_rad"):
        return math.nan
    if name in ("forward_mm", "left_mm"):
        return math.hypot(true["forward_mm"], true["left_mm"])
    return abs(true[name] - (1.0 if name in ("gain", "scale", "ratio", "factor") else 0.0))


def confidences_table(results: Sequence[Result]) -> pd.DataFrame:
    """Return one row a cause that was named: how sure the diagnosis was of it, and whether it is `true`.

    `posterior` is its probability among those of the catalogue, `confidence` what the diagnosis makes of that now,
    whenever the session was judged. `family` and `kind` are of its session.
    """
    told = VerdictSettings()
    rows = [
        {
            "family": result.case.family,
            "kind": result.case.kind,
            "posterior": cause.posterior,
            "confidence": told.confidence(cause.name, cause.posterior),
            "true": cause.name in (*result.case.true_names, *_of_the_unit(result)),
        }
        for result in results
        for cause in result.causes
    ]
    return pd.DataFrame(rows, columns=["family", "kind", "posterior", "confidence", "true"])


def filled(result: Result | None, other: Result) -> Result:
    """Put together what two calls made of a case: the first diagnosis, unless it alone failed, and all methods."""
    if result is None:
        return other
    if result.failure is not None and other.failure is None:
        result, other = other, result
    lacking = [name for name in ("baselines", "true_model") if getattr(result, name) is None]
    return result.model_copy(update={name: getattr(other, name) for name in lacking})


def append_result(path: Path, result: Result) -> None:
    """Add a result to a file, as a whole line; what an interruption left of one before ends there."""
    with path.open("a") as file:
        file.write(f"\n{result.model_dump_json()}\n")


def read_results(path: Path, cases: Iterable[Case]) -> dict[str, Result]:
    """Return what is known of some cases, by their keys; a line that an interruption cut off counts as missing."""
    wanted = {case.key for case in cases}
    known: dict[str, Result] = {}
    if not path.exists():
        return known
    for line in path.read_text().splitlines():
        try:
            result = Result.model_validate_json(line)
        except ValueError:
            continue
        if result.case.key in wanted:
            known[result.case.key] = result
    return known
