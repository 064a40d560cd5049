"""What the paper claims, as comparisons of trainings: sentences and verdicts follow from the figures alone."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Literal

from pydantic import Field

from swarmtwin.robot import StrictModel
from swarmtwin.studies.training_grid.comparison import (
    FAILS,
    HOLDS,
    OPEN,
    Difference,
    Judging,
    Relation,
    Verdict,
    compare,
    overall,
)
from swarmtwin.studies.training_grid.measured_errors import RunErrors
from swarmtwin.studies.training_grid.table_file import Quantity
from swarmtwin.studies.training_grid.trainings import FieldName, Selector, Training, chosen

ControlKind = Literal["plain_mlp", "equal_steps", "without_generator", "other_generator"]

CONTROLS: dict[ControlKind, str] = {
    "plain_mlp": "against the plain MLP, which the paper lacks",
    "equal_steps": "at equal numbers of optimiser steps instead of epochs",
    "without_generator": "without a generator, by the same number of steps on the real transitions alone",
    "other_generator": "with another generator than the paper's",
}

Finding = Literal[
    "holds",
    "fails",
    "open",
    "beats_plain_mlp",
    "weak_baselines",
    "some_baselines",
    "some_epochs",
    "equal_steps",
    "counting_epochs",
    "needless_generator",
    "other_generator",
]

FINDINGS: dict[Finding, str] = {
    "holds": "holds on our data",
    "fails": "does not hold on our data",
    "open": "cannot be told on our data",
    "beats_plain_mlp": "the plain MLP is beaten as well",
    "weak_baselines": "it rests on weak baselines: that the plain MLP is beaten is not borne out",
    "some_baselines": "some of its comparisons hold; that the plain MLP is beaten is not borne out",
    "some_epochs": "some of its comparisons hold at equal epochs; at equal numbers of steps it is not borne out",
    "equal_steps": "it holds at equal numbers of steps as well",
    "counting_epochs": "it rests on counting epochs: at equal numbers of steps it is not borne out",
    "needless_generator": "no generator is needed for it: as many steps on the few real transitions alone do it too",
    "other_generator": "with another generator than the paper's it holds",
}

PLACES = {
    "train_vehicle": "the vehicle learned from",
    "other_vehicle": "another vehicle",
    "open_loop": "the runs kept for open loop",
}


class Comparisons(StrictModel):
    """Which trainings are compared with which.

    Attributes:
        of: those that something is claimed of.
        than: those that they are compared with.
        same: fields that both sides of a pair agree in.
        relation: what is claimed of each pair.
        quantity: of which error.
        recording: on which.
    """

    of: Selector
    than: Selector
    same: tuple[FieldName, ...] = ()
    relation: Relation
    quantity: Quantity = "position_mm"
    recording: Literal["train_vehicle", "other_vehicle", "open_loop"] = "other_vehicle"

    def pairs(self, trainings: Sequence[Training]) -> Iterator[tuple[Training, Training]]:
        """Yield the pairs that are among some trainings; a training is not compared with itself."""
        for first in chosen(trainings, self.of):
            for second in chosen(trainings, self.than):
                agree = all(getattr(first, name) == getattr(second, name) for name in self.same)
                if agree and first != second:
                    yield first, second


class Claim(Comparisons):
    """A sentence of the paper, and the comparisons that would bear it out.

    Attributes:
        says: the sentence, in our words.
        where: in the paper.
        ours: whether it is no claim of the paper's, but what its comparison lacks.
        controls: what the paper did not compare, by what is controlled for.
    """

    says: str
    where: str
    ours: bool = False
    controls: dict[ControlKind, Comparisons] = Field(default_factory=dict)


class Compared(StrictModel):
    """What came of one pair.

    Attributes:
        of: what something is claimed of, in words.
        than: what it is compared with.
        sentence: what was found.
        verdict: whether that bears the claim out.
    """

    of: str
    than: str
    sentence: str
    verdict: Verdict


class Judged(StrictModel):
    """What came of some comparisons together."""

    verdict: Verdict
    compared: tuple[Compared, ...]

    @property
    def held(self) -> str:
        """How many of them hold."""
        count = sum(one.verdict == HOLDS for one in self.compared)
        return f"{count} of {len(self.compared)} comparisons"


class JudgedClaim(StrictModel):
    """A claim of the paper, judged on our data, and its controls.

    Attributes:
        says: the claim.
        where: in the paper.
        ours: whether it is no claim of the paper's.
        judged: the paper's own comparisons.
        controls: those that it lacks.
        findings: what follows from both.
    """

    says: str
    where: str
    ours: bool = False
    judged: Judged
    controls: dict[ControlKind, Judged]
    findings: tuple[Finding, ...]

    @property
    def conclusion(self) -> str:
        """What follows, in words."""
        return "; ".join(FINDINGS[finding] for finding in self.findings)


Errors = Mapping[Training, Mapping[str, Mapping[int, RunErrors]]]
"""The errors by run of each training, by recording and then by live seed."""


def judge(claim: Claim, errors: Errors, real: int, judging: Judging) -> JudgedClaim | None:
    """Judge a claim; None where its trainings are not among those made.

    Args:
        claim: of the paper.
        errors: of all trainings made.
        real: how many real transitions there are, for words.
        judging: how comparisons are judged.
    """
    judged = _judged(claim, errors, real, judging)
    if not judged.compared:
        return None
    found = {kind: _judged(control, errors, real, judging) for kind, control in claim.controls.items()}
    controls = {kind: control for kind, control in found.items() if control.compared}
    some_hold = any(one.verdict == HOLDS for one in judged.compared)
    findings = conclude(judged.verdict, {kind: control.verdict for kind, control in controls.items()}, some_hold)
    return JudgedClaim(
        says=claim.says, where=claim.where, ours=claim.ours, judged=judged, controls=controls, findings=findings
    )


def conclude(verdict: Verdict, controls: Mapping[ControlKind, Verdict], some_hold: bool = False) -> tuple[Finding, ...]:
    """Return what a claim's own comparisons and its controls mean together.

    Args:
        verdict: of its own comparisons together.
        controls: of each of its controls.
        some_hold: whether at least one of its own comparisons holds.
    """
    own: dict[Verdict, Finding] = {HOLDS: "holds", FAILS: "fails", OPEN: "open"}
    findings = [own[verdict]]
    if verdict == HOLDS and "plain_mlp" in controls:
        findings.append("beats_plain_mlp" if controls["plain_mlp"] == HOLDS else "weak_baselines")
    if verdict != HOLDS and some_hold and controls.get("plain_mlp") in (FAILS, OPEN):
        findings.append("some_baselines")
    if verdict != HOLDS and some_hold and controls.get("equal_steps") in (FAILS, OPEN):
        findings.append("some_epochs")
    if verdict == HOLDS and "equal_steps" in controls:
        findings.append("equal_steps" if controls["equal_steps"] == HOLDS else "counting_epochs")
    if controls.get("without_generator") == HOLDS:
        findings.append("needless_generator")
    if verdict != HOLDS and controls.get("other_generator") == HOLDS:
        findings.append("other_generator")
    return tuple(findings)


def _judged(comparisons: Comparisons, errors: Errors, real: int, judging: Judging) -> Judged:
    compared = tuple(_compared(comparisons, pair, errors, real, judging) for pair in comparisons.pairs(list(errors)))
    return Judged(verdict=overall([one.verdict for one in compared]), compared=compared)


def _compared(
    comparisons: Comparisons, pair: tuple[Training, Training], errors: Errors, real: int, judging: Judging
) -> Compared:
    first, second = (training.title(real) for training in pair)
    own = [errors[training].get(comparisons.recording, {}) for training in pair]
    found = compare(own[0], own[1], comparisons.quantity, judging)
    if found is None:
        dead = [title for title, by_seed in zip((first, second), own, strict=True) if not by_seed]
        reason = f"{' and '.join(dead)} has no live seed" if dead else "no seed of both is alive"
        return Compared(of=first, than=second, sentence=f"{first} against {second}: {reason}", verdict=OPEN)
    verdict = found.verdict(comparisons.relation, judging)
    return Compared(
        of=first,
        than=second,
        sentence=f"{_sentence(first, second, comparisons, found)}: {_meaning(comparisons.relation, verdict, judging)}",
        verdict=verdict,
    )


def _sentence(first: str, second: str, comparisons: Comparisons, found: Difference) -> str:
    unit = {"position_mm": "mm", "orientation_deg": "°", "open_loop_mm": "mm"}[comparisons.quantity]
    kind = "open loop" if comparisons.quantity == "open_loop_mm" else "a step"
    change = found.difference / found.other_error if found.other_error else 0.0
    return (
        f"{first} errs {found.error:.2f} {unit} {kind} on {PLACES[comparisons.recording]}, {second} "
        f"{found.other_error:.2f}: {found.difference:+.2f} {unit} ({change:+.1%}; 95 % interval {found.low:+.2f} to "
        f"{found.high:+.2f}; {found.seeds} {'seed' if found.seeds == 1 else 'seeds'}, {found.runs} runs)"
    )


def _meaning(relation: Relation, verdict: Verdict, judging: Judging) -> str:
    margin = f"{judging.margin:.0%}"
    words = {
        "better": ("better", "not better", "which is better cannot be told"),
        "not_worse": ("at least equivalent", f"worse by more than {margin}", f"whether within {margin} cannot be told"),
        "not_better": ("no improvement", f"better by more than {margin}", f"whether within {margin} cannot be told"),
    }[relation]
    return words[(HOLDS, FAILS, OPEN).index(verdict)]
