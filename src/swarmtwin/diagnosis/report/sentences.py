"""What a report says in words: numbers with their intervals, verdicts, causes and what residuals depend on."""

import math
from collections import defaultdict
from collections.abc import Callable, Sequence

from swarmtwin.diagnosis.result import Cause, DetectionLimit, DiagnosisResult, Estimate, Gain
from swarmtwin.simulation.mechanism import mechanism_class

SPACE = "\N{NO-BREAK SPACE}"
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
SHAPES = {
    "spread": "Errors scatter {} than the ordinary noise.",
    "tails": "Large errors are {} common than they were.",
}
ONE_WHEEL = ("gain_change", "actuator_asymmetry")  # causes that one weak wheel is told as
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


def cause_words(cause: Cause) -> str:
    """Return what a cause is, its numbers with their intervals."""
    return _told(cause, estimate_words)


def cause_summary(cause: Cause) -> str:
    """Return what a cause is, its numbers alone."""
    return _told(cause, value_words)


def cause_title(name: str) -> str:
    """Return a cause's name as people say it."""
    return name.replace("_", " ")


def remedies(diagnosis: DiagnosisResult) -> list[tuple[str, str]]:
    """Return what to repair or check, each with the cause that it is for."""
    weak = _weak_wheel(diagnosis.causes)
    others = [cause for cause in diagnosis.causes if not weak or cause.name not in ONE_WHEEL]
    told = [(cause_title(cause.name), mechanism_class(cause.name).remedy) for cause in others]
    return [(f"{weak[0]} wheel", "check its motor, gear and tyre"), *told] if weak else told


def _weak_wheel(causes: Sequence[Cause]) -> tuple[str, float] | None:
    """Return the side and the speed of one wheel where two causes together say that the other one is as it was."""
    parameters = {cause.name: cause.parameters for cause in causes}
    if not set(ONE_WHEEL) <= parameters.keys() or "ratio" not in parameters["actuator_asymmetry"]:
        return None
    gain, ratio = parameters["gain_change"]["gain"], parameters["actuator_asymmetry"]["ratio"]
    spread = math.hypot(_relative(gain), _relative(ratio) / 2)
    for side, power in (("left", 0.5), ("right", -0.5)):
        if abs(math.log(gain.value * ratio.value**-power)) <= spread:
            return side, gain.value * ratio.value**power
    return None


def _relative(estimate: Estimate) -> float:
    return (estimate.high - estimate.low) / 2 / estimate.value


def verdict_words(diagnosis: DiagnosisResult) -> str:
    """Return the verdict in one plain sentence."""
    weak = _weak_wheel(diagnosis.causes)
    told = [f"the {weak[0]} wheel runs at {weak[1]:.2f} of its speed"] if weak else []
    told += [cause_summary(cause) for cause in diagnosis.causes if not weak or cause.name not in ONE_WHEEL]
    causes = enumeration(told, "; ", "; and ")
    if diagnosis.verdict == "no_gap":
        return "Nothing is wrong: the simulation does what the robot did, within the ordinary noise."
    if diagnosis.not_confirmed:
        return f"The robot departs from the simulation, and no known cause explains it: {diagnosis.not_confirmed}."
    if diagnosis.verdict == "explained":
        return f"The robot departs from the simulation because {causes}."
    if diagnosis.causes:
        return f"The robot departs from the simulation, partly because {causes}. Something else remains without a name."
    return "The robot departs from the simulation, and no known cause explains it."


def dependence_words(diagnosis: DiagnosisResult) -> str:
    """Return in sentences what the error depends on, how else it is unlike the ordinary noise, and what is left."""
    explained = {test.part: test.explained for test in diagnosis.tests}
    sentences = [f"What is off depends on {placed}."] if (placed := _placed(diagnosis.depends_on)) else []
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
    """Return the smallest value of a parameter that would have been named, with two digits; where none would, so."""
    if limit.value is None:
        return "not at any value"
    unit, size = limit.unit, abs(limit.value)
    factor, sign = UNITS.get(unit, (1.0, f"{SPACE}{unit}"))
    decimals = max(0, 1 - math.floor(math.log10(factor * size))) if size > 0 else 0
    return f"{_number(factor * limit.value, min(decimals, 4))}{sign}"


def share_words(share: float, decimals: int = 0) -> str:
    """Return a share in percent."""
    return f"{_number(100 * share, decimals)}{SPACE}%"


def odds_words(nats: float) -> str:
    """Return an expected log-likelihood ratio as how many times less likely the wrong cause becomes."""
    return f"{float(f'{math.exp(min(nats, math.log(1e6))):.1g}'):,.0f}"


def _told(cause: Cause, tell: Callable[[str, Estimate], str]) -> str:
    """Fill in a cause's words; what this robot does not have stays empty."""
    told = {name: tell(name, estimate) for name, estimate in cause.parameters.items()}
    return mechanism_class(cause.name).words.format_map(defaultdict(str, told))


def _manner(name: str, estimate: Estimate) -> tuple[float, str, int]:
    """Return how a parameter is told: the factor on it, its unit, and how many decimals."""
    if not estimate.unit and name in SHARES:
        factor, unit = 100.0, f"{SPACE}%"
    else:
        factor, unit = UNITS.get(estimate.unit, (1.0, f"{SPACE}{estimate.unit}"))
    return factor, unit, _decimals(factor * (estimate.high - estimate.low) / 2, factor * estimate.value)


def _decimals(half_width: float, value: float) -> int:
    """Return how many decimals the interval's half width lets a value have: its first digit is told, of 1 the next."""
    size = half_width / 1.5 or abs(value) / 100
    return min(max(0, -math.floor(math.log10(size))), 4) if size > 0 else 0


def _number(value: float, decimals: int, sign: str = "") -> str:
    """Write a number with a proper minus, never −0."""
    return f"{round(value, decimals) + 0.0:{sign},.{decimals}f}".replace("-", "−")
