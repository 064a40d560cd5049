"""Step 3, its end: what causes explain of a session's residual, what they leave, and what may be said of it."""

from dataclasses import dataclass

import numpy as np
import torch

from swarmtwin.diagnosis.cause_search import CauseSearch, Progress, SelectedCauses
from swarmtwin.diagnosis.dependence import StandardisedResidual, dependence_tests
from swarmtwin.diagnosis.likelihood import FittedMechanisms, LikelihoodModel, MechanismClass, loses_commands
from swarmtwin.diagnosis.motion_noise import MotionNoise, compare_motion_noise
from swarmtwin.diagnosis.reference import Reference
from swarmtwin.diagnosis.result import SHAPE_TESTS, Dependence, Verdict
from swarmtwin.diagnosis.settings import VerdictSettings
from swarmtwin.simulation.mechanism import Mechanism, offered
from swarmtwin.simulation.mechanisms import noise_change
from swarmtwin.simulation.residual_model import ResidualModel


@dataclass(frozen=True)
class ResidualAnalysis:
    """What the fitted runs of a session show.

    Attributes:
        causes: that fit best.
        motion_noise: how much more random the motion is, where that is all that is left, and a cause.
        before: tests of the simulation's residual.
        after: tests of what the causes leave.
        learned_residual: what was learned of what they leave, None where nothing could be.
        explained: mean squared standardised residual that the causes take away.
        achievable: the same with the learned residual beside them.
        settings: when causes stand.
    """

    causes: SelectedCauses
    motion_noise: MotionNoise | None
    before: list[Dependence]
    after: list[Dependence]
    learned_residual: ResidualModel | None
    explained: float
    achievable: float
    settings: VerdictSettings

    @property
    def share(self) -> float:
        """Share of what can be explained at all that the causes explain."""
        return float(np.clip(self.explained / max(self.achievable, 1e-9), 0.0, 1.0))

    @property
    def left_over(self) -> tuple[str, ...]:
        """What the residual still depends on, with the causes taken into account."""
        return tuple(test.part for test in self.after if test.found)

    @property
    def causes_stand(self) -> bool:
        """Whether the causes explain most of what can be explained: otherwise a name would be made up."""
        return bool(self.causes.fitted.mechanisms) and self.share >= self.settings.least_share

    @property
    def causes_are_reported(self) -> bool:
        """Whether the causes are reported: where much is left, a name may stand for what only looks like it."""
        several = len(self.causes.fitted.mechanisms) > 1
        most = self.settings.most_left_beside * self.explained
        beside = several and self._left < most and self._excess < self.settings.largest_excess
        return self.causes_stand and (self._nothing_left or beside)

    @property
    def verdict(self) -> Verdict:
        """What to say."""
        if self.motion_noise and not self.causes.fitted.mechanisms:
            return "explained"
        if self.causes_stand and self._nothing_left:
            return "explained"
        return "unexplained" if any(test.found for test in self.before) else "no_gap"

    @property
    def mechanisms(self) -> tuple[Mechanism, ...]:
        """The mechanisms that the simulation is extended by."""
        return self.causes.fitted.mechanisms if self.causes_stand and self.verdict != "no_gap" else ()

    @property
    def extension_residual(self) -> ResidualModel | None:
        """The learned residual that the simulation is extended by, where causes do not explain all."""
        return self.learned_residual if self.verdict == "unexplained" else None

    @property
    def _left(self) -> float:
        """The largest part of the variance that goes with anything after the causes are taken into account."""
        found = [test.explained for test in self.after if test.found and test.part not in SHAPE_TESTS]
        return max(found, default=0.0)

    @property
    def _excess(self) -> float:
        """How much more variance is left than the reference has, as a share of it, where that is no cause itself."""
        if self.motion_noise:
            return 0.0
        return max([test.explained for test in self.after if test.found and test.part == "spread"], default=0.0)

    @property
    def _nothing_left(self) -> bool:
        """Whether what the causes leave is small beside what they explain."""
        settings = self.settings
        most = max(
            [settings.most_left_over, *(mechanism.share_left_over for mechanism in self.causes.fitted.mechanisms)]
        )
        small = self._left < max(most * self.explained, settings.least_left_over)
        return small and self._excess < settings.largest_excess


class DependenceTests:
    """Tests of a session's residuals, with any causes taken into account, against the reference's own.

    Args:
        reference: the reference.
        model: of the session.
        reference_model: of the reference's own transitions.
        seed: of the draws, the same for every test.
    """

    def __init__(
        self, reference: Reference, model: LikelihoodModel, reference_model: LikelihoodModel, seed: int
    ) -> None:
        self.model, self.seed = model, seed
        self._reference_discrepancy = reference.reference_discrepancy
        neighbours = reference.settings.reference.overlap_neighbours
        weight = model.session.covariate_overlap(reference.session, neighbours)
        self._of_reference = StandardisedResidual.of(reference_model, reference_model.evaluate([]), weight)

    def run(self, fitted: FittedMechanisms) -> list[Dependence]:
        """Test what fitted mechanisms leave."""
        left = StandardisedResidual.of(self.model, fitted)
        settings = self.model.settings.dependence
        return dependence_tests(left, self._of_reference, self.seed, settings, self._reference_discrepancy)


def find_causes(
    reference: Reference, model: LikelihoodModel, reference_model: LikelihoodModel, progress: Progress | None
) -> SelectedCauses:
    """Search for the causes; in a long session in a part of its runs, their values are then estimated in all of it."""
    kinds = {name: kind for name, kind in offered_causes(model).items() if kind is not noise_change.Config}
    session = model.session
    every = -(-len(session) // reference.settings.search.most_transitions)
    part = model if every <= 1 else LikelihoodModel.of_measured(reference, session.where(session.run % every == 0))
    found = CauseSearch(part, reference_model, kinds, reference.reference_discrepancy, progress).run()
    return found if part is model else found.estimated_in(model)


def offered_causes(model: LikelihoodModel) -> dict[str, MechanismClass]:
    """Return the mechanisms that make sense for a session's robot, by name."""
    return offered(model.robot, model.session.conditions)


def analyse_residual(
    model: LikelihoodModel,
    reference_model: LikelihoodModel,
    causes: SelectedCauses,
    before: list[Dependence],
    tests: DependenceTests,
    rng: np.random.Generator,
) -> ResidualAnalysis:
    """Look at what causes leave of a session's residual: test it again, learn it, compare its spread.

    Args:
        model: of the session.
        reference_model: of the reference's own transitions.
        causes: the causes found.
        before: tests of the residual without them.
        tests: to repeat with them.
        rng: for resamples of runs.
    """
    fitted = causes.fitted
    after = tests.run(fitted) if fitted.mechanisms else before
    explained = achievable = _taken_away(model, model.evaluate([]).residual, fitted.residual)
    learned = None
    is_located = any(test.found and test.part not in SHAPE_TESTS for test in after)
    if is_located:
        learned, more = _learned_residual(model, fitted, tests.seed)
        achievable += more
    motion_noise = None
    if not is_located and not loses_commands(fitted.kinds):
        compared = compare_motion_noise(model, fitted.mechanisms, reference_model, rng)
        motion_noise = compared if compared.is_cause else None
        if compared.is_none:
            before, after = (_without_shape(tests) for tests in (before, after))
    settings = model.settings.verdict
    return ResidualAnalysis(causes, motion_noise, before, after, learned, explained, achievable, settings)


def _learned_residual(
    model: LikelihoodModel, fitted: FittedMechanisms, seed: int
) -> tuple[ResidualModel | None, float]:
    """Learn what is left over, and by how much it lowers the mean square of runs that it has not seen; None if not."""
    raw = model.session.residual_of(model.likeliest_twist(fitted.mechanisms))
    session, given = model.session, model.session.situation
    assert given.previous_command is not None
    residual, said = ResidualModel.learn(
        model.predictor.moment(),
        given.command,
        given.previous_command,
        session.run,
        raw,
        model.whitener.residual_scale,
        seed,
    )
    whitened = model.whitener(raw - torch.as_tensor(said)).numpy()
    more = _taken_away(model, fitted.residual, whitened)
    return (residual, more) if more > 0 else (None, 0.0)


def _taken_away(model: LikelihoodModel, before: np.ndarray, after: np.ndarray) -> float:
    """Return by how much the mean square of standardised residuals falls, outliers cut."""
    largest = model.settings.verdict.clip_squared
    squares = [float(np.minimum(residual**2, largest).mean()) for residual in (before, after)]
    return squares[0] - squares[1]


def _without_shape(tests: list[Dependence]) -> list[Dependence]:
    """Return tests of which spread and tails do not count: the camera's noise has changed, not the motion's."""
    return [test.model_copy(update={"found": test.found and test.part not in SHAPE_TESTS}) for test in tests]
