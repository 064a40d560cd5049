"""What can be set of a diagnosis: thresholds, each with its default and what it decides.

The defaults stand in `conf/diagnosis/default.yaml` as well; a test compares both. They were chosen on stand-ins, in
sessions other than the 496 that docs/results.md reports on, but for `named_in_trials`, which was counted there; its
unruly ones were judged before `least_nats_a_transition` and `least_tails_change_a_loss` were set.
"""

from typing import Annotated

from pydantic import Field

from swarmtwin.diagnosis.names_in_trials import NAMED_IN_TRIALS, Trials
from swarmtwin.robot import Positive, StrictModel

Count = Annotated[int, Field(ge=1)]
Share = Annotated[float, Field(ge=0, le=1)]
Probability = Annotated[float, Field(gt=0, lt=1)]
NonNegative = Annotated[float, Field(ge=0)]
Candidates = Annotated[tuple[Positive, ...], Field(min_length=1)]


class ReferenceSettings(StrictModel):
    """What a reference must hold, and which measured transitions it can speak for.

    Attributes:
        folds: parts of the runs; each is predicted by a simulation that was learned without it.
        fewest_runs: of a recording from which anything is concluded; runs are the blocks of every statistic.
        fewest_transitions: likewise, of transitions that follow another one.
        coverage_neighbours: reference commands whose distance says whether a measured command is covered.
        coverage_distance: largest such distance, over the median distance within the reference itself,
        coverage_share: or as far as this share of its own commands are from each other.
        most_transitions: that its noise and its errors are learned from; of a longer reference some of its runs. The
            simulation is learned from all.
        most_measured: rows of a measured recording that are compared; of a longer one every second, third, … run or
            block of a run.
        overlap_neighbours: reference transitions that each measured one counts for, when the reference is weighted to
            stand for what it would show if it were driven as the session was.
    """

    folds: Annotated[int, Field(ge=2)] = 6
    fewest_runs: Count = 8
    fewest_transitions: Count = 400
    coverage_neighbours: Count = 10
    coverage_distance: Positive = 4.0
    coverage_share: Share = 0.99
    most_transitions: Count = 12000
    most_measured: Count = 100_000
    overlap_neighbours: Count = 5


class NoiseSettings(StrictModel):
    """How the reference's noise is learned.

    Attributes:
        rounds: of weighted least squares for the variances.
        clip_z: errors beyond so many standard deviations are outliers, and left out of these.
        least_share: of an axis' whole variance that a vehicle at rest has at least, and that the camera has.
        scale_spread: prior standard deviation of the log of the noise's scale, where it is fitted to the reference.
        degrees_of_freedom: candidates for the tails (Student's t), beside normal ones.
        set_scale_spread: prior standard deviation of the log of the spread that each explanation leaves.
    """

    rounds: Count = 4
    clip_z: Positive = 4.0
    least_share: Positive = 0.01
    scale_spread: Positive = 1.0
    set_scale_spread: Positive = 0.5
    degrees_of_freedom: tuple[Positive, ...] = (4.0, 8.0, 16.0)


class FlexibleSettings(StrictModel):
    """The flexible regression that says what errors depend on at all.

    Attributes:
        folds: parts of the runs; each is predicted by what was fitted to the others.
        ridges: candidates, over the mean of the features' information.
        clip_z: errors are clipped here, in standard deviations: outliers must not bend it.
        command_waves: random cosines of commands, at each of their scales.
        place_waves: of the place in the arena.
        place_scale: their standard deviation in waves, 1 per half of the arena.
        time_waves: cosines over the session.
        running_means: transitions that running means of earlier errors look back.
    """

    folds: Annotated[int, Field(ge=2)] = 4
    ridges: Candidates = (0.01, 0.1, 1.0, 10.0)
    clip_z: Positive = 6.0
    command_waves: Count = 30
    place_waves: Count = 40
    place_scale: Positive = 3.0
    time_waves: Count = 6
    running_means: Candidates = (2.0, 8.0, 40.0, 200.0)


class UnitSettings(StrictModel):
    """How much two units of a robot are expected to differ by fabrication.

    Attributes:
        spread: standard deviation, as a share, of a unit's speeds, of its left-right difference (of a trim, in rad),
            and of what it is faster by at any speed since it starts to move at a smaller command, where nothing else
            is known: cheap gear motors are sold with ±10 %, two standard deviations. It is for any robot; a robot's
            file states its own where units were measured.
        prior_units: how many units that prior counts for against those that a reference has recorded.
        unlike_level: probability with which, of units that differ by no more than that, one is said to be unlike.
    """

    spread: Positive = 0.05
    prior_units: Positive = 2.0
    unlike_level: Share = 0.01


class DependenceSettings(StrictModel):
    """The tests of what a residual depends on.

    Attributes:
        draws: sign flips, or resamples, of whole runs that stand for chance.
        false_discovery_rate: Benjamini and Hochberg's, over all tests of a session.
        least_explained: share of the residual's variance below which a dependence does not matter.
        least_tails_change: likewise, change of the share of large residuals.
        least_tails_change_a_loss: likewise beside commands that wheels lose, for each of these.
        clip_z: residuals are clipped here before a test.
        tail_z: from here on a residual is a large one.
        ridge: on the regressions, over the mean of their information.
        runs_a_regressor: a part of the situation has at most one function for so many runs.
    """

    draws: Count = 400
    false_discovery_rate: Share = 0.01
    least_explained: Share = 0.006
    least_tails_change: NonNegative = 0.004
    least_tails_change_a_loss: NonNegative = 0.1
    clip_z: Positive = 5.0
    tail_z: Positive = 3.5
    ridge: NonNegative = 1e-3
    runs_a_regressor: Count = 3


class LikelihoodSettings(StrictModel):
    """What is no gap, though nobody knows it exactly.

    Attributes:
        discrepancy: prior standard deviation of each of the simulation's smooth errors, in units of the noise; what the
            reference shows of them is added.
        form: of how a mechanism's form differs from the true one, as a share of what it does.
        rough_form: likewise, of how fins and propellers follow: what they do on the way to a new setting is known
            least; in intervals also of lags and play of wheels.
    """

    discrepancy: Positive = 0.3
    form: Positive = 0.05
    rough_form: Positive = 0.1


class EstimationSettings(StrictModel):
    """How mechanisms' parameters are estimated.

    Attributes:
        rounds: of Gauss and Newton's method at most, without and then with what is unknown of the mechanisms' form.
        likelihood_rounds: of the search in the likelihood itself, where commands may be lost.
        most_polishing: evaluations of the local search where the motion changes by jumps,
        surface_points: and then, for each term of a quadratic surface, points that it is laid through,
        surface_radius: within so many standard deviations of the values,
        surface_resamples: and resamples of the runs.
        draws: of the parameters for their intervals.
        clock_bootstraps: resamples of the runs for what is read off the clock.
        form: as `likelihood.form`, for intervals: a form that is wrong by a seventh of its effect, whose square is
            `search.least_share_beside`.
        alternatives: standard deviations of a mechanism's plausible alternatives that intervals allow for: of how much
            of its own way a fin loses, of which no more is known than with what speeds servos are sold, and of how much
            faster a motor runs that takes up the play of its gear.
    """

    rounds: Count = 8
    likelihood_rounds: Count = 8
    most_polishing: Count = 60
    surface_points: Count = 6
    surface_radius: Positive = 5.0
    surface_resamples: Count = 200
    draws: Count = 1000
    clock_bootstraps: Count = 200
    form: Positive = 0.14
    alternatives: NonNegative = 1.0


class SearchSettings(StrictModel):
    """The search for sets of causes.

    Attributes:
        prior: probability of each cause to be there.
        least_nats_a_transition: that a cause must bring to matter: less is left to what nobody knows exactly. A gain of
            0.01 lowers errors by about 0.3 %. Where other units may differ by as much, only a share of what a cause
            changes is evidence, and as much of this is asked for.
        least_share_beside: likewise, of what a set gains, for each cause beyond the first: no form is exact, and one
            that is wrong by a seventh of its effect leaves that share to whatever picks it up. Not for those that have
            no other form: what the clock shows, and, but with thrust, lost commands.
        least_share_late: likewise, in its place, for each cause beyond the first that says when a fin or a propeller
            follows: what a change of its setting does on the way is known to little more than a quarter.
        most_causes: that are named in one session. Where more are likelier, none is: any gap can be pieced together
            from enough causes.
        most_transitions: searched in; of longer sessions some of the runs are, and the rest serve for the estimates.
        most_screened: of these, in which mechanisms are screened and sets first fitted; those that are not far less
            probable there than the best are then fitted to all.
        most_behind: nats by which they may be: a ratio of 5 × 10⁸ is not made up for by more of the same session. The
            `kept_sets` of a size always are, unless its best is so far behind the best smaller set.
        grid_points: of each mechanism's grid, where it is screened.
        tried_points: of these, beside each set: those that promise most, by one linear step.
        fitted_a_set: mechanisms that are fitted beside each of the sets that are kept.
        fitted_pairs: pairs that are fitted at once.
        kept_sets: of each size, beside which a further cause is looked for.
        least_promise: nats below which nothing is fitted, of the whole session.
        least_promise_share: likewise, as a share of those that a cause must bring to matter.
        named_from: probability from which on a cause counts as sure.
        reported_from: probability from which on a cause leads: it is named where it or its rivals are sure.
        rival_from: probability that a cause must hold in the place of another one to be its rival.
        reported_sets: sets of causes whose probability is kept in the result, at most; that of no cause is one of them.
    """

    prior: Probability = 0.05
    least_nats_a_transition: NonNegative = 0.01
    least_share_beside: NonNegative = 0.02
    least_share_late: NonNegative = 0.08
    most_causes: Count = 3
    most_transitions: Count = 6000
    most_screened: Count = 1500
    most_behind: Positive = 20.0
    grid_points: Count = 32
    tried_points: Count = 3
    fitted_a_set: Count = 4
    fitted_pairs: Count = 4
    kept_sets: Count = 2
    least_promise: Positive = 3.0
    least_promise_share: Share = 0.2
    named_from: Probability = 0.9
    reported_from: Share = 0.5
    rival_from: Share = 0.02
    reported_sets: Annotated[int, Field(ge=2)] = 8


class MotionNoiseSettings(StrictModel):
    """When the motion is said to have become more, or less, random: priors on the log of the factor.

    Attributes:
        usual_spread: standard deviation between sessions of one vehicle in which nothing is wrong.
        usual_spread_beside: likewise of another vehicle, or beside causes that change how vehicles move, whose form is
            never exact.
        usual_spread_with_momentum: likewise of a simulation that goes on from its own velocity: what that gets wrong
            lasts for some periods, and is told from the noise of motion and camera only so well.
        growth_spread: likewise for each unit of the log by which vehicles are told to move less or more than in the
            reference: noise grows as a power of the motion that lies between 0 and 1, uniform there, whatever else was
            learned; and for each unit of the log by which noise that grows with the motion differs from noise that
            grows with what was commanded: between these it is uniform as well.
        changed_spread: where this is a cause.
    """

    usual_spread: Positive = 0.03
    usual_spread_beside: Positive = 0.06
    usual_spread_with_momentum: Positive = 0.3
    growth_spread: Positive = 0.3
    changed_spread: Positive = 0.7


class VerdictSettings(StrictModel):
    """When causes stand, and when they explain all.

    Attributes:
        held_out_every: of so many runs, taken vehicle by vehicle, the last is held out: nothing is fitted to it, gains
            are measured on it.
        alarm_nats: left over by the causes from which on something is wrong that nobody has named,
        alarm_nats_a_transition: and for each transition.
        nameless_nats: left over by the causes from which on none of them is named: where nothing is left, regressions
            gain as much in 2 % of sessions by chance (400 draws of noise).
        uncertainty_draws: of the simulation's own error, for what it would leave over where nothing is wrong.
        chance_draws: likewise, for what causes would gain by it.
        uncertainty_spreads: standard deviations over draws by which that may lie above their mean: of clean sessions
            1 in 200 may alarm, and nats have a longer tail than a normal.
        imitated_level: likewise, probability with which a cause that an uncertain simulation imitates is taken for
            more than that.
        least_unseen: share of the squared change by a cause that must not go with the situation as the simulation sees
            it, for that to be asked.
        most_left: of what the causes gain that may be left over: as a form leaves that is wrong by a fifth.
        most_lasting: likewise, of that in which errors follow each other: another form seldom lasts.
        nearest_end: share of its range by which a parameter must lie off its ends where its interval holds one, for its
            cause to be named.
        named_in_trials: for each cause, in how many sessions of stand-ins it was there, of those in which it was named,
            where half of what is wrong is in no catalogue or acts by another law (see docs/results.md); null: the
            posterior probability is told as it is.
        trials_prior: named causes that the share of all of them counts for, against those of one cause.
        gain_draws: bootstraps over runs for the gain's interval.
        windows_s: over which open loop is measured, in held-out runs that are as long.
        immaterial: share of an error by which it may rise on held-out runs where another one falls.
    """

    held_out_every: Annotated[int, Field(ge=2)] = 4
    alarm_nats: Positive = 15.0
    alarm_nats_a_transition: NonNegative = 0.002
    nameless_nats: Positive = 7.0
    uncertainty_draws: Count = 12
    chance_draws: Count = 100
    uncertainty_spreads: NonNegative = 3.0
    imitated_level: Share = 0.005
    least_unseen: Share = 0.05
    most_left: Share = 0.04
    most_lasting: Share = 0.03
    nearest_end: Share = 0.05
    named_in_trials: Trials | None = Field(default_factory=lambda: dict(NAMED_IN_TRIALS))
    trials_prior: Positive = 10.0
    gain_draws: Count = 1000
    windows_s: tuple[Positive, ...] = (2.0, 5.0, 10.0, 30.0)
    immaterial: Share = 0.01

    def confidence(self, cause: str, posterior: float) -> float:
        """Return how probable it is that a cause is there that has a posterior probability among the catalogue's.

        What is in no catalogue is taken for one of its causes at times, for some of them more often than for others:
        the posterior is multiplied by the share of names that were right in trials, which is the mean of a beta
        distribution whose prior is the share of all names.
        """
        if not self.named_in_trials:
            return posterior
        right, named = (sum(counts) for counts in zip(*self.named_in_trials.values(), strict=True))
        own_right, own_named = self.named_in_trials.get(cause, (0.0, 0.0))
        return posterior * (own_right + self.trials_prior * right / named) / (own_named + self.trials_prior)


class NextRecordingSettings(StrictModel):
    """The drive that would separate two rivals, or lower the limits from which on causes would be named.

    Attributes:
        periods: commands of each candidate.
        steps: transitions in a run of it.
        enough_nats: expected of the whole recording; 5 decide.
        enough_lower: share of their size to which it must lower limits, for it to be asked for where nothing is wrong.
        fewest_runs: asked for.
        most_runs: asked for.
        small_share: of the limits, in a candidate of small commands.
    """

    periods: Count = 400
    steps: Count = 40
    enough_nats: Positive = 10.0
    enough_lower: Share = 0.9
    fewest_runs: Count = 8
    most_runs: Count = 400
    small_share: Share = 0.3


class DiagnosisSettings(StrictModel):
    """All settings of a diagnosis, by its steps."""

    reference: ReferenceSettings = Field(default_factory=ReferenceSettings)
    noise: NoiseSettings = Field(default_factory=NoiseSettings)
    flexible: FlexibleSettings = Field(default_factory=FlexibleSettings)
    likelihood: LikelihoodSettings = Field(default_factory=LikelihoodSettings)
    units: UnitSettings = Field(default_factory=UnitSettings)
    dependence: DependenceSettings = Field(default_factory=DependenceSettings)
    estimation: EstimationSettings = Field(default_factory=EstimationSettings)
    search: SearchSettings = Field(default_factory=SearchSettings)
    motion_noise: MotionNoiseSettings = Field(default_factory=MotionNoiseSettings)
    verdict: VerdictSettings = Field(default_factory=VerdictSettings)
    next_recording: NextRecordingSettings = Field(default_factory=NextRecordingSettings)
