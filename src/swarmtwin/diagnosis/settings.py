"""What can be set of a diagnosis: every threshold, with its default and what it decides.

The defaults stand in `conf/diagnosis/default.yaml` as well; a test compares both. They were chosen on stand-ins, in
sessions other than those that the hidden-effects study reports on.
"""

from typing import Annotated

from pydantic import Field

from swarmtwin.robot import Positive, StrictModel

Count = Annotated[int, Field(ge=1)]
Share = Annotated[float, Field(ge=0, le=1)]
NonNegative = Annotated[float, Field(ge=0)]


class ReferenceSettings(StrictModel):
    """What a reference must hold, and which measured transitions it can speak for.

    Attributes:
        folds: parts of the runs; each is predicted by a simulation that was learned without it.
        fewest_runs: of a recording from which anything is concluded; runs are the blocks of every statistic.
        fewest_transitions: likewise, of transitions that follow another one.
        coverage_neighbours: reference commands whose distance says whether a measured command is covered.
        coverage_distance: largest such distance, over the median distance within the reference itself.
        overlap_neighbours: reference transitions that each measured one counts for, when the reference is weighted to
            stand for what it would show if it were driven as the session was.
    """

    folds: Annotated[int, Field(ge=2)] = 6
    fewest_runs: Count = 8
    fewest_transitions: Count = 400
    coverage_neighbours: Count = 10
    coverage_distance: Positive = 4.0
    overlap_neighbours: Count = 5


class NoiseSettings(StrictModel):
    """How the reference's noise is learned.

    Attributes:
        ridge: on how the log standard deviation grows with the motion, per squared unit: few data must not bend it.
        largest_motion: multiples of the usual motion beyond which the noise grows no more.
        clip_z: standardised residuals are clipped here before their correlation is taken.
        clip_squared: squared residuals, over their median size, are clipped here: outliers do not set the spread.
        degrees_of_freedom: candidates for the tails (Student's t).
        normal_from: degrees of freedom from which on tails count as normal.
    """

    ridge: NonNegative = 1e-3
    largest_motion: Positive = 3.0
    clip_z: Positive = 4.0
    clip_squared: Positive = 25.0
    degrees_of_freedom: tuple[Positive, ...] = (4.0, 5.0, 7.0, 10.0, 15.0, 30.0, 100.0)
    normal_from: Positive = 100.0


class UnitSettings(StrictModel):
    """How much two units of a robot are expected to differ by fabrication.

    Attributes:
        spread: standard deviation, as a share, of a unit's speeds and of its left-right difference (of a trim, in rad),
            where nothing else is known: cheap gear motors are sold with ±10 %, two standard deviations. It is for any
            robot; a robot's file states its own where units were measured.
        prior_units: how many units that prior counts for against those that a reference has recorded.
    """

    spread: Positive = 0.05
    prior_units: Positive = 2.0


class DependenceSettings(StrictModel):
    """The tests of what a residual depends on.

    Attributes:
        draws: sign flips, or resamples, of whole runs that stand for chance.
        false_discovery_rate: Benjamini and Hochberg's, over all tests of a session.
        least_explained: share of the residual's variance below which a dependence does not matter.
        least_spread_change: likewise, change of the variance over the reference's.
        least_tails_change: likewise, change of the share of large residuals.
        clip_z: residuals are clipped here before a test.
        tail_z: from here on a residual is a large one.
        ridge: on the regressions, over the mean of their information.
        runs_a_regressor: a part of the situation has at most one function for so many runs.
    """

    draws: Count = 400
    false_discovery_rate: Share = 0.01
    least_explained: Share = 0.006
    least_spread_change: NonNegative = 0.1
    least_tails_change: NonNegative = 0.004
    clip_z: Positive = 5.0
    tail_z: Positive = 3.5
    ridge: NonNegative = 1e-3
    runs_a_regressor: Count = 3


class EstimationSettings(StrictModel):
    """How mechanisms' parameters are estimated.

    Attributes:
        huber_z: standardised residuals beyond this pull in proportion no more (Huber's loss).
        outlier_z: residuals are clipped here before their spread is taken, where commands may be lost.
        evaluations: most evaluations of each round of least squares; every round weighs the axes anew.
        scale_rounds: of the fixed-point iteration for the scale under Student's t.
        most_polishing: evaluations of the local search where the motion changes by jumps.
        traction_step: loss of traction by which its local effect is measured.
        information_ridge: on the information matrix in parameters of unit size, so that it can be inverted.
        bootstraps: draws of the parameters for their intervals, and of runs for a cause's confidence.
        clock_bootstraps: resamples of the runs for what is read off the clock.
        interval: probability that an interval holds.
    """

    huber_z: Positive = 2.5
    outlier_z: Positive = 4.0
    evaluations: tuple[Count, ...] = (12, 6)
    scale_rounds: Count = 9
    most_polishing: Count = 40
    traction_step: Positive = 0.02
    information_ridge: NonNegative = 1e-6
    bootstraps: Count = 1000
    clock_bootstraps: Count = 200
    interval: Share = 0.95


class SearchSettings(StrictModel):
    """The search for causes: what a further one must bring.

    Attributes:
        most_causes: named in one session.
        most_transitions: searched in; of longer sessions every second, third, … run is, and the rest for the estimates.
        fewest_nats: of evidence for any cause.
        fewest_nats_a_transition: likewise for each transition: what matters grows with the session.
        penalty_weight: of the optimism of having fitted, in the evidence.
        jump_nats: taken off where the motion changes by jumps with the parameters: many values are tried.
        least_share: of all that was gained so far, which a further cause must bring.
        clip_z: residuals are clipped here where a gain is compared with the reference's own discrepancy.
        fewest_errors: standard errors over runs that a gain must be above nothing.
        fewest_errors_of_large: likewise for gains beyond `large_gain` times the fewest nats.
        large_gain: see there.
        tried_share: a mechanism is fitted where it promises this share of what is needed.
        exchange_nats: by which another cause must fit better to be put in the place of one.
        exchange_tried_share: a mechanism is tried in the place of another where it promises this share of its gain.
        rival_nats: a cause that fits in another's place with no more nats less is its rival,
        rival_errors: or with no more standard errors over runs less.
        nats_a_parameter: by which a rival with a parameter more must fit better.
    """

    most_causes: Count = 4
    most_transitions: Count = 6000
    fewest_nats: Positive = 15.0
    fewest_nats_a_transition: NonNegative = 0.006
    penalty_weight: NonNegative = 2.0
    jump_nats: NonNegative = 8.0
    least_share: Share = 0.04
    clip_z: Positive = 5.0
    fewest_errors: Positive = 4.0
    fewest_errors_of_large: Positive = 2.3
    large_gain: Positive = 3.0
    tried_share: Share = 0.35
    exchange_nats: NonNegative = 3.0
    exchange_tried_share: Share = 0.5
    rival_nats: NonNegative = 4.0
    rival_errors: NonNegative = 2.5
    nats_a_parameter: NonNegative = 4.0


class MotionNoiseSettings(StrictModel):
    """When the motion is said to have become more, or less, random.

    Attributes:
        draws: resamples of runs.
        clip_z: standardised residuals are clipped here.
        clip_squared: squares over their expectation are clipped here.
        sure_errors: standard errors of the log factor from which on it is a change.
        unsure_errors: and below which it may be none,
        largest_none: if its log is no larger than this.
        least_change: of the factor that matters.
        least_change_beside: likewise beside other causes, whose mechanisms are never exact, or a worse camera.
        least_change_of_others: likewise of units that the reference does not know.
        large_camera_share: of the reference's variance by which the camera's own noise must grow to count as worse.
        largest_disagreement: of what motion ahead and turning say, over the change itself.
        disagreement_errors: likewise in standard errors.
        least_motion_share: of the variance that is taken for the motion's at least, however large the camera's.
        least_uneven: share of the squares' variance that must depend on the situation for the change to be uneven.
    """

    draws: Count = 1000
    clip_z: Positive = 6.0
    clip_squared: Positive = 12.0
    sure_errors: Positive = 4.5
    unsure_errors: Positive = 3.0
    largest_none: Positive = 0.25
    least_change: NonNegative = 0.04
    least_change_beside: NonNegative = 0.35
    least_change_of_others: NonNegative = 0.45
    large_camera_share: Share = 0.2
    largest_disagreement: Positive = 0.6
    disagreement_errors: Positive = 3.0
    least_motion_share: Share = 0.1
    least_uneven: Share = 0.01


class VerdictSettings(StrictModel):
    """When causes stand, and when they explain all.

    Attributes:
        held_out_every: of so many runs the last is held out: nothing is fitted to it, gains are measured on it.
        least_share: of what can be explained at all that the causes must explain, or a name would be made up.
        most_left_over: of what the causes explain that may be left unexplained.
        least_left_over: share of the variance that may be left however little they explain.
        most_left_beside: like `most_left_over`, for several causes that are named although something is left.
        largest_excess: of variance over the reference's that may be left.
        clip_squared: squared residuals are clipped here when what is explained is counted.
        gain_draws: bootstraps over runs for the gain's interval.
    """

    held_out_every: Annotated[int, Field(ge=2)] = 4
    least_share: Share = 0.7
    most_left_over: Share = 0.06
    least_left_over: Share = 0.01
    most_left_beside: Share = 0.1
    largest_excess: NonNegative = 0.4
    clip_squared: Positive = 36.0
    gain_draws: Count = 1000


class NextRecordingSettings(StrictModel):
    """The drive that would separate two rivals.

    Attributes:
        periods: commands of each candidate.
        steps: transitions in a run of it.
        enough_nats: expected of the whole recording; 5 decide.
        fewest_runs: asked for.
        most_runs: asked for.
        small_share: of the limits, in a candidate of small commands.
    """

    periods: Count = 400
    steps: Count = 40
    enough_nats: Positive = 10.0
    fewest_runs: Count = 8
    most_runs: Count = 400
    small_share: Share = 0.3


class DiagnosisSettings(StrictModel):
    """All settings of a diagnosis, by its steps."""

    reference: ReferenceSettings = Field(default_factory=ReferenceSettings)
    noise: NoiseSettings = Field(default_factory=NoiseSettings)
    units: UnitSettings = Field(default_factory=UnitSettings)
    dependence: DependenceSettings = Field(default_factory=DependenceSettings)
    estimation: EstimationSettings = Field(default_factory=EstimationSettings)
    search: SearchSettings = Field(default_factory=SearchSettings)
    motion_noise: MotionNoiseSettings = Field(default_factory=MotionNoiseSettings)
    verdict: VerdictSettings = Field(default_factory=VerdictSettings)
    next_recording: NextRecordingSettings = Field(default_factory=NextRecordingSettings)
