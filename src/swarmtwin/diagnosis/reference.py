"""Step 1. What a measured session is compared with: a simulation, its own noise, and how sure it is of itself."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Self

import numpy as np
from scipy.spatial import cKDTree
from torch import Tensor

from swarmtwin.diagnosis.discrepancy import Discrepancy
from swarmtwin.diagnosis.likelihood import SessionLikelihood
from swarmtwin.diagnosis.measured_session import MeasuredSession
from swarmtwin.diagnosis.noise import Noise
from swarmtwin.diagnosis.own_answers import OwnAnswers
from swarmtwin.diagnosis.quick_dynamics import imitation_of, table_of
from swarmtwin.diagnosis.rolled_out_training import learn_rolled_out
from swarmtwin.diagnosis.session_prediction import SessionPredictor
from swarmtwin.diagnosis.settings import DiagnosisSettings, ReferenceSettings
from swarmtwin.diagnosis.unit_spread import UnitSpread
from swarmtwin.dynamics.motion_noise import MotionNoise
from swarmtwin.dynamics.predictor import DynamicsModel, NetworkDynamics
from swarmtwin.errors import UserError
from swarmtwin.learning.ensemble import learn
from swarmtwin.recordings.recording import Recording
from swarmtwin.robot import Arena, Robot, SituationPart
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.ensemble_dynamics import (
    KNOWN_INPUTS,
    BaseDynamics,
    CorrectedDynamics,
    CrossFitted,
    EnsembleDynamics,
    coasting,
    ensemble_encoding,
    wall_reaches_over,
)
from swarmtwin.transitions import Transitions, from_recording


@dataclass(frozen=True)
class Reference:
    """A simulation and its noise, learned where nothing is wrong.

    Attributes:
        base: the simulation, in twists.
        noise: of residuals that the simulation was not fitted to.
        session: the reference's own transitions, and the conditions they were measured under.
        cross_fitted: what answers these transitions, each without having seen its run.
        vehicles: ids of the vehicles it was learned from.
        discrepancy: what the simulation gets wrong of these runs though it has not seen them; None: all of that counts
            as a gap.
        unit_spread: by which shares vehicles are expected to differ: as these do from each other, beside what the
            robot's file states, or else the settings' prior.
        unlike: ids of its vehicles that are unlike its others by more than units differ, and in which differences.
        settings: of every diagnosis with this reference.
        tabulated: the simulation by a table of a model that looks at commands alone, which sessions are compared with
            in its place; None: with itself.
        quick: answers nearly as the simulation, in a fraction of its time, where only differences are asked; None: it
            answers itself.
    """

    base: BaseDynamics
    noise: Noise
    session: MeasuredSession
    cross_fitted: CrossFitted
    vehicles: tuple[str, ...]
    discrepancy: Discrepancy | None
    unit_spread: UnitSpread
    unlike: Mapping[str, tuple[str, ...]]
    settings: DiagnosisSettings
    tabulated: BaseDynamics | None = None
    quick: BaseDynamics | None = None
    _own_likelihoods: dict[int, SessionLikelihood] = field(default_factory=dict, init=False, repr=False, compare=False)

    @property
    def robot(self) -> Robot:
        """The robot."""
        return self.base.robot

    @classmethod
    def learn(
        cls,
        transitions: Transitions,
        seed: int,
        parts: tuple[SituationPart, ...] | None = None,
        settings: DiagnosisSettings | None = None,
    ) -> Self:
        """Learn the simulation from a recording's transitions, cross-fitted over runs.

        Args:
            transitions: of the reference recording.
            seed: of everything random.
            parts: what the simulation is given; None: what the robot's models are given, and the previous command.
                Where they are named, no discrepancy is granted: what it gets wrong of the reference is a gap as well.
            settings: of every diagnosis with it; None: the defaults.

        Raises:
            UserError: too few runs or transitions, or constant commands.
        """
        settings = settings or DiagnosisSettings()
        known = parts or tuple(
            part for part in KNOWN_INPUTS if part in (*transitions.robot.situation, "previous_command")
        )
        session = MeasuredSession.of(transitions, conditions_of(transitions))
        require_enough(session, settings.reference, "reference")
        fold = session.folds(settings.reference.folds)

        def learned(session: MeasuredSession) -> BaseDynamics:
            return _learned_base(session, known, session.twist, fold, seed)

        return cls._learned_by(learned, session, fold, seed, settings, reference_discrepancy=parts is None)

    @classmethod
    def of_simulation(
        cls, dynamics: NetworkDynamics, evidence: Transitions, seed: int, settings: DiagnosisSettings | None = None
    ) -> Self:
        """Take a trained simulation, and learn from transitions that it was not fitted to what it gets wrong already.

        Args:
            dynamics: the simulation.
            evidence: of the recording it was learned from, or of another one in which nothing is wrong.
            seed: of everything random.
            settings: of every diagnosis with it; None: the defaults.

        Raises:
            UserError: the simulation looks at what a diagnosis cannot give it, or there is too little evidence.
        """
        settings = settings or DiagnosisSettings()
        if strange := [part for part in dynamics.inputs if part not in KNOWN_INPUTS]:
            raise UserError(
                f"the simulation looks at {strange[0]}: a diagnosis works on simulations of {', '.join(KNOWN_INPUTS)}; "
                "diagnose with the recording it was learned from instead, reference=DIR"
            )
        session = MeasuredSession.of(evidence, conditions_of(evidence))
        require_enough(session, settings.reference, "simulation's evidence: the held-out part of its")
        alone = _twist(CorrectedDynamics(dynamics, None), session)
        fold = session.folds(settings.reference.folds)
        known = {*dynamics.inputs, "previous_command"} - {"velocity"}  # a correction is of what the model makes of it
        parts = tuple(part for part in KNOWN_INPUTS if part in known)
        table = table_of(dynamics)

        def learned(session: MeasuredSession) -> CorrectedDynamics:
            correction = _learned_base(session, parts, session.residual_of(alone), fold, seed)
            return CorrectedDynamics(table or dynamics, correction)

        found = cls._learned_by(learned, session, fold, seed, settings)
        assert isinstance(found.base, CorrectedDynamics)
        if table:
            base = CorrectedDynamics(dynamics, found.base.correction)
            base.motion_noise = found.base.motion_noise
            return replace(found, base=base, tabulated=found.base)
        if "velocity" in dynamics.inputs:
            return found
        return replace(found, quick=CorrectedDynamics(imitation_of(dynamics, session, seed), found.base.correction))

    @classmethod
    def _learned_by(
        cls,
        learned: Callable[[MeasuredSession], BaseDynamics],
        session: MeasuredSession,
        fold: np.ndarray,
        seed: int,
        settings: DiagnosisSettings,
        reference_discrepancy: bool = True,
    ) -> Self:
        """Learn a simulation, and the noise from what cross-fitted answers leave of the reference's own transitions.

        Of several vehicles what each has of its own is taken off them, once it is known, and all is learned anew: or
        else it would be noise to a simulation of their mean, in which small effects are not seen. Not where the
        simulation looks at velocities.
        """
        answers = OwnAnswers.by(learned(session), session, fold, seed, settings)
        units = answers.units()
        if units.errors.any() and not answers.has_momentum:  # with momentum it is in velocities as well, which stay
            session = session.less(units.errors)
            answers = OwnAnswers.by(learned(session), session, fold, seed, settings)
        base, cross_fitted, session = answers.base, answers.cross_fitted, answers.session
        base.motion_noise = MotionNoise.estimate(session.transitions, answers.one_step.numpy())
        rows, part = answers.rows, answers.part
        own = cross_fitted.of_rows(rows)
        rough = SessionLikelihood(own, answers.noise, part, settings=settings)
        noise = Noise.learn(answers.errors[rows] - rough.expected_errors, rough.motion, part, settings.noise)
        discrepancy = None
        if reference_discrepancy:
            alone = SessionLikelihood(own, noise, part, settings=settings)
            discrepancy = Discrepancy.learn(alone, settings.likelihood.discrepancy)
        vehicles = tuple(session.transitions.vehicles[index] for index in np.unique(session.transitions.vehicle))
        return cls(base, noise, session, cross_fitted, vehicles, discrepancy, units.spread, units.unlike, settings)

    def likelihood_of(self, session: MeasuredSession) -> SessionLikelihood:
        """Return how likely a measured session is by this reference.

        One that was learned from several vehicles answers for all of them on average, and knows none by itself.
        """
        known = self.vehicles if len(self.vehicles) == 1 else ()
        return SessionLikelihood(
            self.tabulated or self.base,
            self.noise,
            session,
            known if self.vehicles else None,
            self.unit_spread,
            self.discrepancy,
            self.settings,
            quick=self.quick,
        )

    def own_likelihood(self, most: int | None = None) -> SessionLikelihood:
        """Return how likely the reference's own transitions are by what has not seen them, of `most` of them at most.

        None: of as many as its noise is learned from.
        """
        rows = self.session.spread_over(most or self.settings.reference.most_transitions)
        count = int(rows.sum())
        if count not in self._own_likelihoods:
            own = self.cross_fitted.of_rows(rows)
            self._own_likelihoods[count] = SessionLikelihood(
                own, self.noise, self.session.where(rows), discrepancy=self.discrepancy, settings=self.settings
            )
        return self._own_likelihoods[count]

    def comparable(self, measured: Recording) -> "ComparableSession":
        """Return what of a measured recording can be compared.

        Raises:
            UserError: another robot, another arena where the simulation looks at poses, too few runs or transitions,
                constant commands, or commands that the reference does not cover.
        """
        robot = self.robot
        if measured.robot.name != robot.name or measured.robot.command_columns != robot.command_columns:
            raise UserError(
                f"the measured recording is of robot {measured.robot.name!r}, the simulation of {robot.name!r}"
            )
        settings = self.settings.reference
        transitions = enough_measured(measured, settings)
        self._require_same_arena(transitions.arena_mm)
        covered = self.covers(transitions.command)
        session = MeasuredSession.of(transitions.where(covered), self.conditions_for(transitions), measured.sent)
        require_enough(session, settings, "measured", ", as far as the reference covers its commands,")
        return ComparableSession(session, transitions, int((~covered).sum()))

    def _require_same_arena(self, measured: Arena) -> None:
        """Refuse another arena where the simulation looks at poses: its walls, or its origin, lie elsewhere."""
        own, allowed_mm = self.session.conditions.arena_mm, min(self.robot.vehicle_size_mm) / 2
        elsewhere_mm = np.abs(np.concatenate([measured.low_mm - own.low_mm, measured.high_mm - own.high_mm]))
        if "pose" in self.base.inputs and elsewhere_mm.max() > allowed_mm:
            raise UserError(
                f"the measured recording is of another arena ({measured}) than the simulation ({own}), which looks at "
                "poses and knows none there: measure in the same arena, or, with reference=DIR, diagnose without "
                "poses, situation=[command,previous_command]"
            )

    def conditions_for(self, transitions: Transitions) -> SessionConditions:
        """Return the conditions of another session of this robot."""
        own = self.session.conditions
        names = ("track_mm", "own_lags", "gear_friction_mm_s", "effort_exponents", "clearance_mm")
        return conditions_of(transitions).model_copy(update={name: getattr(own, name) for name in names})

    def covers(self, commands: np.ndarray) -> np.ndarray:
        """Say which commands (N, m) the reference covers: it has enough others about as near as its own are, (N,)."""
        settings = self.settings.reference
        known = self.session.transitions.command
        spread = np.maximum(known.std(axis=0), 1e-9)
        tree = cKDTree(known / spread)
        count = min(settings.coverage_neighbours, len(known) - 1)
        sample = known[:: max(1, len(known) // 2000)]  # 2,000 tell quantiles well enough
        own = tree.query(sample / spread, k=[count + 1])[0]
        asked = tree.query(commands / spread, k=[count])[0][:, 0]
        usual = settings.coverage_distance * np.median(
            own
        )  # where few commands are sent again and again, nearly nothing
        covered: np.ndarray = asked <= max(usual, np.quantile(own, settings.coverage_share)) + 1e-9
        return covered


class ComparableSession(NamedTuple):
    """What of a measured recording can be compared with a reference.

    Attributes:
        session: the transitions whose previous command is known and whose command the reference covers.
        believable: all transitions that could be made of the recording.
        set_aside: how many of these the reference does not cover.
    """

    session: MeasuredSession
    believable: Transitions
    set_aside: int


def conditions_of(transitions: Transitions) -> SessionConditions:
    """Return where and how long transitions were measured."""
    lasted_s = float((transitions.time_s + transitions.duration_s).max()) if len(transitions) else 1.0
    return SessionConditions(arena_mm=transitions.arena_mm, session_s=max(lasted_s, transitions.robot.period_s))


def enough_measured(measured: Recording, settings: ReferenceSettings) -> Transitions:
    """Return the transitions of a measured recording.

    Raises:
        UserError: too few runs or transitions, or constant commands, whatever they are compared with.
    """
    transitions, _ = from_recording(measured)
    require_enough(MeasuredSession.of(transitions, conditions_of(transitions)), settings, "measured")
    return transitions


def require_enough(session: MeasuredSession, settings: ReferenceSettings, what: str, remark: str = "") -> None:
    """Refuse a session from which nothing can be concluded.

    Raises:
        UserError: too few runs or transitions, or commands that never change.
    """
    found = (
        f"the {what} recording{remark} has {session.runs} runs with {len(session)} transitions that follow another one"
    )
    runs, transitions = settings.fewest_runs, settings.fewest_transitions
    if session.runs < runs or len(session) < transitions:
        raise UserError(
            f"{found}: too few to conclude anything; record at least {runs} runs and {transitions} such "
            "transitions (150 runs of 40 steps are comfortable)"
        )
    constant = np.ptp(session.transitions.command, axis=0) <= 1e-9
    if constant.all():
        raise UserError(
            f"the {what} recording has one constant command throughout: nothing can be told apart; vary the commands"
        )


def _twist(base: DynamicsModel, session: MeasuredSession) -> Tensor:
    """Return what a base answers to a session's situations, (N, 3)."""
    return SessionPredictor(base, session.conditions, session.situation, session.follows).twist(())


def _learned_base(
    session: MeasuredSession, inputs: tuple[SituationPart, ...], twist: Tensor, fold: np.ndarray, seed: int
) -> EnsembleDynamics:
    """Learn twists (N, 3) from the parts of a session's situations."""
    robot = session.transitions.robot
    reaches_mm = wall_reaches_over(session.conditions)
    encoding, groups = ensemble_encoding(robot, inputs, reaches_mm, session.conditions)
    change = twist - coasting(robot, inputs, session.situation)
    ensemble = learn(groups, encoding(session.situation).numpy(), change.numpy(), fold, seed)
    base = EnsembleDynamics(robot, inputs, reaches_mm, session.conditions, ensemble)
    if "velocity" in inputs:
        learn_rolled_out(base, session, fold, seed)
    return base
