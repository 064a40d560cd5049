"""What a report says in words: numbers with their intervals, verdicts, causes and what residuals depend on."""

import math
import re
from collections import defaultdict
from collections.abc import Callable, Sequence
from string import Formatter
from typing import NamedTuple, get_args

from swarmtwin.diagnosis.result import (
    Cause,
    DetectionLimit,
    DiagnosisResult,
    Estimate,
    EstimatedCause,
    Gain,
    NextRecording,
    UnitDifference,
)
from swarmtwin.simulation.mechanism import Mechanism, mechanism_class

SPACE = "\N{NO-BREAK SPACE}"
DASH = f"{SPACE}– "
SHARES = ("loss", "probability", "spread")
UNITS = {"rad": (180 / math.pi, "°"), "deg": (1.0, "°"), "": (1.0, "")}
PARTS = {
    "command": "the command",
    "previous_command": "the previous command",
    "heading": "the heading",
    "position": "the place in the arena",
    "wall_distance": "how near the walls are",
    "time": "the time since the session began",
    "duration": "how long the period lasts",
    "neighbours": "where other vehicles are",
    "vehicle": "which vehicle it is",
}
DIFFERENCES = {
    "ahead": "how far it goes",
    "aside": "how far it slides",
    "turn": "how far it turns",
    "left_to_right": "how fast its left wheel is beside the right one",
    "askew": "how it steers",
    "lag": "how late it follows",
    "start": "at which command it starts to move",
    "start_left_to_right": "at which command its left wheel starts to move beside the right one",
}
SHAPES = {
    "spread": "Errors scatter {} than the ordinary noise.",
    "tails": "Large errors are {} common than they were.",
}
QUESTIONS = PARTS | {"spread": "how errors scatter", "tails": "how common large errors are"}
COMPONENTS = {
    "forward": "how much further forward it goes than simulated",
    "left": "how much further left it goes than simulated",
    "turn": "how much further left it turns than simulated",
    "way": "how much further it goes than simulated",
    "turning": "how much more it turns than simulated",
    "x": "how much further along x it goes than simulated",
    "y": "how much further along y it goes than simulated",
    "away": "how much further away from its neighbour it goes than simulated",
}


def estimate_words(name: str, estimate: Estimate) -> str:
    """Return a parameter with its interval, such as `0.15 s (0.13 to 0.17)`; angles in degrees, shares in percent."""
    factor, _, decimals = _manner(name, estimate)
    low, high = (_number(factor * end, decimals) for end in (estimate.low, estimate.high))
    return f"{value_words(name, estimate)} ({low} to {high})"


def value_words(name: str, estimate: Estimate) -> str:
    """Return a parameter as exactly as its interval allows, such as `0.15 s`."""
    factor, unit, decimals = _manner(name, estimate)
    return f"{_number(factor * estimate.value, decimals)}{unit}"


def cause_words(cause: EstimatedCause) -> str:
    """Return what a cause is, its numbers with their intervals."""
    return _filled_words(cause, estimate_words)


def cause_summary(cause: Cause) -> str:
    """Return what a cause is, its numbers alone."""
    return _filled_words(cause, value_words)


def cause_title(name: str) -> str:
    """Return a cause's name as people say it."""
    return name.replace("_", " ")


def cause_set_title(causes: Sequence[str]) -> str:
    """Return what a set of causes is called; the empty one: nothing is wrong."""
    return " + ".join(cause_title(name) for name in causes) or "nothing is wrong"


def _wrong_and_to_do(causes: Sequence[Cause]) -> list[tuple[str, str]]:
    """Return what is wrong, each with what to repair or check, causes without a rival first."""
    surest_first = sorted(causes, key=lambda cause: bool(cause.rivals))
    return [(f"{cause_summary(cause)}{_or_rival(cause)}", mechanism_class(cause.name).remedy) for cause in surest_first]


def _or_rival(cause: Cause) -> str:
    if not cause.rivals:
        return ""
    rivals = enumeration([cause_title(rival) for rival in cause.rivals], last=" or ")
    return f" (confidence {probability_words(cause.confidence)}; less likely, but not excluded: {rivals})"


def verdict_words(diagnosis: DiagnosisResult) -> str:
    """Return in plain sentences what is wrong and what to do, and which units differ more than units usually do."""
    other = max((one for one in diagnosis.units if one.is_unusual), key=_unlike, default=None)
    of_reference = "".join(f" {_unlike_words(*one)}" for one in diagnosis.unlike_in_reference.items())
    if diagnosis.verdict == "no_gap":
        return _no_gap_words(diagnosis, other) + of_reference
    beside = f" Beside that, {unit_words(other)}: more than units usually differ by." if other else ""
    return _gap_words(diagnosis) + beside + of_reference


def _unlike_words(vehicle: str, differences: Sequence[str]) -> str:
    """Return in words in what a vehicle of the reference is unlike its others."""
    what = enumeration([DIFFERENCES.get(one, one) for one in differences])
    return (
        f"Vehicle {vehicle} of the reference is unlike the others there in {what}, by more than units usually differ: "
        "if something is wrong with it, diagnose again without it (reference_vehicles=)."
    )


def _no_gap_words(diagnosis: DiagnosisResult, other: UnitDifference | None) -> str:
    if other:
        remedy = "calibrate it, or learn the simulation from it as well"
        return f"No gap was found beyond how units differ: {unit_words(other)}{DASH}{remedy}."
    if any(test.part == "spread" and test.found and test.explained > 0 for test in diagnosis.tests):
        return (
            "No gap was found in how the robot moves on average, but its errors scatter more than the ordinary "
            f"noise{DASH}look for what acts at random: a wheel out of round, a loose marker, a worse picture."
        )
    return (
        "No gap was found: within its ordinary noise the robot does what the simulation says, as far as this recording "
        "can show it; go on with the simulation."
    )


def _gap_words(diagnosis: DiagnosisResult) -> str:
    found = [f"{wrong}{DASH}{remedy}" for wrong, remedy in _wrong_and_to_do(diagnosis.causes)]
    because = enumeration(found, "; ", "; and because ")
    if diagnosis.verdict == "explained":
        return f"The robot departs from the simulation because {because}."
    if diagnosis.causes and diagnosis.not_confirmed:
        return (
            f"The robot departs from the simulation, and {because}; held-out runs do not show that this is why"
            f"{DASH}{_look_at(diagnosis)}."
        )
    if diagnosis.causes:
        return (
            f"The robot departs from the simulation, partly because {because}; something else is wrong that has no "
            f"name{DASH}{_look_at(diagnosis)}."
        )
    return f"The robot departs from the simulation, and no known cause explains it{DASH}{_look_at(diagnosis)}."


def unit_words(unit: UnitDifference) -> str:
    """Return in words how far a vehicle goes and turns of its own."""
    way, turn, *sides = (value_words("factor", one) for one in unit.factors)
    told = f"vehicle {unit.vehicle} goes {way} times as far and turns {turn} times as much as simulated"
    return f"{told}, and its left wheel is {sides[0]} times as fast beside the right one" if sides else told


def usual_words(unit: UnitDifference) -> str:
    """Return in words by how much units are expected to differ."""
    shares = [share_words(one.usual, 0 if round(100 * one.usual, 1) % 1 == 0 else 1) for one in unit.factors]
    if len({*shares}) == 1:
        return f"a standard deviation of {shares[0]}"
    what = ("how far they go", "how far they turn", "how fast left wheels are beside right ones")
    told = enumeration([f"{share} in {one}" for share, one in zip(shares, what, strict=False)])
    return f"standard deviations of {told}"


def _unlike(unit: UnitDifference) -> float:
    return max(abs(one.value - 1.0) for one in unit.factors)


def _look_at(diagnosis: DiagnosisResult) -> str:
    """Return what to do about what has no name."""
    explained = {test.part: test.explained for test in diagnosis.tests}
    unnamed = diagnosis.left_over if diagnosis.causes else diagnosis.left_over or diagnosis.depends_on
    most = sorted((part for part in unnamed if part in PARTS), key=lambda part: -explained.get(part, 0.0))[:3]
    what = f"look for what changed and goes with {_placed(most)}" if most else "look for what changed"
    return f"{what}, or learn the simulation anew from a recording made now"


def dependence_words(diagnosis: DiagnosisResult) -> str:
    """Return in sentences what the error depends on, how else it is unlike the ordinary noise, and what is left."""
    if diagnosis.verdict == "no_gap":
        found = sum(test.found for test in diagnosis.tests)
        if found:
            return (
                f"{found} of {len(diagnosis.tests)} tests show a difference from the reference, but taken together it "
                "is too little for an alarm."
            )
        return f"Nothing of what was tested ({len(diagnosis.tests)} questions) shows more than chance would."
    explained = {test.part: test.explained for test in diagnosis.tests}
    sentences = [f"The error depends on {placed}."] if (placed := _placed(diagnosis.depends_on)) else []
    for part, sentence in SHAPES.items():
        if part in diagnosis.depends_on:
            sentences.append(sentence.format("less" if explained.get(part, 0.0) < 0 else "more"))
    if diagnosis.extension != "none" and not diagnosis.not_confirmed:
        if placed := _placed(diagnosis.left_over):
            sentences.append(f"What the extension leaves depends on {placed}.")
        if shapes := [QUESTIONS[part] for part in SHAPES if part in diagnosis.left_over]:
            sentences.append(f"With the extension, {enumeration(shapes)} still differs from the ordinary noise.")
    return " ".join(sentences)


def _placed(parts: Sequence[str]) -> str:
    return enumeration([PARTS.get(part, part.replace("_", " ")) for part in parts if part not in SHAPES])


def enumeration(items: Sequence[str], comma: str = ", ", last: str = " and ") -> str:
    """Join items as in a sentence."""
    if len(items) < 2:
        return "".join(items)
    return comma.join(items[:-1]) + last + items[-1]


def gain_words(gain: Gain, unit: str) -> str:
    """Return by how much an error shrank, with its interval: `−6.8 mm (−7.1 to −6.5)`, and in percent."""
    change = gain.after - gain.before
    decimals = _decimals((gain.high - gain.low) / 2, change)
    change_text, best, worst = (f"{_number(number, decimals, '+')}" for number in (change, -gain.high, -gain.low))
    percent = f", {_number(100 * change / gain.before, 0, '+')}{SPACE}%" if gain.before else ""
    return f"{change_text}{SPACE}{unit} ({best} to {worst}){percent}"


def limit_words(limit: DetectionLimit) -> str:
    """Return the smallest value of a parameter that would have been named; where none would, so.

    It has two digits of how far it is from doing nothing.
    """
    if limit.value is None:
        return "not at any value in a recording like this"
    factor, sign = _unit_told(limit.parameter, limit.unit)
    parameter = mechanism_class(limit.cause).parameters.get(limit.parameter)
    usual = parameter.null_value or 0.0 if parameter and not limit.unit else 0.0
    size = factor * abs(limit.value - usual)
    decimals = max(0, 1 - math.floor(math.log10(size))) if size > 0 else 0
    weaker = " or less" if parameter and parameter.null_value == parameter.high else ""
    return f"{_number(factor * limit.value, min(decimals, 4))}{sign}{weaker}"


def measured_by(limit: DetectionLimit) -> str:
    """Return what a cause's size is measured by as people say it; a speed where it is the length of a velocity."""
    kind, name = mechanism_class(limit.cause), limit.parameter
    if kind.reported is not Mechanism.reported:
        alone = {field: float(field == name) for field in kind.model_fields if field != "name"}
        name = next(iter(kind.at(alone).reported()))
    return parameter_title(name)


def parameter_title(name: str) -> str:
    """Return a parameter's name as people say it, without its unit."""
    return re.sub(r"_(mm_s|mm|rad|deg|s)$", "", name).replace("_", " ")


def limits_words(diagnosis: DiagnosisResult) -> str:
    """Return what is meant by a cause that was not found."""
    meaning = (
        "A cause that is smaller than stated here may be there all the same. Had one been as large, "
        if diagnosis.verdict == "no_gap"
        else "What was not found may still be there, if it is small. Had a cause been as large as stated here, "
    )
    return (
        f"{meaning}it would have been named in nine of ten such recordings. Where a cause has further parameters, such "
        "as a place, a reach or a direction, this holds for the values of these at which it shows most."
    )


def posterior_words(diagnosis: DiagnosisResult) -> str:
    """Return how to read the probabilities of the leading sets of causes."""
    if diagnosis.verdict == "unexplained" and not diagnosis.causes:
        told = "; ".join(cause_words(one) for one in diagnosis.likeliest)
        values = f" If the likeliest set were all that is wrong: {told}." if told else ""
        return (
            "These probabilities assume that the true causes are in the catalogue. But no set of its causes explains "
            f"what was measured, or runs that nothing was fitted to speak against it: none is named.{values}"
        )
    lower = (
        " The confidence in a cause is lower, as some of its name were not there in trials, mostly since what was "
        "wrong was in no catalogue or acted by another law than its mechanism."
    )
    return (
        "These probabilities assume that the true causes are in the catalogue. A cause is named where the sets that "
        "hold it, or one that looks the same, have most of the probability together (90 %, if not set otherwise)."
        f"{lower if any(cause.confidence < cause.posterior for cause in diagnosis.causes) else ''}"
    )


def next_recording_words(plan: NextRecording) -> str:
    """Return what to record next, and what for."""
    drive = f"{plan.runs} runs of {plan.steps} steps with the commands in {plan.drive}, over and over"
    if plan.separates:
        apart = enumeration([cause_title(name) for name in plan.separates])
        return (
            f"Record next, to tell {apart} apart: {drive}. After it, the wrong one should be some "
            f"{odds_words(plan.expected_nats)} times less likely than the right one."
        )
    most = sorted(plan.lowers.items(), key=lambda one: one[1])[:3]
    lower = enumeration([f"{cause_title(name)} to {share_words(share)}" for name, share in most])
    return (
        f"To see smaller effects, record next {drive}. It would lower the limits below, as distances from having no "
        f"effect: {lower} of what they are."
    )


def probability_words(probability: float) -> str:
    """Return a probability in percent, with a decimal where it is next to none or nearly all."""
    if probability < 0.0005:
        return f"under 0.1{SPACE}%"
    if probability > 0.9995:
        return f"over 99.9{SPACE}%"
    return share_words(probability, 0 if 0.0995 <= probability <= 0.9905 else 1)


def share_words(share: float, decimals: int = 0) -> str:
    """Return a share in percent."""
    return f"{_number(100 * share, decimals)}{SPACE}%"


def odds_words(nats: float) -> str:
    """Return an expected log-likelihood ratio as how many times less likely the wrong cause becomes."""
    return f"{float(f'{math.exp(min(nats, math.log(1e6))):.1g}'):,.0f}"


class _Told(NamedTuple):
    """A parameter, or the word for a form; formatted by `ahead/behind` the one for its sign, or its place."""

    words: str = ""
    place: int = 0

    def __format__(self, choices: str) -> str:
        if not choices:
            return self.words
        offered = choices.split("/")
        return offered[min(self.place, len(offered) - 1)]


def _filled_words(cause: EstimatedCause, tell: Callable[[str, Estimate], str]) -> str:
    """Fill in a cause's words; what this robot does not have stays empty."""
    mechanism = mechanism_class(cause.name)
    directed = {name for _, name, directions, _ in Formatter().parse(mechanism.words) if directions}
    told = {
        name: _Told(tell(name, _size(estimate) if name in directed else estimate), int(estimate.value < 0))
        for name, estimate in cause.parameters.items()
    }
    forms = mechanism.usual_form() | cause.form
    form = {name: _Told(words, _place_among_forms(mechanism, name, words)) for name, words in forms.items()}
    return mechanism.words.format_map(defaultdict(_Told, form | told))


def _place_among_forms(mechanism: type[Mechanism], field: str, word: str) -> int:
    """Return the place of a word among those that a field of a mechanism's form may hold, 0 for the usual one."""
    known = get_args(mechanism.model_fields[field].annotation) if field in mechanism.model_fields else ()
    words = [mechanism.usual_form().get(field), *known, word]
    return list(dict.fromkeys(words)).index(word)


def _size(estimate: Estimate) -> Estimate:
    """Return an estimate without its sign."""
    if estimate.value >= 0:
        return estimate
    return estimate.model_copy(update={"value": -estimate.value, "low": -estimate.high, "high": -estimate.low})


def _manner(name: str, estimate: Estimate) -> tuple[float, str, int]:
    """Return how a parameter is told: the factor on it, its unit, and how many decimals."""
    factor, unit = _unit_told(name, estimate.unit)
    return factor, unit, _decimals(factor * (estimate.high - estimate.low) / 2, factor * estimate.value)


def _unit_told(name: str, unit: str) -> tuple[float, str]:
    """Return the factor on a parameter of a unit and the sign behind it, by which a person is told of it."""
    if not unit and name in SHARES:
        return 100.0, f"{SPACE}%"
    return UNITS.get(unit, (1.0, f"{SPACE}{unit}"))


def _decimals(half_width: float, value: float) -> int:
    """Return how many decimals the interval's half width lets a value have: its first digit is told, of 1 the next."""
    size = half_width / 1.5 or abs(value) / 100
    return min(max(0, -math.floor(math.log10(size))), 4) if size > 0 else 0


def _number(value: float, decimals: int, sign: str = "") -> str:
    """Write a number with a proper minus, never −0."""
    return f"{round(value, decimals) + 0.0:{sign},.{decimals}f}".replace("-", "−")
