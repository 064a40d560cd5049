"""What came of each case: a line in a file that an interrupted study continues, and the tables made of all of them."""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from swarmtwin.diagnosis.result import Verdict
from swarmtwin.robot import StrictModel
from swarmtwin.studies.hidden_effects.cases import Case


class Suspect(StrictModel):
    """A cause that was named, and those that the session cannot tell from it."""

    name: str
    rivals: tuple[str, ...] = ()
    confidence: float = 1.0
    share_of_gap: float = 1.0


class ParameterEstimate(StrictModel):
    """A parameter of a cause that was named and true: what it is, and what was said of it with a 95 % interval."""

    cause: str
    name: str
    true: float
    value: float
    low: float
    high: float
    unit: str


class HeldOutGain(StrictModel):
    """What an extended simulation gained on runs that nothing was fitted to.

    Attributes:
        before_mm: mean position error of the simulation as it was.
        after_mm: of the extended one.
        least_mm: of the stand-in's exact mean displacement.
        share: of the squared error that the effect had brought, the part that is gone again; null where it had brought
            next to nothing. Squared, which an exact mean makes least: where commands are lost a prediction of the
            likeliest motion earns none of it.
        share_to_floor: likewise, of all squared error above that of the exact mean, also what the simulation erred
            before the effect.
    """

    before_mm: float
    after_mm: float
    least_mm: float
    share: float | None
    share_to_floor: float | None


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


class Result(StrictModel):
    """What came of a case.

    Attributes:
        case: what was hidden where.
        rise_percent: by how much the effect raised the simulation's one-step error, position or orientation, whichever
            more, over that of the same session without it; of a diagnosis that failed 100, the strictest.
        verdict: of the diagnosis; null where it failed.
        failure: why it failed.
        causes: in the order named.
        parameters: of the causes that are true.
        depends_on: what the residual depended on.
        gained: by the extended simulation.
        baselines: null where they were left out.
        seconds: that the diagnosis took.
    """

    case: Case
    rise_percent: float
    verdict: Verdict | None = None
    failure: str | None = None
    causes: tuple[Suspect, ...] = ()
    parameters: tuple[ParameterEstimate, ...] = ()
    depends_on: tuple[str, ...] = ()
    gained: HeldOutGain | None = None
    baselines: Baselines | None = None
    seconds: float


def results_table(results: Sequence[Result]) -> pd.DataFrame:
    """Return one row a case: what was hidden, what the diagnosis and the other methods made of it.

    Columns:
        found: the diagnosis said that something is wrong.
        named_first: the first cause named is a true one.
        listed: every true cause is named, or a rival of one that is.
        exact: the causes named are the true ones, all of them and no other.
        fitting_first, fitting_exact, rule_first: likewise of the other methods.
    """
    return pd.DataFrame([_row(result) for result in results])


def _row(result: Result) -> dict[str, Any]:
    case, others, true = result.case, result.baselines, result.case.true_names
    named = tuple(cause.name for cause in result.causes)
    rivals = tuple(rival for cause in result.causes for rival in cause.rivals)
    fitted = others.fitted if others else ()
    rule = (others.rule,) if others and others.rule else ()
    black_box = others.black_box if others else None
    return {
        "kind": case.kind,
        "variety": case.variety,
        "robot": case.robot,
        "rise_percent": result.rise_percent,
        "verdict": result.verdict or "failed",
        "named": "+".join(named),
        "rivals": "+".join(rivals),
        "found": result.verdict in ("explained", "unexplained"),
        "named_first": bool(set(named[:1]) & set(true)),
        "listed": bool(true) and set(true) <= {*named, *rivals},
        "exact": result.verdict is not None and sorted(named) == sorted(true),
        "depends_on": "+".join(result.depends_on),
        **{name: getattr(result.gained, name, None) for name in HeldOutGain.model_fields},
        "with_baselines": others is not None,
        "fitting": "+".join(fitted),
        "fitting_first": fitted[:1] == true,
        "fitting_exact": fitted == true,
        "rule": "+".join(rule),
        "rule_first": rule == true,
        **{f"black_box_{name}": getattr(black_box, name, None) for name in ("after_mm", "share", "share_to_floor")},
        "runs": case.runs,
        "steps": case.steps,
        "vehicles": " ".join(case.vehicles),
        "manner": case.manner,
        "pose_noise": case.pose_noise,
        "effects": json.dumps(case.effects),
        "seed": case.seed,
        "reference": case.reference,
        "seconds": result.seconds,
        "failure": result.failure,
    }


def parameters_table(results: Sequence[Result]) -> pd.DataFrame:
    """Return one row a parameter of a cause that was named and true, with its error in several measures.

    `error` is in the parameter's unit; `error_percent` is of the true value, NaN for angles and places, which have no
    size; `error_of_change_percent` is of what the true value differs by from 1, for factors, which do nothing at 1;
    `covered` says whether the 95 % interval holds the true value.
    """
    rows = [
        {"robot": result.case.robot, "kind": result.case.kind, "seed": result.case.seed, **parameter.model_dump()}
        for result in results
        for parameter in result.parameters
    ]
    table = pd.DataFrame(rows, columns=["robot", "kind", "seed", *ParameterEstimate.model_fields])
    true = table.true.astype(float)
    has_size = ~table.name.isin(["angle_rad", "direction_rad", "x_mm", "y_mm", "forward_mm", "left_mm"]) & (true != 0)
    is_factor = table.name.isin(["gain", "scale", "ratio", "factor"])
    table["error"] = (table.value - true).abs()
    table["error_percent"] = 100 * (table.error / true.abs()).where(has_size)
    table["error_of_change_percent"] = 100 * (table.error / (true - 1).abs()).where(is_factor)
    table["covered"] = table.true.between(table.low, table.high)
    return table


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
