"""What is counted over cases, and how: names, alarms, parameters, gains."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from swarmtwin.commands.experiments.hidden_effects_rates import Share
from swarmtwin.commands.experiments.hidden_effects_results import Parameter, Result
from swarmtwin.robot import StrictModel

BINS = {"below 3 %": (-np.inf, 3.0), "3 to 10 %": (3.0, 10.0), "10 % or more": (10.0, np.inf)}
CLEAR = "10 % or more"
"""Rises of the one-step error, in percent."""

HARM_PERCENT = 0.5
ABSOLUTE = ("angle_rad", "direction_rad", "x_mm", "y_mm", "forward_mm", "left_mm")
"""Parameters without a size that their error could be a share of."""
NEUTRAL = {"gain": 1.0, "scale": 1.0, "ratio": 1.0, "factor": 1.0}
"""Values at which a parameter that is a factor does nothing."""


class Naming(StrictModel):
    """How well effects were found and named.

    Attributes:
        found: something was said to be wrong.
        named_first: the first cause named is a true one.
        listed: all true causes are named, or rivals of those named.
        exact: the causes named are the true ones and no others.
    """

    found: Share
    named_first: Share
    listed: Share
    exact: Share

    @classmethod
    def of(cls, results: Sequence[Result]) -> "Naming":
        """Count."""
        return cls(
            found=Share.of(result.is_found for result in results),
            named_first=Share.of(result.is_named_first for result in results),
            listed=Share.of(result.is_listed for result in results),
            exact=Share.of(result.is_exact for result in results),
        )


class Precision(StrictModel):
    """How well a parameter was measured, over the cases in which its cause was named.

    Attributes:
        count: of cases.
        median_error: in the parameter's own unit.
        median_error_percent: of the true value; null for angles and places, which have no size.
        median_error_of_change_percent: of what the true value differs by from doing nothing, for factors.
        covered: 95 % intervals that hold the true value.
        unit: of the parameter.
    """

    count: int
    median_error: float
    median_error_percent: float | None
    median_error_of_change_percent: float | None
    covered: Share
    unit: str

    @classmethod
    def of(cls, parameters: Sequence[Parameter]) -> "Precision":
        """Summarise one parameter of one cause."""
        name = parameters[0].name
        true = np.array([parameter.true for parameter in parameters])
        error = np.abs(np.array([parameter.value for parameter in parameters]) - true)
        relative = None if name in ABSOLUTE else float(np.median(error / np.abs(true))) * 100
        change = None if name not in NEUTRAL else float(np.median(error / np.abs(true - NEUTRAL[name]))) * 100
        return cls(
            count=len(parameters),
            median_error=float(np.median(error)),
            median_error_percent=relative,
            median_error_of_change_percent=change,
            covered=Share.of(is_covered(parameter) for parameter in parameters),
            unit=parameters[0].unit,
        )


class Clean(StrictModel):
    """What was said of sessions with nothing wrong.

    Attributes:
        accused: a cause was named.
        alarmed: something was said to be wrong, with or without a name.
        harmed: the extended simulation errs by `HARM_PERCENT` or more above the simulation.
    """

    accused: Share
    alarmed: Share
    harmed: Share

    @classmethod
    def of(cls, results: Sequence[Result]) -> "Clean":
        """Count."""
        return cls(
            accused=Share.of(bool(result.causes) for result in results),
            alarmed=Share.of(result.is_found for result in results),
            harmed=Share.of(
                result.gained is not None and result.gained.harm_percent >= HARM_PERCENT for result in results
            ),
        )


class Outside(StrictModel):
    """What was said of effects that the catalogue does not know.

    Attributes:
        found: something was said to be wrong.
        not_named: no cause was named.
        not_explained: it was not said that the catalogue explains it, though causes may be named that explain a part.
    """

    found: Share
    not_named: Share
    not_explained: Share

    @classmethod
    def of(cls, results: Sequence[Result]) -> "Outside":
        """Count."""
        return cls(
            found=Share.of(result.is_found for result in results),
            not_named=Share.of(result.verdict is not None and not result.causes for result in results),
            not_explained=Share.of(result.verdict in ("unexplained", "no_gap") for result in results),
        )


class Gains(StrictModel):
    """Median shares of the achievable gain on held-out runs, over single effects that raise the error by 10 % or more.

    Attributes:
        count: of cases.
        diagnosis: of the squared error that the effect had brought.
        black_box: likewise, of a black-box residual.
        diagnosis_to_floor: of all squared error above that of the exact mean.
        black_box_to_floor: likewise.
    """

    count: int
    diagnosis: float | None
    black_box: float | None
    diagnosis_to_floor: float | None
    black_box_to_floor: float | None

    @classmethod
    def of(cls, results: Sequence[Result]) -> "Gains":
        """Summarise."""
        ours = [result.gained for result in results if result.gained]
        others = [result.baselines.black_box for result in results if result.baselines]
        return cls(
            count=len(ours),
            diagnosis=_median([gained.share for gained in ours]),
            black_box=_median([gained.share for gained in others]),
            diagnosis_to_floor=_median([gained.share_to_floor for gained in ours]),
            black_box_to_floor=_median([gained.share_to_floor for gained in others]),
        )


class Compared(StrictModel):
    """The methods that name causes, on the same cases.

    Attributes:
        named_first: single effects that raise the error by 10 % or more.
        exact: the same, no other cause named beside.
        accused: sessions with nothing wrong in which a cause was named.
        outside: effects outside the catalogue to which no name was given.
    """

    named_first: Share
    exact: Share
    accused: Share
    outside: Share

    @classmethod
    def of(cls, results: Sequence[Result], names_of: Callable[[Result], tuple[str, ...]]) -> "Compared":
        """Count, given what a method names, the surest cause first."""
        single = [result for result in of_kind(results, "single") if in_bin(result, CLEAR)]
        return cls(
            named_first=Share.of(names_of(result)[:1] == result.case.true_names for result in single),
            exact=Share.of(names_of(result) == result.case.true_names for result in single),
            accused=Share.of(bool(names_of(result)) for result in of_kind(results, "clean")),
            outside=Share.of(not names_of(result) for result in of_kind(results, "outside")),
        )


def fitted_names(result: Result) -> tuple[str, ...]:
    """Return what parameter fitting without model choice names."""
    return result.baselines.fitted if result.baselines else ()


def rule_names(result: Result) -> tuple[str, ...]:
    """Return what the rules on correlations name."""
    return (result.baselines.rule,) if result.baselines and result.baselines.rule else ()


def of_kind(results: Sequence[Result], kind: str) -> list[Result]:
    """Return the results of the cases of one kind."""
    return [result for result in results if result.case.kind == kind]


def in_bin(result: Result, name: str) -> bool:
    """Say whether the effect raised the error by as much as a bin says."""
    low, high = BINS[name]
    return low <= result.rise_percent < high


def by_variety(results: Sequence[Result]) -> Mapping[str, list[Result]]:
    """Group by effect, or by kind of clean session."""
    return grouped(results, lambda result: result.case.variety)


def grouped(entries: Sequence[Any], key: Callable[[Any], str]) -> Mapping[str, list[Any]]:
    """Group, in the order in which keys first occur."""
    groups: dict[str, list[Any]] = {}
    for entry in entries:
        groups.setdefault(key(entry), []).append(entry)
    return groups


def is_covered(parameter: Parameter) -> bool:
    """Say whether the interval holds the true value."""
    return parameter.low <= parameter.true <= parameter.high


def relative_error_percent(parameter: Parameter) -> float | None:
    """Return the error as a share of the true value; null for what has no size."""
    if parameter.name in ABSOLUTE or parameter.true == 0:
        return None
    return 100 * abs(parameter.value - parameter.true) / abs(parameter.true)


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None
