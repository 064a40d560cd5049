"""What is counted over cases: how often causes are found and rightly named, false alarms, parameters, gains."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import pandas as pd

from swarmtwin.studies.hidden_effects.method_comparison import DIAGNOSIS, OTHERS, compared
from swarmtwin.studies.hidden_effects.proportions import (
    CLEAR,
    FAINT,
    RISE_BINS,
    Proportion,
    Proportions,
    in_rise_bin,
    median,
    median_and_most,
)
from swarmtwin.studies.hidden_effects.results import (
    Result,
    confidences_table,
    parameters_table,
    results_table,
    true_model_parameters_table,
)

LIMIT_BINS = {
    "below half": (0.0, 0.5),
    "half to once": (0.5, 1.0),
    "once to twice": (1.0, 2.0),
    "twice or more": (2.0, float("inf")),
}
"""How many times as large as its detection limit an effect is: from the first figure to below the second."""

HIDING = ("one", "two", "three")
"""Kinds of sessions that hide causes of the catalogue, which act as their mechanisms do."""

CERTAIN = 0.99
"""A cause that is named with a greater posterior probability is all but certain, if the catalogue has what is wrong."""

LEAST_SHARES = (0.0, 0.95, 0.98, 0.99, 0.995, 0.999)
"""Shares of what can be explained that causes might have to explain to be named; the first one as it is."""

NAMING = ("exact", "found", "named_first", "listed", "falsely_named")
OTHER_LAW = ("found", "exact", "likeliest_true", "falsely_named", "not_explained")
SILENCE = ("found", "not_named", "not_explained")
ALARMS = ("accused", "alarmed", "harmed")


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
        not_told: of sessions with one, two or three effects, see `_not_told`.
        certain: of causes named that are all but certain (see `CERTAIN`), those that are there, by what the session
            hides: causes of the catalogue, one that acts by another law, or `nothing` of the catalogue.
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
        mean_confidence: of the causes named.
        brier: see `brier_score`, of confidences; brier_of_posterior and calibration_error_of_posterior are of posterior
            probabilities alone.
        calibration_error: see `expected_calibration_error`; and calibration_error_by_chance: what it would stay below
            in 95 % of such studies if confidences were right.
        gain: of the achievable gain on held-out runs, over sessions with true causes that raise the error by 10 % or
            more: median shares of the squared error that the effects had brought, and `to_floor` of all squared error
            above that of the exact mean. Where exact means are not known, `beside_twin`: of the error above that of the
            same session without the effects, which may err more.
        seconds, memory_mb: of a diagnosis, median and largest, its reference's learning included in the memory.
    Over all families: `cases`, `failed`, `misspecified_by_effect`, `outside_by_effect`, `clean_by_variety`, and
    `by_least_share`: what would be named if causes had to explain more of what can be explained. Of each
    family what several methods make of the same cases (see `method_comparison.compared`): `methods` beside the
    diagnosis, and `true_model`, what is made of them with the true model in hand.
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
        "by_least_share": {f"{100 * least:.3g}": _named_from(table, least) for least in LEAST_SHARES},
        "misspecified_by_effect": _of_each(misspecified, "about", lambda own: _proportions(own, OTHER_LAW)),
        "outside_by_effect": _of_each(outside, "about", _silence),
        "clean_by_variety": _of_each(clean, "about", lambda own: _proportions(own, ALARMS)),
        "methods": _of_each(
            table[table.with_baselines], "family", lambda own: compared(own, OTHERS, {DIAGNOSIS: parameters})
        ),
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
    hiding = table[table.kind.isin(HIDING)]
    certain = confidences[confidences.posterior > CERTAIN]
    return {
        "cases": len(table),
        "failed": Proportion.of(table.verdict == "failed"),
        "one": _naming_by_rise(one),
        **{kind: _naming(table[table.kind == kind]) for kind in ("two", "three")},
        "not_told": _not_told(hiding),
        "certain": {
            name: Proportion.of(certain.true[certain.kind.isin(kinds)])
            for name, kinds in (
                ("catalogue", HIDING),
                ("another_law", ("misspecified",)),
                ("nothing", ("outside", "clean")),
            )
        },
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
        "median_parameter_error_percent": median(parameters.error_percent),
        "named_causes": len(confidences),
        "calibration_error": expected_calibration_error(confidences.confidence, confidences.true),
        "calibration_error_by_chance": calibration_error_by_chance(confidences.confidence),
        "calibration_error_of_posterior": expected_calibration_error(confidences.posterior, confidences.true),
        "mean_confidence": float(confidences.confidence.mean()) if len(confidences) else None,
        "brier": brier_score(confidences.confidence, confidences.true),
        "brier_of_posterior": brier_score(confidences.posterior, confidences.true),
        "gain": _gains(hiding[in_rise_bin(hiding, CLEAR)]),
        "seconds": median_and_most(table.seconds),
        "learning_seconds": median_and_most(table.learning_seconds),
        "memory_mb": median_and_most(table.memory_mb),
    }


def _named_from(table: pd.DataFrame, least: float) -> Proportions:
    """Count who would be named, rightly and wrongly, if causes had to explain `least` of what can be explained."""
    named = table.accused & ~(table.explained_share < least)
    exact, clear = named & table.exact, in_rise_bin(table, CLEAR)
    return {
        "one_of_clear": Proportion.of(exact[(table.kind == "one") & clear]),
        **{kind: Proportion.of(exact[table.kind == kind]) for kind in HIDING},
        **{kind: Proportion.of(named[table.kind == kind]) for kind in ("outside", "clean")},
    }


def _exact_at_limits(table: pd.DataFrame, low: float, high: float = float("inf")) -> Proportion:
    """Count what is named of effects that are so many times as large as their detection limits, below `high`."""
    return Proportion.of(table.exact[table.times_limit.astype(float).between(low, high, inclusive="left")])


def _not_told(hiding: pd.DataFrame) -> dict[str, Any]:
    """Count the sessions that are not told as a whole, and what became of them: of each one thing.

    not_exact: of those whose diagnosis did not fail; of_other_vehicle: of the ones of another vehicle than was learned
        from.
    falsely_named: a cause is named that is not there.
    left_out: causes are named, all of them there, but not all that are.
    nameless: something was said to be wrong, and no cause named.
    silent: nothing was said to be wrong; silent_below: of these, effects that raise the error by less than 3 %.
    causes_left_out: how often each cause is one of those that `left_out` lacks.
    """
    told = hiding[hiding.verdict != "failed"]
    missed = told[~told.exact.astype(bool)]
    wrong, is_silent = missed.falsely_named.astype(bool), ~missed.found.astype(bool)
    nameless = ~wrong & ~is_silent & missed.not_named
    left_out = missed[~wrong & ~is_silent & ~nameless]
    lacking = Counter(name for names in left_out.not_told for name in names.split("+"))
    return {
        "not_exact": Proportion.of(~told.exact.astype(bool)),
        "of_other_vehicle": Proportion.of(~told.exact[~told.same_vehicle.astype(bool)].astype(bool)),
        "falsely_named": Proportion.of(wrong),
        "left_out": Proportion.of(missed.index.isin(left_out.index)),
        "nameless": Proportion.of(nameless),
        "silent": Proportion.of(~wrong & is_silent),
        "silent_below": Proportion.of(in_rise_bin(missed[~wrong & is_silent], FAINT)),
        "causes_left_out": dict(lacking.most_common()),
    }


def _mechanism(name: str, one: pd.DataFrame, parameters: pd.DataFrame) -> dict[str, Any]:
    alone, own = one[one.about == name], parameters[parameters.cause == name]
    return {
        "exact": {bin_name: Proportion.of(alone.exact[in_rise_bin(alone, bin_name)]) for bin_name in RISE_BINS},
        "median_error_percent": median(own.error_percent),
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


def brier_score(probability: pd.Series, true: pd.Series) -> float | None:
    """Return the mean squared error of what causes were named with (Brier, 1950): the less, the better; 0 at best."""
    return float(((probability.astype(float) - true.astype(float)) ** 2).mean()) if len(probability) else None


def calibration_error_by_chance(confidence: pd.Series, draws: int = 4000, level: float = 0.95) -> float | None:
    """Return what the calibration error of so many causes stays below if each is there as often as its confidence says.

    That is the quantile `level` over `draws` of which of them are there; None of no cause.
    """
    if not len(confidence):
        return None
    told = confidence.sort_values()
    there = np.random.default_rng(0).random((draws, len(told))) < told.to_numpy(float)
    return float(np.quantile([expected_calibration_error(told, pd.Series(one)) for one in there], level))


def _silence(table: pd.DataFrame) -> Proportions:
    costly = Proportion.of(table.found[in_rise_bin(table, CLEAR)])
    of_alarmed = Proportion.of(table.not_named[table.found.astype(bool)])
    return {**_proportions(table, SILENCE), "costly_found": costly, "not_named_of_alarmed": of_alarmed}


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
        **{f"median_{error}": median(parameters[error]) for error in errors},
        "covered": Proportion.of(parameters.covered),
        "unit": parameters.unit.iloc[0],
    }


def _gains(table: pd.DataFrame) -> dict[str, Any]:
    return {
        "count": int(table.after_mm.notna().sum()),
        "diagnosis": median(table.share[table.least_mm.notna()]),
        "beside_twin": median(table.share[table.least_mm.isna()]),
        "diagnosis_to_floor": median(table.share_to_floor),
    }


def _beside_true_model(
    table: pd.DataFrame, said: pd.DataFrame, said_by_true_model: pd.DataFrame
) -> dict[str, dict[str, Any]]:
    """Compare the diagnosis with what has the true model, on one family's cases that both worked on."""
    method = str(table.true_model_method.iloc[0])
    return compared(table, (DIAGNOSIS, method), {DIAGNOSIS: said, method: said_by_true_model})
