"""What is counted over cases: how often causes are found and rightly named, false alarms, parameters, gains."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Self

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from swarmtwin.robot import StrictModel
from swarmtwin.studies.hidden_effects.results import (
    Result,
    confidences_table,
    parameters_table,
    results_table,
    true_model_parameters_table,
)
from swarmtwin.world.rollout import Rate

RISE_BINS = {"below 3 %": (-float("inf"), 3.0), "3 to 10 %": (3.0, 10.0), "10 % or more": (10.0, float("inf"))}
"""By how much an effect raises the one-step error, in percent: from the first figure to below the second."""

MIDDLE, CLEAR = "3 to 10 %", "10 % or more"

LIMIT_BINS = {
    "below half": (0.0, 0.5),
    "half to once": (0.5, 1.0),
    "once to twice": (1.0, 2.0),
    "twice or more": (2.0, float("inf")),
}
"""How many times as large as its detection limit an effect is: from the first figure to below the second."""

NAMING = ("exact", "found", "named_first", "listed", "falsely_named")
OTHER_LAW = ("found", "exact", "likeliest_true", "falsely_named", "not_explained")
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

    Each family by itself, `families`:
        one: by how much the effect raises the error, and two, three: sessions in which
            exact: the causes named are the true ones and no others.
            exact_of_known_vehicle: likewise, of sessions of the vehicle that the simulation was learned from: of
                another one nobody can tell an effect from what units differ in by fabrication, if it is as small.
            exact_above_limits: likewise, of sessions in which each effect is at least as large as its detection limit.
            found: something was said to be wrong.
            named_first: the first cause named is a true one.
            listed: all true causes are named, or rivals of those named.
            falsely_named: a cause was named that is not there.
        limits: `exact` of single effects, by how large they are beside the detection limit that their diagnosis states:
            from there on it should name 90 %.
        misspecified: of causes that act by another law than their mechanisms, `found`, `exact` and `falsely_named`
            likewise, and exact_of_clear: of those that raise the error by 10 % or more.
            likeliest_true: the causes that are the likeliest together are these, whether or not they were named.
            not_explained: it was not said that the catalogue explains all of it.
            gain: as below.
        outside: of what the catalogue does not know
            found: likewise; costly_found: of what raises the error by 10 % or more.
            not_named: no cause was named; not_named_of_alarmed: where something was said to be wrong.
            not_explained: it was not said that the catalogue explains it, though causes may be named for a part.
        clean: of sessions with nothing wrong
            accused: a cause was named; accused_of_other_vehicle: of another vehicle than was learned from.
            alarmed: something was said to be wrong, with or without a name.
            harmed: the extended simulation errs by 0.5 % or more above the simulation.
        mechanisms: for each effect of the catalogue, over sessions that hide it alone, `exact` by rise, and over all in
            which it was named: the median error of its parameters in percent of how far the true value is from doing
            nothing (not of places and directions), and `covered`, 95 % intervals that hold it.
        parameters: likewise for each single parameter, and in its own unit.
        covered, median_parameter_error_percent: over all that are said in the unit that they are hidden in; the others,
            in_another_unit, are counted (see `parameters_table`).
        calibration_error: see `expected_calibration_error`.
        gain: of the achievable gain on held-out runs, over sessions with true causes that raise the error by 10 % or
            more: median shares of the squared error that the effects had brought, and `to_floor` of all squared error
            above that of the exact mean, by the diagnosis and by a black-box residual. Where exact means are not known,
            `beside_twin`: of the error above that of the same session without the effects, which may err more.
        seconds, memory_mb: of a diagnosis, median and largest, its reference's learning included in the memory.
    Over all families: `cases`, `failed`, `misspecified_by_effect`, `outside_by_effect`, `clean_by_variety`, and of the
    methods that name causes, on the same cases, `methods`: `named_first` and `exact` of single effects that raise the
    error by 10 % or more, `accused` of clean sessions, and `outside`, those outside the catalogue to which no name was
    given. `true_model`: of each family what is made of it with the true model in hand and, on the same cases, by the
    diagnosis.
    """
    table = _judged(results_table(results))
    parameters, confidences = parameters_table(results), confidences_table(results)
    families = {
        str(family): _family(own, parameters[parameters.family == family], confidences[confidences.family == family])
        for family, own in table.groupby("family", sort=False)
    }
    misspecified, outside, clean = (table[table.kind == kind] for kind in ("misspecified", "outside", "clean"))
    return {
        "cases": len(table),
        "failed": Proportion.of(table.verdict == "failed"),
        "families": families,
        "misspecified_by_effect": _of_each(misspecified, "about", lambda own: _proportions(own, OTHER_LAW)),
        "outside_by_effect": _of_each(outside, "about", _silence),
        "clean_by_variety": _of_each(clean, "about", lambda own: _proportions(own, ALARMS)),
        "methods": _methods(table),
        "true_model": _of_each(
            table[table.true_model_method != ""],
            "family",
            lambda own: _beside_true_model(own, parameters, true_model_parameters_table(results)),
        ),
    }


def _family(table: pd.DataFrame, said: pd.DataFrame, confidences: pd.DataFrame) -> dict[str, Any]:
    parameters = said[said.same_unit]
    one, misspecified, outside, clean = (
        table[table.kind == kind] for kind in ("one", "misspecified", "outside", "clean")
    )
    hiding = table[table.kind.isin(["one", "two", "three"])]
    return {
        "cases": len(table),
        "failed": Proportion.of(table.verdict == "failed"),
        "one": _naming_by_rise(one),
        **{kind: _naming(table[table.kind == kind]) for kind in ("two", "three")},
        "limits": {name: _exact_at_limits(one, *bin_ends) for name, bin_ends in LIMIT_BINS.items()},
        "misspecified": {
            **_proportions(misspecified, OTHER_LAW),
            "exact_of_clear": Proportion.of(misspecified.exact[in_rise_bin(misspecified, CLEAR)]),
            "gain": _gains(misspecified[in_rise_bin(misspecified, CLEAR)]),
        },
        "outside": _silence(outside),
        "clean": {
            **_proportions(clean, ALARMS),
            "accused_of_other_vehicle": Proportion.of(clean.accused[~clean.same_vehicle.astype(bool)]),
        },
        "mechanisms": {name: _mechanism(name, one, parameters) for name in one.about.unique()},
        "parameters": _of_each(parameters, parameters.cause + "." + parameters.name, _precision),
        "covered": Proportion.of(parameters.covered),
        "in_another_unit": int((~said.same_unit).sum()),
        "median_parameter_error_percent": _median(parameters.error_percent),
        "named_causes": len(confidences),
        "calibration_error": expected_calibration_error(confidences.confidence, confidences.true),
        "gain": _gains(hiding[in_rise_bin(hiding, CLEAR)]),
        "seconds": _median_and_most(table.seconds),
        "learning_seconds": _median_and_most(table.learning_seconds),
        "memory_mb": _median_and_most(table.memory_mb),
    }


def _exact_at_limits(table: pd.DataFrame, low: float, high: float = float("inf")) -> Proportion:
    """Count what is named of effects that are so many times as large as their detection limits, below `high`."""
    return Proportion.of(table.exact[table.times_limit.astype(float).between(low, high, inclusive="left")])


def _mechanism(name: str, one: pd.DataFrame, parameters: pd.DataFrame) -> dict[str, Any]:
    alone, own = one[one.about == name], parameters[parameters.cause == name]
    return {
        "exact": {bin_name: Proportion.of(alone.exact[in_rise_bin(alone, bin_name)]) for bin_name in RISE_BINS},
        "median_error_percent": _median(own.error_percent),
        "covered": Proportion.of(own.covered),
    }


def expected_calibration_error(confidence: pd.Series, true: pd.Series, bins: int = 10) -> float | None:
    """Return by how much confidences miss how often they are right, averaged over the causes named (Naeini, 2015).

    Causes are sorted into bins of equal width by their confidence; in each the mean confidence is compared with the
    share that is true.
    """
    if not len(confidence):
        return None
    said, right = confidence.to_numpy(float), true.to_numpy(float)
    which = np.minimum((said * bins).astype(int), bins - 1)
    away = np.abs(np.bincount(which, said, bins) - np.bincount(which, right, bins))
    return float(away.sum() / len(said))


def _silence(table: pd.DataFrame) -> Proportions:
    costly = Proportion.of(table.found[in_rise_bin(table, CLEAR)])
    of_alarmed = Proportion.of(table.not_named[table.found.astype(bool)])
    return {**_proportions(table, SILENCE), "costly_found": costly, "not_named_of_alarmed": of_alarmed}


def _median_and_most(values: pd.Series) -> dict[str, float | None]:
    known = values.dropna().astype(float)
    return {"median": _median(values), "most": float(known.max()) if len(known) else None}


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


def _naming(table: pd.DataFrame) -> Proportions:
    known = Proportion.of(table.exact[table.same_vehicle.astype(bool)])
    above = _exact_at_limits(table, 1.0)
    return {**_proportions(table, NAMING), "exact_of_known_vehicle": known, "exact_above_limits": above}


def _naming_by_rise(table: pd.DataFrame) -> dict[str, Proportions]:
    return {name: _naming(table[in_rise_bin(table, name)]) for name in RISE_BINS}


def _precision(parameters: pd.DataFrame) -> dict[str, Any]:
    """Summarise one parameter of one cause."""
    errors = ("error", "error_percent")
    return {
        "count": len(parameters),
        **{f"median_{error}": _median(parameters[error]) for error in errors},
        "covered": Proportion.of(parameters.covered),
        "unit": parameters.unit.iloc[0],
    }


def _gains(table: pd.DataFrame) -> dict[str, Any]:
    return {
        "count": int(table.after_mm.notna().sum()),
        "diagnosis": _median(table.share[table.least_mm.notna()]),
        "beside_twin": _median(table.share[table.least_mm.isna()]),
        "black_box": _median(table.black_box_share),
        "diagnosis_to_floor": _median(table.share_to_floor),
        "black_box_to_floor": _median(table.black_box_share_to_floor),
    }


def _methods(table: pd.DataFrame) -> dict[str, Proportions]:
    """Compare the methods that name causes; those beside the diagnosis on the cases that they worked on."""
    methods = {}
    for method, (named, first, exact) in METHODS.items():
        cases = table if method == "diagnosis" else table[table.with_baselines]
        clear = cases[(cases.kind == "one") & in_rise_bin(cases, CLEAR)]
        outside = cases[cases.kind == "outside"]
        if len(cases):
            methods[method] = {
                "named_first": Proportion.of(clear[first]),
                "exact": Proportion.of(clear[exact]),
                "accused": Proportion.of(cases[named][cases.kind == "clean"] != ""),
                "outside": Proportion.of((outside[named] == "") & (outside.verdict != "failed")),
            }
    return methods


def _beside_true_model(
    table: pd.DataFrame, said: pd.DataFrame, said_by_true_model: pd.DataFrame
) -> dict[str, dict[str, Any]]:
    """Compare the diagnosis with what has the true model, on one family's cases that both worked on."""
    method = str(table.true_model_method.iloc[0])
    ways = {"diagnosis": ("", said), method: ("true_model", said_by_true_model)}
    compared: dict[str, dict[str, Any]] = {}
    for name, (way, parameters) in ways.items():
        is_own = parameters.seed.isin(table.seed) & (parameters.family == table.family.iloc[0])
        own = pd.DataFrame(
            {
                "kind": table.kind,
                "rise_percent": table.rise_percent,
                "exact": table[f"{way}_exact" if way else "exact"].astype(bool),
                "named": table[way or "named"] != "",
                "failed": table[f"{way}_failure" if way else "failure"].notna(),
            }
        )
        one, outside, clean = (own[own.kind == kind] for kind in ("one", "outside", "clean"))
        compared[name] = {
            "cases": len(own),
            "one": {bin_name: Proportion.of(one.exact[in_rise_bin(one, bin_name)]) for bin_name in RISE_BINS},
            **{kind: Proportion.of(own.exact[own.kind == kind]) for kind in ("two", "three")},
            "outside": Proportion.of(~outside.named & ~outside.failed),
            "accused": Proportion.of(clean.named),
            "failed": Proportion.of(own.failed),
            "median_parameter_error_percent": _median(parameters.error_percent[is_own & parameters.same_unit]),
            "seconds": _median_and_most(table[f"{way}_seconds" if way else "seconds"]),
        }
    return compared


def _median(values: pd.Series) -> float | None:
    known = values.dropna().astype(float)
    return float(known.median()) if len(known) else None
