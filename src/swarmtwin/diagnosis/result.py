"""Step 4. What a diagnosis says, the content of `diagnosis.json`, and what its pictures need."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from swarmtwin.robot import StrictModel
from swarmtwin.simulation.open_loop import OpenLoop
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.transitions import Transitions

Verdict = Literal["explained", "no_gap", "unexplained"]
Extension = Literal["mechanisms", "learned_residual", "mechanisms_and_learned_residual", "none"]


def _significant(value: float) -> float:
    return float(f"{value:.6g}") + 0.0  # never −0


Number = Annotated[float, AfterValidator(_significant)]
"""A figure with six digits: what lies beyond differs from machine to machine, and means nothing."""


Share = Annotated[float, Field(ge=0, le=1), AfterValidator(_significant)]

ENDS = (0.025, 0.975)  # quantiles at which an interval ends


class Estimate(StrictModel):
    """A parameter of a mechanism, with the 95 % interval that holds the true one in 95 of 100 sessions."""

    value: Number
    low: Number
    high: Number
    unit: str


class EstimatedCause(StrictModel):
    """A cause with its values.

    Attributes:
        name: of the mechanism, one of the catalogue.
        parameters: by name.
        form: what a cause of several forms acts on, in words, by the mechanism's fields.
    """

    name: str
    parameters: dict[str, Estimate]
    form: dict[str, str] = Field(default_factory=dict)


class Cause(EstimatedCause):
    """A named cause.

    Attributes:
        posterior: probability that it is there if what is wrong is in the catalogue, summed over all sets of causes.
        confidence: probability that it is there: `posterior` times how often what is named so is right
            (`VerdictSettings.confidence`). In files of earlier versions the posterior probability.
        rivals: causes that share `posterior` with it, in sets without it.
        share_of_gap: of the squared error that can be explained at all, the part that this cause explains.
        evidence: one sentence that a person can read.
    """

    posterior: Share
    confidence: Share
    rivals: tuple[str, ...]
    share_of_gap: Share
    evidence: str

    @model_validator(mode="before")
    @classmethod
    def _of_earlier_versions(cls, content: Any) -> Any:
        """Take the one probability that was told for the posterior."""
        if isinstance(content, Mapping) and "confidence" in content:
            return {"posterior": content["confidence"], **content}
        return content


class CauseSet(StrictModel):
    """A set of causes, and how probable it is that these are there and no other.

    Attributes:
        causes: names; none: nothing is wrong.
        probability: posterior, over all sets that were fitted; the forms that a cause may take summed up.
        log_evidence: nats by which the session speaks for them over nothing, their parameters integrated out.
    """

    causes: tuple[str, ...]
    probability: Share
    log_evidence: Number


class Gain(StrictModel):
    """An error on held-out runs with the simulation as it was and as it is extended.

    Attributes:
        before: of the simulation.
        after: of the extended simulation; the same as before where nothing was extended.
        low: lower end of the 95 % interval of before − after, by bootstrap over runs.
        high: its upper end.
    """

    before: Number
    after: Number
    low: Number
    high: Number

    @property
    def change_words(self) -> str:
        """The interval in words, such as `0.42 to 0.58 less`."""
        low, high = f"{abs(self.low):.2f}", f"{abs(self.high):.2f}"
        if self.high < 0:
            return f"{high} to {low} more"
        return f"{low} to {high} less" if self.low >= 0 else f"{low} more to {high} less"


class WindowGain(Gain):
    """Root mean square error of positions over windows of one length in open loop, its mean over windows.

    Attributes:
        window_s: the length.
        before_sd: standard deviation over windows, of the simulation.
        after_sd: likewise, of the extended simulation.
        pieces: windows, one after the other in each run, each predicted from a measured pose.
        runs: held-out runs, or blocks of them, that are long enough to hold one; they are what the interval is over.
    """

    window_s: Number
    before_sd: Number
    after_sd: Number
    pieces: int
    runs: int


class Gains(StrictModel):
    """The gain on runs that nothing was fitted to.

    Attributes:
        position_mm: after one period.
        orientation_deg: likewise.
        open_loop_mm: root mean square over whole runs, predicted from their first pose and the commands alone.
        ten_periods_mm: likewise over ten periods, from poses all over the runs; None in results of older versions.
        open_loop_windows: likewise over 2, 5, 10 and 30 s (`diagnosis.verdict.windows_s`), without those that fewer
            than two held-out runs are long enough for. Nothing is decided by them. Empty in older files.
    """

    position_mm: Gain
    orientation_deg: Gain
    open_loop_mm: Gain
    ten_periods_mm: Gain | None = None
    open_loop_windows: tuple[WindowGain, ...] = ()


class Dependence(StrictModel):
    """One test of what the residual depends on.

    Attributes:
        part: of the situation: command, previous_command, heading, position, wall_distance, time, duration, neighbours,
            vehicle; or of the residual's own shape: spread, tails.
        statistic: of the test.
        p_value: chance of one as large where nothing depends on it; runs are the blocks.
        explained: share of the residual's variance that goes with it; how much wider than the reference's for spread
            and tails.
        found: whether it stands after control of the false discovery rate over all tests, and matters.
    """

    part: str
    statistic: Number
    p_value: Share
    explained: Number
    found: bool


class NextRecording(StrictModel):
    """The drive that would separate rivals or, where nothing is wrong, show smaller effects.

    Attributes:
        separates: names of the causes it tells apart; none where it is to show smaller effects.
        lowers: causes that would be named from a smaller size on, each with the share of its limit that remains.
        drive: name of a CSV file beside `diagnosis.json` with the robot's command columns, for `collect drive=FILE` or
            `record drive=FILE`.
        runs: how many runs.
        steps: transitions in a run.
        expected_nats: expected log-likelihood ratio between the two best rivals after it, in nats; 5 decides. 0 where
            there are none.
        command: how to record it, for a person.
    """

    separates: tuple[str, ...]
    lowers: dict[str, Number] = Field(default_factory=dict)
    drive: str
    runs: int
    steps: int
    expected_nats: Number
    command: str


class UnitFactor(Estimate):
    """By which factor a vehicle does something otherwise than is simulated; 1 as simulated.

    Attributes:
        usual: standard deviation by which units are expected to differ in it.
    """

    usual: Number

    @property
    def is_unusual(self) -> bool:
        """Whether it differs by more than one standard deviation of units, and of chance by two."""
        return abs(self.value - 1.0) > self.usual and not self.low <= 1.0 <= self.high


class UnitDifference(StrictModel):
    """What a vehicle that the simulation does not know by itself does otherwise: units differ, and that is no gap.

    Attributes:
        vehicle: its id.
        way: how far it goes ahead, over what is simulated.
        turn: how far it turns, likewise.
        left_to_right: how fast its left wheel is to its right one, likewise; null where the robot has no such wheels.
    """

    vehicle: str
    way: UnitFactor
    turn: UnitFactor
    left_to_right: UnitFactor | None = None

    @model_validator(mode="before")
    @classmethod
    def _of_format_1(cls, content: Any) -> Any:
        """Give each factor the one standard deviation that was told for all."""
        if not isinstance(content, Mapping) or "usual" not in content:
            return content
        rest = {name: one for name, one in content.items() if name != "usual"}
        usual = {"usual": content["usual"]}
        return {name: {**one, **usual} if isinstance(one, Mapping) else one for name, one in rest.items()}

    @property
    def is_unusual(self) -> bool:
        """Whether it differs in any of these by more than units usually do."""
        return any(one.is_unusual for one in self.factors)

    @property
    def factors(self) -> tuple[UnitFactor, ...]:
        """All that is told of it; 1 as simulated."""
        known = self.way, self.turn, self.left_to_right
        return tuple(one for one in known if one is not None)


class DetectionLimit(StrictModel):
    """The smallest effect of a cause that the session would have shown, and by this name.

    Attributes:
        cause: its name.
        parameter: that measures its size.
        value: of that parameter at which the cause would have been named with a probability of 90 %, other parameters
            at the grid point where this is smallest; null where no value within the bounds would.
        unit: of it.
        share_of_range: its distance from doing nothing, as a share of the bounds' distance.
        rival: the cause that a smaller one may be taken for; null where it would rather not be seen at all.
    """

    cause: str
    parameter: str
    value: Number | None
    unit: str
    share_of_range: Share
    rival: str | None = None


class DiagnosisResult(StrictModel):
    """The content of `diagnosis.json`.

    Attributes:
        verdict: `explained`: the causes explain what can be explained, which held-out runs confirm; `no_gap`: nothing
            is wrong; `unexplained`: something is wrong that the catalogue does not explain, or not all of it.
        causes: by share of the gap, largest first.
        depends_on: what the simulation's residual depends on, also where no cause explains it.
        gain: on held-out runs.
        next_recording: where rivals cannot be told apart, or where nothing is wrong and smaller effects could be shown.
        left_over: what the extended simulation's residual still depends on, on held-out runs.
        tests: every test of the simulation's residual.
        robot: its name.
        vehicles: ids of the measured vehicles.
        runs: measured runs: fitted to, held out.
        transitions: measured transitions: used, set aside because the reference never saw such commands; rows left out
            of a recording that is longer than what is compared.
        extension: what the extended simulation adds: mechanisms, a learned residual, or nothing.
        not_confirmed: why held-out runs do not confirm the extension; it is then not kept, and no cause is named but
            what the clock itself shows. Null where they do, or where there is none.
        not_registered: why the extension is kept but not registered though they confirm it. Null otherwise.
        units: what vehicles that the reference does not know do otherwise by fabrication. Empty in older files.
        unlike_in_reference: ids of the reference's own vehicles that are unlike its others by more than units differ:
            in which differences, as `unit_spread` names them, the clearest first. Empty in older files.
        detection_limits: for each cause, the smallest that the session would have shown.
        posterior: the leading sets of causes, the most probable first; that of no cause is among them. A changed noise
            is weighed apart. Empty in files that are older.
        likeliest: the causes of the most probable set, named or not, with values as they would be told; without those
            that may as well do nothing. Empty where nothing is wrong, and in older files.
        doubts: what is unusual of the measured recording as a whole, and may be meant. Empty in older files.
        seed: of everything random.
        format: changes when older versions cannot read the file.
    """

    verdict: Verdict
    causes: tuple[Cause, ...]
    depends_on: tuple[str, ...]
    gain: Gains
    next_recording: NextRecording | None
    left_over: tuple[str, ...]
    tests: tuple[Dependence, ...]
    robot: str
    vehicles: tuple[str, ...]
    runs: dict[str, int]
    transitions: dict[str, int]
    extension: Extension
    not_confirmed: str | None = None
    not_registered: str | None = None
    units: tuple[UnitDifference, ...] = ()
    unlike_in_reference: dict[str, tuple[str, ...]] = Field(default_factory=dict)
    detection_limits: tuple[DetectionLimit, ...] = ()
    posterior: tuple[CauseSet, ...] = ()
    likeliest: tuple[EstimatedCause, ...] = ()
    doubts: tuple[str, ...] = ()
    seed: int
    format: Literal[1, 2] = 2


@dataclass(frozen=True)
class DiagnosedSession:
    """A diagnosis with the session that it was made of.

    Attributes:
        result: what it says.
        simulation: the simulation that was examined.
        extended: the simulation with the mechanisms found, or with a learned residual, whether or not held-out runs
            confirm it; None where nothing is wrong.
        transitions: the N measured transitions that were looked at.
        held_out: (N,) those that nothing was fitted to.
        residual_before: (N, 3) measured minus simulated displacement (forward, left, turn), made independent
            of each other and divided by the reference's own noise there: about 1 in size where nothing is wrong,
            and then less what units and the simulation's uncertainty explain.
        residual_after: (N, 3) likewise, of the extended simulation; the same array where there is none.
        runs_before: held-out runs predicted open loop by the simulation.
        runs_after: the same runs predicted by the extended simulation.
        next_drive: (P, m) commands that would separate rivals, None where that is not needed.
    """

    result: DiagnosisResult
    simulation: Simulation
    extended: Simulation | None
    transitions: Transitions
    held_out: np.ndarray
    residual_before: np.ndarray
    residual_after: np.ndarray
    runs_before: tuple[OpenLoop, ...]
    runs_after: tuple[OpenLoop, ...]
    next_drive: np.ndarray | None
