"""What is counted over cases: how often causes are found and rightly named, false alarms, parameters, gains."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Self

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from swarmtwin.robot import StrictModel
from swarmtwin.studies.hidden_effects.results import Result, parameters_table, results_table
from swarmtwin.world.rollout import Rate

RISE_BINS = {"below 3 %": (-float("inf"), 3.0), "3 to 10 %": (3.0, 10.0), "10 % or more": (10.0, float("inf"))}
"""By how much an effect raises the one-step error, in percent: from the first figure to below the second."""

MIDDLE, CLEAR = "3 to 10 %", "10 % or more"

NAMING = ("found", "named_first", "listed", "exact")
SILENCE = ("found", "not_named", "not_explained")
ALARMS = ("accused", "alarmed", "harmed")

METHODS = {
    "diagnosis": ("named", "named_first", "exact"),
    "parameter fitting": ("fitting", "fitting_first", "fitting_exact"),
    "correlation rules": ("rule", "rule_first", "rule_first"),
}
"""Of each method the columns that hold the causes it named, whether the first is true, and whether all are."""


class Proportion(StrictModel):
    """How often something happened, with Wilson's 95 % interval.

    Attributes:
        count: how often.
        total: of how many cases.
        share: null where there is no case.
        low: lower end of the interval.
        high: upper end.
        at_most: upper 95 % bound by Clopper and Pearson, which is never too low (one-sided).
    """

    count: int
    total: int
    share: float | None
    low: float
    high: float
    at_most: float

    @classmethod
    def of(cls, happened: Iterable[bool]) -> Self:
        """Count in how many of the cases it happened."""
        cases = [bool(case) for case in happened]
        count, total = sum(cases), len(cases)
        if not total:
            return cls(count=0, total=0, share=None, low=0.0, high=1.0, at_most=1.0)
        _, low, high = Rate.of(np.array(cases))
        at_most = binomtest(count, total, alternative="less").proportion_ci(0.95, method="exact").high
        return cls(count=count, total=total, share=count / total, low=low, high=high, at_most=float(at_most))

    def __str__(self) -> str:
        return "–" if self.share is None else f"{self.share:.1%} ({self.count}/{self.total})"


Proportions = dict[str, Proportion]


def summarise(results: Sequence[Result]) -> dict[str, Any]:
    """Count everything, of at least one result: the content of metrics.json; None where nothing is known.

    Of single effects, by how much they raise the error, and of pairs and triples:
        found: something was said to be wrong.
        named_first: the first cause named is a true one.
        listed: all true causes are named, or rivals of those named.
        exact: the causes named are the true ones and no others.
    Of effects outside the catalogue:
        found: likewise.
        not_named: no cause was named.
        not_explained: it was not said that the catalogue explains it, though causes may be named that explain a part.
    Of clean sessions:
        accused: a cause was named.
        alarmed: something was said to be wrong, with or without a name.
        harmed: the extended simulation errs by 0.5 % or more above the simulation.
    Of the methods that name causes, on the same cases: `named_first` and `exact` of single effects that raise the error
    by 10 % or more, `accused` of clean sessions, and `outside`, those outside the catalogue to which none was given.
    Of each parameter of a cause named, over single effects: median errors in its own unit, in percent of the true value
    (not of angles and places, which have no size) and, for factors, of what the true value differs by from doing
    nothing; `covered`: 95 % intervals that hold the true value.
    Of the achievable gain on held-out runs, over single effects that raise the error by 10 % or more: median shares of
    the squared error that the effect had brought, and `to_floor` of all squared error above that of the exact mean, by
    the diagnosis and by a black-box residual.

    What does not speak for itself:
        rivals_a_cause: mean number of rivals that a named cause has; of many, one is easily the true one.
        mean_confidence: of the first causes named of single effects; to be compared with how often they are true.
        first_right: how often that is.
    """
    table = _judged(results_table(results))
    kinds = {kind: table[table.kind == kind] for kind in ("single", "pair", "triple", "outside", "clean")}
    single, outside, clean = kinds["single"], kinds["outside"], kinds["clean"]
    clear = single[in_rise_bin(single, CLEAR)]
    parameters = parameters_table([result for result in results if result.case.kind == "single"])
    causes = [cause for result in results for cause in result.causes]
    first = [result.causes[0] for result in results if result.case.kind == "single" and result.causes]
    return {
        "cases": len(table),
        "failed": Proportion.of(table.verdict == "failed"),
        "single": _naming_by_rise(single),
        "single_by_robot": _of_each(single, "robot", _naming_by_rise),
        "single_by_cause": _of_each(single, "variety", _naming_by_rise),
        "pair": _proportions(kinds["pair"], NAMING),
        "triple": _proportions(kinds["triple"], NAMING),
        "outside": _proportions(outside, SILENCE),
        "outside_by_effect": _of_each(outside, "variety", lambda own: _proportions(own, SILENCE)),
        "clean": _proportions(clean, ALARMS),
        "clean_by_variety": _of_each(clean, "variety", lambda own: _proportions(own, ALARMS)),
        "worst_harm_percent": float(clean.harm_percent.clip(lower=0.0).fillna(0.0).max()) if len(clean) else 0.0,
        "parameters": _of_each(parameters, parameters.cause + "." + parameters.name, _precision),
        "median_parameter_error_percent": _median(parameters.error_percent),
        "covered": Proportion.of(parameters.covered),
        "gain": _gains(clear),
        "gain_by_cause": _of_each(clear, "variety", _gains),
        "methods": _methods(table),
        "rivals_a_cause": sum(len(cause.rivals) for cause in causes) / len(causes) if causes else None,
        "mean_confidence": sum(cause.confidence for cause in first) / len(first) if first else None,
        "first_right": Proportion.of(single.named_first[single.named != ""]),
        "median_seconds": float(table.seconds.median()),
        "longest_seconds": float(table.seconds.max()),
    }


def in_rise_bin(table: pd.DataFrame, name: str) -> pd.Series:
    """Say of each case whether the effect raised the error by as much as a bin says."""
    low, high = RISE_BINS[name]
    return table.rise_percent.between(low, high, inclusive="left")


def _judged(table: pd.DataFrame) -> pd.DataFrame:
    """Add to the table of results what silence and alarms are judged by."""
    harm_percent = 100 * (table.after_mm.astype(float) / table.before_mm.astype(float) - 1)
    return table.assign(
        not_named=(table.verdict != "failed") & (table.named == ""),
        not_explained=table.verdict.isin(["unexplained", "no_gap"]),
        accused=table.named != "",
        alarmed=table.found,
        harmed=harm_percent >= 0.5,
        harm_percent=harm_percent,
    )


def _of_each(table: pd.DataFrame, by: str | pd.Series, count: Callable[[pd.DataFrame], Any]) -> dict[str, Any]:
    """Count the rows of each group by themselves."""
    return {str(name): count(own) for name, own in table.groupby(by, sort=False)}


def _proportions(table: pd.DataFrame, columns: Iterable[str]) -> Proportions:
    return {column: Proportion.of(table[column]) for column in columns}


def _naming_by_rise(table: pd.DataFrame) -> dict[str, Proportions]:
    return {name: _proportions(table[in_rise_bin(table, name)], NAMING) for name in RISE_BINS}


def _precision(parameters: pd.DataFrame) -> dict[str, Any]:
    """Summarise one parameter of one cause."""
    errors = ("error", "error_percent", "error_of_change_percent")
    return {
        "count": len(parameters),
        **{f"median_{error}": _median(parameters[error]) for error in errors},
        "covered": Proportion.of(parameters.covered),
        "unit": parameters.unit.iloc[0],
    }


def _gains(table: pd.DataFrame) -> dict[str, Any]:
    return {
        "count": int(table.after_mm.notna().sum()),
        "diagnosis": _median(table.share),
        "black_box": _median(table.black_box_share),
        "diagnosis_to_floor": _median(table.share_to_floor),
        "black_box_to_floor": _median(table.black_box_share_to_floor),
    }


def _methods(table: pd.DataFrame) -> dict[str, Proportions]:
    """Compare the methods that name causes; those beside the diagnosis on the cases that they worked on."""
    methods = {}
    for method, (named, first, exact) in METHODS.items():
        cases = table if method == "diagnosis" else table[table.with_baselines]
        clear = cases[(cases.kind == "single") & in_rise_bin(cases, CLEAR)]
        if len(cases):
            methods[method] = {
                "named_first": Proportion.of(clear[first]),
                "exact": Proportion.of(clear[exact]),
                "accused": Proportion.of(cases[named][cases.kind == "clean"] != ""),
                "outside": Proportion.of(cases[named][cases.kind == "outside"] == ""),
            }
    return methods


def _median(values: pd.Series) -> float | None:
    known = values.dropna().astype(float)
    return float(known.median()) if len(known) else None
