"""Simulations asked for what follows measured situations: the one place where the diagnosis predicts motion.

It runs the simulation's own signal chain, period by period. One thing is approximated, and only here, since the present
search asks for thousands of predictions: the state of the actuators at the start of each transition is rebuilt from the
two commands before it, instead of carried from the start of the run, and a command is taken to have been lost at most
twice in a row. Both go when the likelihood carries the state through whole runs.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from torch import Tensor

from swarmtwin.dynamics.predictor import DynamicsModel
from swarmtwin.geometry import compose, displacement_between, log_map
from swarmtwin.learning.situation import Situation
from swarmtwin.simulation.base_twists import Answers, BaseTwists
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.ensemble_dynamics import OneMember
from swarmtwin.simulation.mechanism import Mechanism, Moment, in_signal_order
from swarmtwin.simulation.residual_model import ResidualModel
from swarmtwin.simulation.signal_chain import period_motion, remembered_after_two


class Outcome(NamedTuple):
    """One way in which a period can go: its probability and the measured twists (N, 3) over it."""

    probability: float
    twist: Tensor


@dataclass(frozen=True)
class OneStepPredictor:
    """Predicts the N transitions of a session under mechanisms.

    Attributes:
        base: the simulation's dynamics model, or one member of it.
        conditions: of the session.
        situation: N measured situations, float64, whose previous and earlier commands are known.
        answers: of the base so far, by the mechanisms that change what it is asked; those of the last few are kept.
    """

    base: DynamicsModel
    conditions: SessionConditions
    situation: Situation
    answers: dict[tuple[str, ...], Answers] = field(default_factory=lambda: {(): Answers()})

    def with_member(self, member: int) -> "OneStepPredictor":
        """Return it with one member of the base in the place of the mean of all."""
        return OneStepPredictor(OneMember(self.base, member), self.conditions, self.situation)  # type: ignore[arg-type]

    def moment(self) -> Moment:
        """Return the situations as mechanisms see them, at their measured poses."""
        given = self.situation
        assert given.pose is not None
        assert given.elapsed_s is not None
        assert given.duration_s is not None
        assert given.neighbours is not None
        return Moment(self.base.robot, self.conditions, given.pose, given.elapsed_s, given.duration_s, given.neighbours)

    def simulated(self) -> Tensor:
        """Return the twists (N, 3) of the base alone."""
        moment = self.moment()
        return BaseTwists(self.base, moment, self._commands(), self.answers[()]).response(0)

    def base_twist(self, command: Tensor, previous_command: Tensor) -> Tensor:
        """Return the twists (N, 3) of the base alone under other commands (N, m), and others before them."""
        return BaseTwists(self.base, self.moment(), (command, previous_command, previous_command)).response(0)

    def outcomes(self, mechanisms: Sequence[Mechanism]) -> list[Outcome]:
        """Return how each transition can go: one outcome, or where commands may be lost, three."""
        ordered = in_signal_order(mechanisms)
        as_sent = (0, 1, 2)  # periods ago of the commands in force in this period and in the two before
        arrives = 1.0
        for mechanism in ordered:
            arrives *= mechanism.arrival_probability()
        if all(mechanism.stage != "link" or mechanism.arrival_probability() == 1 for mechanism in ordered):
            return [Outcome(1.0, self._twist(ordered, as_sent))]
        lost = 1.0 - arrives
        chances = (arrives, arrives * lost, lost**2)
        return [
            Outcome(chance, self._twist(ordered, roles))
            for chance, roles in zip(chances, (as_sent, (1, 1, 1), (2, 2, 2)), strict=True)
        ]

    def most_likely_twist(self, mechanisms: Sequence[Mechanism], residual: ResidualModel | None = None) -> Tensor:
        """Return the most likely measured twists (N, 3), with what was learned beyond the mechanisms."""
        twist = max(self.outcomes(mechanisms), key=lambda one: one.probability).twist
        if residual is None:
            return twist
        command, previous, _ = self._commands()
        return twist + residual.twist(self.moment(), command, previous)

    def _commands(self) -> tuple[Tensor, Tensor, Tensor]:
        given = self.situation
        assert given.previous_command is not None
        assert given.earlier_command is not None
        return given.command, given.previous_command, given.earlier_command

    def _answers(self, mechanisms: Sequence[Mechanism], most_kept: int = 6) -> Answers:
        """Return what the base has answered so far where these mechanisms change what it is asked."""
        key = tuple(mechanism.model_dump_json() for mechanism in mechanisms)
        kept = self.answers.pop(key, None) or Answers()
        self.answers[key] = kept
        if len(self.answers) > most_kept:
            del self.answers[next(oldest for oldest in self.answers if oldest)]
        return kept

    def _twist(self, mechanisms: Sequence[Mechanism], roles: Sequence[int]) -> Tensor:
        moment = self.moment()
        measured = true = moment.pose
        moving, changing = [], []
        for mechanism in reversed(mechanisms):
            before, true = true, mechanism.from_measured(true, self.conditions)
            if true is not before:
                moving.append(mechanism)
        moved_camera = true is not measured
        if moved_camera:
            moment = Moment(**{**vars(moment), "pose": true})
        given = list(self._commands())
        for mechanism in mechanisms:
            sent, given = given, [mechanism.transform_command(command, moment) for command in given]
            if any(one is not other for one, other in zip(given, sent, strict=True)):
                changing.append(mechanism)
        nominal = [mechanism for mechanism in mechanisms if mechanism.follows_clock()]
        if "duration_s" in self.base.inputs:
            changing += nominal
        if changing or "pose" in self.base.inputs:  # what a controller gives may depend on the pose
            changing += moving
        answers = self._answers(changing)
        twists = BaseTwists(self.base, moment, given, answers, roles, clock_is_nominal=bool(nominal))
        memory = remembered_after_two(mechanisms, twists)
        displacement = period_motion(mechanisms, twists, memory).displacement
        if not moved_camera:
            return log_map(displacement)
        end = compose(true, displacement)
        for mechanism in mechanisms:
            end = mechanism.to_measured(end, self.conditions)
        return log_map(displacement_between(measured, end))
