"""The figures of the study, all in one: the content of its metrics.json."""

from collections.abc import Sequence

import numpy as np

from swarmtwin.commands.experiments.hidden_effects_counts import (
    BINS,
    CLEAR,
    Clean,
    Compared,
    Gains,
    Naming,
    Outside,
    Precision,
    by_variety,
    fitted_names,
    grouped,
    in_bin,
    is_covered,
    of_kind,
    relative_error_percent,
    rule_names,
)
from swarmtwin.commands.experiments.hidden_effects_rates import Share
from swarmtwin.commands.experiments.hidden_effects_results import Result
from swarmtwin.robot import StrictModel


class Summary(StrictModel):
    """The content of metrics.json.

    Attributes that do not speak for themselves:
        rivals_a_cause: mean number of rivals that a named cause has; of many, one is easily the true one.
        mean_confidence: of the first causes named of single effects; to be compared with how often they are true.
        first_right: how often that is.
    """

    cases: int
    failed: Share
    single: dict[str, Naming]
    single_by_robot: dict[str, dict[str, Naming]]
    single_by_cause: dict[str, dict[str, Naming]]
    pair: Naming
    triple: Naming
    outside: Outside
    outside_by_effect: dict[str, Outside]
    clean: Clean
    clean_by_variety: dict[str, Clean]
    worst_harm_percent: float
    parameters: dict[str, Precision]
    median_parameter_error_percent: float | None
    covered: Share
    gain: Gains
    gain_by_cause: dict[str, Gains]
    methods: dict[str, Compared]
    rivals_a_cause: float | None
    mean_confidence: float | None
    first_right: Share
    median_seconds: float
    longest_seconds: float


def summarise(results: Sequence[Result]) -> Summary:
    """Count everything; at least one result."""
    single, clean, outside = (of_kind(results, kind) for kind in ("single", "clean", "outside"))
    clear = [result for result in single if in_bin(result, CLEAR)]
    parameters = [parameter for result in single for parameter in result.parameters]
    sized = [error for parameter in parameters if (error := relative_error_percent(parameter)) is not None]
    first = [result for result in single if result.causes]
    rivals = [len(cause.rivals) for result in results for cause in result.causes]
    seconds = [result.seconds for result in results]
    harms = [result.gained.harm_percent for result in clean if result.gained]
    return Summary(
        cases=len(results),
        failed=Share.of(result.verdict is None for result in results),
        single=_by_bin(single),
        single_by_robot={name: _by_bin(own) for name, own in grouped(single, lambda one: one.case.robot).items()},
        single_by_cause={name: _by_bin(own) for name, own in by_variety(single).items()},
        pair=Naming.of(of_kind(results, "pair")),
        triple=Naming.of(of_kind(results, "triple")),
        outside=Outside.of(outside),
        outside_by_effect={name: Outside.of(own) for name, own in by_variety(outside).items()},
        clean=Clean.of(clean),
        clean_by_variety={name: Clean.of(own) for name, own in by_variety(clean).items()},
        worst_harm_percent=max(harms, default=0.0),
        parameters={
            name: Precision.of(own) for name, own in grouped(parameters, lambda one: f"{one.cause}.{one.name}").items()
        },
        median_parameter_error_percent=float(np.median(sized)) if sized else None,
        covered=Share.of(is_covered(parameter) for parameter in parameters),
        gain=Gains.of(clear),
        gain_by_cause={name: Gains.of(own) for name, own in by_variety(clear).items()},
        methods=_methods(results),
        rivals_a_cause=float(np.mean(rivals)) if rivals else None,
        mean_confidence=float(np.mean([result.causes[0].confidence for result in first])) if first else None,
        first_right=Share.of(result.is_named_first for result in first),
        median_seconds=float(np.median(seconds)),
        longest_seconds=max(seconds),
    )


def _methods(results: Sequence[Result]) -> dict[str, Compared]:
    with_baselines = [result for result in results if result.baselines]
    methods = {"diagnosis": Compared.of(results, lambda result: result.names)}
    if with_baselines:
        methods["parameter fitting"] = Compared.of(with_baselines, fitted_names)
        methods["correlation rules"] = Compared.of(with_baselines, rule_names)
    return methods


def _by_bin(results: Sequence[Result]) -> dict[str, Naming]:
    return {name: Naming.of([result for result in results if in_bin(result, name)]) for name in BINS}
