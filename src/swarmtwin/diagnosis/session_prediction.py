"""Simulations asked for what follows measured situations: the one place where the diagnosis predicts motion.

It runs the simulation's own signal chain, period by period, from the measured pose of each. What actuators remember is
carried through each run from its start, as `Simulation.step` carries it: all transitions are advanced at once, again
and again, each from what the one before it ended with, until nothing changes. Lag and play forget: a few rounds do.
The velocity of a simulation with momentum is simulated from the first measured one of each run: measured velocities
hold already what a cause does.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from swarmtwin.diagnosis.measured_session import SentCommands
from swarmtwin.dynamics.predictor import DynamicsModel
from swarmtwin.geometry import compose, displacement_between
from swarmtwin.learning.situation import Situation
from swarmtwin.simulation.arcs import log_map, twist_between
from swarmtwin.simulation.base_twists import Answers, BaseTwists
from swarmtwin.simulation.commands_in_force import Delays, InForce, commands_for, late_or_gradual
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.ensemble_dynamics import one_member
from swarmtwin.simulation.mechanism import Mechanism, Moment, in_signal_order
from swarmtwin.simulation.residual_model import ResidualModel
from swarmtwin.simulation.signal_chain import (
    FOLLOWING,
    ActuatorMotion,
    Memory,
    end_memory,
    following_motion,
    passed_on,
    period_motion,
    remembered_after_two,
    with_own_memory,
)


class LossOutcomes(NamedTuple):
    """Measured twists (N, 3) over a period, by which of the last commands arrived.

    Attributes:
        arrived: the present command did, and the one before it had.
        arrived_after_loss: the present command did, the one before it had not.
        lost: the present command did not, the one before it goes on.
        lost_twice: neither did, the one before these goes on.
    """

    arrived: Tensor
    arrived_after_loss: Tensor
    lost: Tensor
    lost_twice: Tensor


_OUTCOMES = ((0, 1, 2), (0, 2, 2), (1, 1, 1), (2, 2, 2))
"""Of each: which command is in force, which was before, and which before that: 0 the present one, 1 the last, …"""


@dataclass(frozen=True)
class SessionPredictor:
    """Predicts the N transitions of a session under mechanisms.

    Attributes:
        base: the simulation's dynamics model, or one member of it.
        conditions: of the session.
        situation: N measured situations, float64, whose previous and earlier commands are known.
        follows: (N,) index of the transition just before, of the same vehicle and run; −1 where there is none.
        sent: the commands as they were sent; None where each is sent at the beginning of its period.
        quick: answers nearly as the base, in a fraction of its time, where only differences are asked: between members,
            and between mechanisms; None: the base itself.
        answers: of the base so far, by the mechanisms that change what it is asked; those of the last few are kept.
        twists: (N, 3) that were asked for, by the mechanisms; those of the last few are kept.
        of_older: predictors of the same transitions that take an older command for the earlier one, by its age.
    """

    base: DynamicsModel
    conditions: SessionConditions
    situation: Situation
    follows: np.ndarray
    sent: SentCommands | None = None
    quick: DynamicsModel | None = None
    answers: dict[tuple[str, ...], Answers] = field(default_factory=lambda: {(): Answers()})
    twists: dict[tuple[object, ...], Tensor] = field(default_factory=dict)
    of_older: dict[int, "SessionPredictor"] = field(default_factory=dict)

    def with_member(self, member: int) -> "SessionPredictor":
        """Return it with one member of the base in the place of the mean of all, what is quick in the base's place."""
        base = one_member(self.quick or self.base, member)  # type: ignore[arg-type]
        return SessionPredictor(base, self.conditions, self.situation, self.follows, self.sent)

    @cached_property
    def as_recorded(self) -> "SessionPredictor":
        """It, where each command is sent as its row's period begins, whatever the log of the commands says."""
        if not self.sent:
            return self
        return replace(self, sent=None, answers={(): self.answers[()]}, twists={}, of_older={})

    def moment(self) -> Moment:
        """Return the situations as mechanisms see them, at their measured poses."""
        given = self.situation
        assert given.pose is not None
        assert given.elapsed_s is not None
        assert given.duration_s is not None
        assert given.neighbours is not None
        return Moment(
            robot=self.base.robot,
            conditions=self.conditions,
            pose=given.pose,
            elapsed_s=given.elapsed_s,
            duration_s=given.duration_s,
            neighbours=given.neighbours,
            neighbours_after=self._neighbours_after,
            velocity=given.velocity,
        )

    @cached_property
    def _neighbours_after(self) -> Tensor | None:
        """Where neighbours (N, M, 3) are at the end of each period, measured as it began: by the next transition.

        Where none follows, they are taken to be where they were.
        """
        pose, neighbours = self.situation.pose, self.situation.neighbours
        assert pose is not None
        assert neighbours is not None
        if not neighbours.isfinite().any():
            return None
        rows = torch.as_tensor((self.follows >= 0).nonzero()[0])
        before = torch.as_tensor(self.follows)[rows]
        then = displacement_between(pose[before][:, None], compose(pose[rows][:, None], neighbours[rows]))
        after = neighbours.clone()
        after[before] = torch.where(then.isfinite(), then, neighbours[before])
        return after

    def simulated(self) -> Tensor:
        """Return the twists (N, 3) of the base alone."""
        return self._undisturbed().response(0)

    def base_twist(self, command: Tensor, previous_command: Tensor) -> Tensor:
        """Return the twists (N, 3) of the base alone under other commands (N, m), and others before them."""
        moment = self._undisturbed().moment
        return BaseTwists(self.base, moment, (command, previous_command, previous_command)).response(0)

    def steady_twists(self) -> tuple[Tensor, Tensor]:
        """Return the twists (N, 3) of the base alone under the present command held for long, and the one before."""
        undisturbed = self._undisturbed()
        if undisturbed.has_momentum:
            return undisturbed.response(0), undisturbed.coasting()
        command, previous, _ = self._commands()
        return self.base_twist(command, command), self.base_twist(previous, previous)

    def twist(self, mechanisms: Sequence[Mechanism]) -> Tensor:
        """Return the measured twists (N, 3) where every command arrives."""
        return self._known_twist(mechanisms, (0, 1, 2))

    def outcomes(self, mechanisms: Sequence[Mechanism]) -> LossOutcomes:
        """Return how each transition goes, by which of its commands arrived."""
        return LossOutcomes(*(self._known_twist(mechanisms, roles) for roles in _OUTCOMES))

    @property
    def oldest_followed(self) -> int:
        """How many periods old the command in force may be at most: of two in five lost, one in 4,000 is older.

        Where commands are known as they were sent, three of them are known.
        """
        return 2 if self.sent else 8

    def course(self, mechanisms: Sequence[Mechanism], number: int) -> Tensor:
        """Return the measured twists (N, 3) of a course of `lost_commands`: of `outcomes`, or of an older command.

        Where a run has not had so many periods yet, its first known command was in force.
        """
        if number < len(_OUTCOMES):
            return self._known_twist(mechanisms, _OUTCOMES[number])
        age, goes_on = divmod(number, 2)
        _, arrived, _, lost = _OUTCOMES
        return self._with_older(age + 1)._known_twist(mechanisms, lost if goes_on else arrived)

    def _with_older(self, age: int) -> "SessionPredictor":
        """Return it with the command of so many periods before, three or more, in the place of the earlier one."""
        if age not in self.of_older:
            older = self.situation.earlier_command
            assert older is not None
            rows = torch.as_tensor(np.flatnonzero(self.follows >= 0))
            before = torch.as_tensor(self.follows)[rows]
            for _ in range(age - 2):
                older = older.index_copy(0, rows, older[before])
            situation = replace(self.situation, earlier_command=older)
            self.of_older[age] = SessionPredictor(
                self.base, self.conditions, situation, self.follows, self.sent, self.quick
            )
        return self.of_older[age]

    def _known_twist(self, mechanisms: Sequence[Mechanism], roles: Sequence[int], most_kept: int = 24) -> Tensor:
        """Return the twists (N, 3), known what arrived; those of the last few mechanisms are not predicted anew."""
        acting = in_signal_order(one for one in mechanisms if not one.is_arrival_alone)
        key = (*roles, *(mechanism.model_dump_json() for mechanism in acting))
        twist = self.twists.pop(key, None)
        self.twists[key] = self._twist(acting, roles) if twist is None else twist
        if len(self.twists) > most_kept:
            del self.twists[next(iter(self.twists))]
        return self.twists[key]

    def outcome_commands(self) -> list[tuple[Tensor, Tensor]]:
        """Return the commands (N, m) in force, and those in force before, of each of these ways."""
        commands = self._commands()
        return [(commands[now], commands[before]) for now, before, _ in _OUTCOMES]

    def most_likely_twist(self, mechanisms: Sequence[Mechanism], residual: ResidualModel | None = None) -> Tensor:
        """Return the most likely measured twists (N, 3), with what was learned beyond the mechanisms."""
        arrives = arrival_probability(mechanisms)
        twist = self.twist(mechanisms) if arrives >= 0.5 else self.outcomes(mechanisms).lost
        if residual is None:
            return twist
        command, previous, _ = self._commands()
        return twist + residual.twist(self.moment(), command, previous)

    def _commands(self) -> tuple[Tensor, Tensor, Tensor]:
        given = self.situation
        assert given.previous_command is not None
        assert given.earlier_command is not None
        return given.command, given.previous_command, given.earlier_command

    def _undisturbed(self) -> BaseTwists:
        return self._from_own_velocity(self._as_sent())

    def _as_sent(self) -> BaseTwists:
        """Return what the base answers to the commands as they were sent, from the measured poses."""
        return BaseTwists(self.base, self.moment(), self._commands(), self.answers[()], follows=self.follows)

    def _steps(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield transitions that follow others, and these others, indices (n,) each, the first of all runs first."""
        after = np.full(len(self.follows), -1)
        after[self.follows[self.follows >= 0]] = np.flatnonzero(self.follows >= 0)
        before = np.flatnonzero(self.follows < 0)
        while len(before := before[after[before] >= 0]):
            yield after[before], before
            before = after[before]

    def _in_force(self, given: Sequence[Tensor], mechanisms: Sequence[Mechanism]) -> Sequence[Tensor]:
        """Return the mean settings (N, m) in force in each period and before, where commands (N, m) are late."""
        delays = Delays.of(mechanisms, self.base.robot.period_s)
        command, previous, earlier = given
        past = InForce(*(values.clone() for values in InForce.after_two(previous, earlier, delays)))
        for rows, before in self._steps():
            left = InForce(*(values[before] for values in past)).followed_by(command[before], previous[before], delays)
            for carried, values in zip(past, left, strict=True):
                carried[rows] = values
        return commands_for(self.base.robot, past, past.followed_by(command, previous, delays))

    def _from_own_velocity(self, twists: BaseTwists) -> BaseTwists:
        """Let a base with momentum go on from its own velocity, simulated from the first measured one of each run."""
        if not twists.has_momentum:
            return twists
        if twists.known.velocity is None:
            velocity = twists.moment.velocity
            assert velocity is not None
            velocity = velocity.clone()
            for rows, before in self._steps():
                moving = replace(twists, moment=replace(twists.moment, velocity=velocity), roles=(0, 1, 2))
                velocity[rows] = moving.of_rows(before).velocity_after()
            twists.known.velocity = velocity
        return replace(twists, moment=replace(twists.moment, velocity=twists.known.velocity))

    def _answers(self, mechanisms: Sequence[Mechanism], most_kept: int = 6) -> Answers:
        """Return what the base has answered so far where these mechanisms change what it is asked."""
        key = tuple(mechanism.model_dump_json() for mechanism in mechanisms)
        kept = self.answers.pop(key, None) or Answers()
        self.answers[key] = kept
        if len(self.answers) > most_kept:
            del self.answers[next(oldest for oldest in self.answers if oldest)]
        return kept

    def _twist(self, mechanisms: Sequence[Mechanism], roles: Sequence[int]) -> Tensor:
        measured = self.moment()
        moment, changing = measured.at_true_poses(mechanisms), []
        moving = [one for one in mechanisms if type(one).from_measured is not Mechanism.from_measured]
        given = list(self._commands())
        late = [mechanism for mechanism in mechanisms if mechanism.latency_s() > 0] if self.sent else []
        if self.sent and late:  # known to the moment: what is in force is averaged, and nothing is late any more
            by_place = self.sent.late(sum(mechanism.latency_s() for mechanism in late))
            given = [torch.as_tensor(np.where(np.isfinite(one), one, by_place[0])) for one in by_place]
            mechanisms = [mechanism for mechanism in mechanisms if mechanism not in late]
            changing += late
        for mechanism in mechanisms:
            sent, given = given, passed_on(mechanism, given, moment)
            if any(one is not other for one, other in zip(given, sent, strict=True)):
                changing.append(mechanism)
        if "velocity" in self.base.inputs and (delaying := late_or_gradual(mechanisms)):
            given = list(self._in_force(given, delaying))
            mechanisms = [mechanism for mechanism in mechanisms if mechanism not in delaying]
            changing += delaying
        nominal = [mechanism for mechanism in mechanisms if mechanism.follows_clock()]
        if "duration_s" in self.base.inputs:
            changing += nominal
        if changing or "pose" in self.base.inputs:  # what a controller gives may depend on the pose
            changing += moving
        answers = self._answers(changing)
        undisturbed = self._as_sent() if changing else None
        twists = BaseTwists(self.base, moment, given, answers, roles, bool(nominal), self.follows, undisturbed)
        twists = self._from_own_velocity(twists)
        memory, followed = remembered_after_two(mechanisms, twists), None
        if memory and roles == (0, 1, 2):
            memory, followed = self._carried(mechanisms, twists, memory)
        displacement = period_motion(mechanisms, twists, memory, followed).displacement
        if not moving:
            return log_map(displacement)
        end = compose(moment.pose, displacement)
        for mechanism in mechanisms:
            end = mechanism.to_measured(end, self.conditions)
        return twist_between(measured.pose, end)

    def _carried(
        self, mechanisms: Sequence[Mechanism], twists: BaseTwists, memory: Memory
    ) -> tuple[dict[str, Tensor], ActuatorMotion]:
        """Return what actuators remember at the start of each transition, carried from the start of its run.

        What follows a command is carried first, since it hangs on nothing else; so how actuators follow is asked once.

        Args:
            mechanisms: in the order of the signal.
            twists: what the base answers.
            memory: where the rounds begin: what two commands leave.
        """
        following = {name: values for name, values in memory.items() if name in FOLLOWING}
        following = self._settled(following, _end_of_following(mechanisms, twists, following))
        followed = following_motion(mechanisms, twists, 0, following)
        own = {name: values for name, values in memory.items() if name not in FOLLOWING}
        own = self._settled(own, lambda start: with_own_memory(mechanisms, followed, twists, 0, start).memory)
        return following | own, followed

    def _settled(
        self,
        memory: Memory,
        ended: Callable[[Memory], Memory],
        most_rounds: int = 40,
        tolerance: float = 1e-3,
    ) -> dict[str, Tensor]:
        """Return memory at the start of transitions, each from the end of the one before it, until nothing changes.

        Args:
            memory: where the rounds begin.
            ended: takes memory from the start of each period to its end.
            most_rounds: of a memory that does not forget.
            tolerance: change, as a share of the memory's own spread, below which nothing is said to change.
        """
        settled = dict(memory)
        spread = {name: values.std(dim=0).clamp(min=1e-9) for name, values in memory.items()}
        follow = np.flatnonzero(self.follows >= 0)
        rows, before = torch.as_tensor(follow), torch.as_tensor(self.follows[follow])
        for _ in range(most_rounds if settled else 0):
            end = ended(settled)
            carried = {name: values.index_copy(0, rows, end[name][before]) for name, values in settled.items()}
            change = max(float(((carried[name] - settled[name]).abs() / spread[name]).max()) for name in settled)
            settled = carried
            if change < tolerance:
                break
        return settled


def _end_of_following(
    mechanisms: Sequence[Mechanism], twists: BaseTwists, memory: Memory
) -> Callable[[Memory], Memory]:
    """Return what takes what follows a command from the start of each period to its end.

    Each value goes towards where the command leads by its own share of the way, so two ends tell where any start leads.
    """
    from_zero, from_one = (
        end_memory(mechanisms, twists, {name: torch.full_like(values, start) for name, values in memory.items()})
        for start in (0.0, 1.0)
    )
    left = {name: from_one[name] - from_zero[name] for name in memory}
    return lambda start: {name: torch.addcmul(from_zero[name], left[name], start[name]) for name in memory}


def arrival_probability(mechanisms: Sequence[Mechanism]) -> float:
    """Return the probability that a command arrives."""
    arrives = 1.0
    for mechanism in mechanisms:
        arrives *= mechanism.arrival_probability()
    return arrives
