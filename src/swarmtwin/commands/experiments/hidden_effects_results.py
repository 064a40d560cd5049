"""What came of each case: one line in a file that an interrupted study continues, later one row of results.csv."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from swarmtwin.commands.experiments.hidden_effects_cases import Case
from swarmtwin.gap.diagnosis import Verdict
from swarmtwin.robot import StrictModel


class Suspect(StrictModel):
    """A cause that was named, and those that the session cannot tell from it."""

    name: str
    rivals: tuple[str, ...] = ()
    confidence: float = 1.0
    share_of_gap: float = 1.0


class Parameter(StrictModel):
    """A parameter of a cause that was named and true: what it is, and what was said of it with a 95 % interval."""

    cause: str
    name: str
    true: float
    value: float
    low: float
    high: float
    unit: str


class Gained(StrictModel):
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

    @property
    def harm_percent(self) -> float:
        """By how much the extension made the error larger."""
        return 100.0 * max(0.0, self.after_mm / self.before_mm - 1.0)


class Baselines(StrictModel):
    """What other methods made of the same case.

    Attributes:
        fitted: causes that parameter fitting without model choice holds for proven, the surest first.
        rule: the cause that the largest correlation suggests.
        black_box: what a black-box residual gained.
    """

    fitted: tuple[str, ...]
    rule: str | None
    black_box: Gained


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
    verdict: Verdict | None
    failure: str | None
    causes: tuple[Suspect, ...]
    parameters: tuple[Parameter, ...]
    depends_on: tuple[str, ...]
    gained: Gained | None
    baselines: Baselines | None
    seconds: float

    @property
    def names(self) -> tuple[str, ...]:
        """The causes named, in order."""
        return tuple(cause.name for cause in self.causes)

    @property
    def is_found(self) -> bool:
        """Whether the diagnosis said that something is wrong."""
        return self.verdict in ("explained", "unexplained")

    @property
    def is_named_first(self) -> bool:
        """Whether the first cause named is a true one."""
        return bool(self.causes) and self.causes[0].name in self.case.true_names

    @property
    def is_listed(self) -> bool:
        """Whether every true cause is named or a rival of one that is."""
        listed = {name for cause in self.causes for name in (cause.name, *cause.rivals)}
        return bool(self.case.true_names) and set(self.case.true_names) <= listed

    @property
    def is_exact(self) -> bool:
        """Whether the causes named are the true ones, all of them and no other."""
        return self.verdict is not None and sorted(self.names) == sorted(self.case.true_names)

    def row(self) -> dict[str, Any]:
        """Return its row of results.csv."""
        case, gained, others = self.case, self.gained, self.baselines
        return {
            "kind": case.kind,
            "variety": case.variety,
            "robot": case.robot,
            "rise_percent": round(self.rise_percent, 2),
            "verdict": self.verdict or "failed",
            "named": "+".join(self.names),
            "rivals": "+".join(rival for cause in self.causes for rival in cause.rivals),
            "named_first": self.is_named_first,
            "listed": self.is_listed,
            "exact": self.is_exact,
            "depends_on": "+".join(self.depends_on),
            **({name: _rounded(value) for name, value in gained} if gained else {}),
            "fitting": "+".join(others.fitted) if others else None,
            "rule": others.rule if others else None,
            "black_box_after_mm": _rounded(others.black_box.after_mm) if others else None,
            "black_box_share": _rounded(others.black_box.share) if others else None,
            "runs": case.runs,
            "steps": case.steps,
            "vehicles": " ".join(case.vehicles),
            "manner": case.manner,
            "pose_noise": case.pose_noise,
            "effects": json.dumps(case.effects),
            "seed": case.seed,
            "reference": case.reference,
            "seconds": round(self.seconds, 2),
            "failure": self.failure,
        }


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 4)


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
