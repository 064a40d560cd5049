"""The one thing that moves vehicles: a dynamics model, extended by mechanisms where a diagnosis found some.

World, open loop, roll-outs, policies and the gate step this and nothing else. A bare dynamics model is the simplest
simulation: equation (1) of the paper, pose and command in, the next pose out.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor, nn

from swarmtwin.dynamics.motion_noise import MotionNoise
from swarmtwin.dynamics.predictor import DynamicsModel, NetworkDynamics
from swarmtwin.errors import UserError
from swarmtwin.geometry import compose, displacement_between, exp_map, log_map, wrap_angle
from swarmtwin.learning.situation import ALL_PARTS, Situation
from swarmtwin.robot import SituationPart
from swarmtwin.simulation.base_twists import BaseTwists
from swarmtwin.simulation.commands_in_force import Delays, InForce, commands_for, late_or_gradual
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.mechanism import Mechanism, Moment, in_signal_order, true_poses
from swarmtwin.simulation.residual_model import ResidualModel
from swarmtwin.simulation.signal_chain import passed_on, period_motion, remembered_after_long, remembered_after_two
from swarmtwin.simulation.state import State

OWN_VELOCITY = "velocity without mechanisms"
MEMBER = "member of the ensemble"


class Simulation(nn.Module):
    """Vehicles with state, moved by a dynamics model and by mechanisms in the order of the signal chain.

    Attributes:
        robot: whose vehicles it moves.
        dynamics: the dynamics model.
        mechanisms: what is different from the dynamics model, in the order of the signal.
        conditions: of the session that the mechanisms were found in.
        residual: what was learned beyond the mechanisms, or None.
        motion_noise: the random part of motion and camera, or None where it is not known.
        inputs: the parts of a measured situation that it looks at.
        command_at_rest: (m,) the command nearest to zero.
    """

    def __init__(
        self,
        dynamics: DynamicsModel,
        mechanisms: Sequence[Mechanism] = (),
        conditions: SessionConditions | None = None,
        residual: ResidualModel | None = None,
        motion_noise: MotionNoise | None = None,
    ) -> None:
        super().__init__()
        self.robot = dynamics.robot
        self.dynamics = dynamics
        self.mechanisms = in_signal_order(mechanisms)
        self.conditions = conditions or SessionConditions(arena_mm=self.robot.arena_mm, session_s=self.robot.period_s)
        self.residual = residual
        self.motion_noise = motion_noise or getattr(dynamics, "motion_noise", None)
        needed = {*dynamics.inputs, *(part for mechanism in self.mechanisms for part in mechanism.inputs)}
        if residual:
            needed |= set(residual.inputs)
        self.inputs: tuple[SituationPart, ...] = tuple(part for part in ALL_PARTS if part in needed)
        self.command_at_rest = torch.from_numpy(self.robot.command_at_rest)

    @property
    def is_extended(self) -> bool:
        """Whether it is more than a dynamics model."""
        return bool(self.mechanisms) or self.residual is not None

    @property
    def _at_once(self) -> list[Mechanism]:
        """The mechanisms that do not say when commands act."""
        late = late_or_gradual(self.mechanisms)
        return [mechanism for mechanism in self.mechanisms if mechanism not in late]

    def start(
        self,
        pose: Tensor,
        elapsed_s: float | Tensor | None = None,
        rng: torch.Generator | None = None,
        velocity: Tensor | None = None,
        previous_command: Tensor | None = None,
    ) -> State:
        """Put vehicles down.

        Args:
            pose: (W, K, 3) true poses of K vehicles in each of W worlds.
            elapsed_s: time since the session began, one number or (W, K). None: 0, or where `rng` is given and the
                simulation ages, a moment of the session, the same for all vehicles of a world.
            rng: draws that moment.
            velocity: (W, K, 3) forward_mm_s, left_mm_s, turn_rad_s, measured, of a dynamics model that looks at it;
                None: they are at rest.
            previous_command: (W, K, m) in force before; NaN or None: not known.
        """
        pose = torch.as_tensor(pose, dtype=torch.float64)
        pose = torch.cat([pose[..., :2], wrap_angle(pose[..., 2:])], dim=-1)
        shape = pose.shape[:2]
        if elapsed_s is None:
            elapsed_s = torch.zeros(shape, dtype=torch.float64)
            if rng is not None and any("elapsed_s" in mechanism.inputs for mechanism in self.mechanisms):
                drawn = torch.rand(shape[0], 1, generator=rng, dtype=torch.float64, device=pose.device)
                elapsed_s = (drawn * self.conditions.session_s).expand(shape)
        elapsed_s = torch.as_tensor(elapsed_s, dtype=torch.float64).expand(shape).clone()
        unknown = torch.full((*shape, len(self.robot.command)), torch.nan, dtype=torch.float64, device=pose.device)
        velocity = torch.zeros_like(pose) if velocity is None else torch.as_tensor(velocity, dtype=torch.float64)
        previous = unknown if previous_command is None else torch.as_tensor(previous_command, dtype=torch.float64)
        state = State(pose, elapsed_s, previous, unknown, velocity)
        if not self.is_extended:
            return replace(state, memory=self._drawn_members(shape, rng))
        held = self._known(previous, self.command_at_rest.expand_as(previous)).flatten(0, 1)
        twists = self._twists(self._moment(state, None, None), [held] * 3)
        if twists.has_momentum:
            own = self._from_own_velocity(twists, self.to_measured(twists.moment.pose)).velocity
            assert own is not None
            memory = remembered_after_long(self._at_once, twists, 0)
            memory |= InForce.at_rest(twists.setting(0)).memory() | {OWN_VELOCITY: own}
        else:
            memory = remembered_after_long(self.mechanisms, twists, 0)
        return replace(state, memory=_unflattened(memory, shape))

    def step(
        self,
        state: State,
        command: Tensor,
        duration_s: Tensor | None = None,
        rng: torch.Generator | None = None,
        neighbours: Tensor | None = None,
        neighbours_after: Tensor | None = None,
    ) -> State:
        """Hold commands for one control period.

        Args:
            state: where W worlds of K vehicles are.
            command: (W, K, m) as sent, in the robot's units.
            duration_s: (W, K) the period's length; None: nominal, or drawn where `rng` is given and the clock is said
                to be irregular.
            rng: with it everything random is drawn: lost commands, irregular periods, the motion's random part.
                Without it the most likely motion is taken.
            neighbours: (W, K, M, 3) what the vehicles see of others; None: those of their own world.
            neighbours_after: (W, K, M, 3) where these come to, in the same frames; None: of their own world where they
                most likely do, of others they stay.

        Raises:
            UserError: the dynamics model predicts something that is not finite.
        """
        shape = state.pose.shape[:2]
        command = self._in_force(state, torch.as_tensor(command, dtype=torch.float64), rng)
        if duration_s is None and rng is not None:
            duration_s = self.drawn_duration_s(shape, rng)
        if neighbours is None and neighbours_after is None and self.looks_at_neighbours:
            neighbours_after = state.neighbours_at(self.most_likely_end(state, command, duration_s))
        moment = self._moment(state, duration_s, neighbours, neighbours_after)
        commands, memory = self._carried_on(state, command)
        displacement, memory = self._motion(moment, commands, memory)
        likeliest = displacement
        if rng is not None and MEMBER in memory:
            own = BaseTwists(self.dynamics, moment, commands)
            displacement = own.drawn_displacement(memory[MEMBER], rng)
        elif rng is not None and self.motion_noise is not None:
            displacement = self.motion_noise.sample(displacement, rng, self.noise_factor)
        if not bool(displacement.isfinite().all()):
            raise UserError(
                f"the simulation of {self.robot.name!r} predicts a displacement that is not finite: train its dynamics "
                "model anew"
            )
        velocity, usual = (log_map(moved) / moment.duration_s[:, None] for moved in (displacement, likeliest))
        if OWN_VELOCITY in memory:
            memory[OWN_VELOCITY] = memory[OWN_VELOCITY] + velocity - usual
        return State(
            pose=compose(state.pose, displacement.reshape(*shape, 3)),
            elapsed_s=state.elapsed_s + moment.duration_s.reshape(shape),
            previous_command=command,
            earlier_command=state.previous_command,
            velocity=velocity.reshape(*shape, 3),
            memory=_unflattened(memory, shape),
        )

    @property
    def looks_at_neighbours(self) -> bool:
        """Whether a mechanism looks at neighbours."""
        return any("neighbours" in mechanism.inputs for mechanism in self.mechanisms)

    def most_likely_end(
        self, state: State, command: Tensor, duration_s: Tensor | None = None, neighbours: Tensor | None = None
    ) -> Tensor:
        """Return the true poses (W, K, 3) that `step` most likely leads to while neighbours stay; given likewise."""
        moment = self._moment(state, duration_s, neighbours)
        command = torch.as_tensor(command, dtype=torch.float64)
        displacement, _ = self._motion(moment, *self._carried_on(state, command))
        return compose(state.pose, displacement.reshape(state.pose.shape))

    def drawn_duration_s(self, shape: Sequence[int], rng: torch.Generator) -> Tensor | None:
        """Draw the length of the period, (W, K), the same for all vehicles of a world: they have one controller.

        None: it is nominal.
        """
        for mechanism in self.mechanisms:
            drawn = mechanism.draw_duration_s(shape[0], self.robot.period_s, rng)
            if drawn is not None:
                return drawn[:, None].expand(*shape)
        return None

    def observe(self, state: State, rng: torch.Generator | None = None) -> Tensor:
        """Return the poses (W, K, 3) that the camera measures; with `rng`, with its noise."""
        pose = self.to_measured(state.pose.reshape(-1, 3)).reshape(state.pose.shape)
        if rng is not None and self.motion_noise is not None:
            pose = self.motion_noise.photograph(pose, rng)
        return pose

    def predict(self, situation: Situation) -> Tensor:
        """Return the most likely measured displacements (N, 3) that follow N measured situations.

        The actuators' state is that which the two commands before leave; where those are not known, that of rest.
        """
        if not self.is_extended:
            return self.dynamics.predict(situation)
        moment, measured = self._measured_moment(situation)
        command = situation.command.double()
        previous = self._known(situation.previous_command, self.command_at_rest.expand_as(command))
        earlier = self._known(situation.earlier_command, previous)
        commands = [command, previous, earlier]
        twists = self._twists(moment, commands)
        if twists.has_momentum:
            moment = self._from_own_velocity(twists, measured)
        end = self._end_after(commands, moment)
        return displacement_between(measured, self.to_measured(end))

    @property
    def noise_factor(self) -> float:
        """Factor of all mechanisms on the motion's random part."""
        factor = 1.0
        for mechanism in self.mechanisms:
            factor *= mechanism.noise_factor()
        return factor

    def to_measured(self, pose: Tensor) -> Tensor:
        """Return what the camera measures of true poses (N, 3)."""
        for mechanism in self.mechanisms:
            pose = mechanism.to_measured(pose, self.conditions)
        return pose

    def from_measured(self, pose: Tensor) -> Tensor:
        """Return which true poses (N, 3) are measured like this."""
        return true_poses(self.mechanisms, pose, self.conditions)

    def _drawn_members(self, shape: Sequence[int], rng: torch.Generator | None) -> dict[str, Tensor]:
        """Return which member of a probabilistic model each vehicle (W, K) is, for as long as it drives.

        Vehicles differ as members do. Without `rng` it is −1, all of them together; other models have no members.
        """
        members = self.dynamics.drawn_members if isinstance(self.dynamics, NetworkDynamics) else 0
        if not members:
            return {}
        if rng is None:
            return {MEMBER: torch.full(tuple(shape), -1)}
        return {MEMBER: torch.randint(members, tuple(shape), generator=rng, device=rng.device)}

    def _in_force(self, state: State, command: Tensor, rng: torch.Generator | None) -> Tensor:
        """Return the commands (W, K, m) that act on: those sent, or where they are lost those in force before."""
        arrives = 1.0
        for mechanism in self.mechanisms:
            arrives *= mechanism.arrival_probability()
        if arrives >= 1.0 or (rng is None and arrives >= 0.5):
            return command
        before = self._known(state.previous_command, self.command_at_rest.expand_as(command))
        if rng is None:
            return before
        drawn = torch.rand(command.shape[:2], generator=rng, dtype=torch.float64, device=command.device)
        return torch.where((drawn < arrives)[..., None], command, before)

    def _carried_on(self, state: State, command: Tensor) -> tuple[list[Tensor], dict[str, Tensor]]:
        """Return the command (W, K, m) in force and the two before, and what is remembered, each of W · K vehicles."""
        commands = [_flattened(values) for values in (command, state.previous_command, state.earlier_command)]
        return commands, {name: _flattened(values) for name, values in state.memory.items()}

    def _moment(
        self,
        state: State,
        duration_s: Tensor | None,
        neighbours: Tensor | None,
        neighbours_after: Tensor | None = None,
    ) -> Moment:
        if duration_s is None:
            duration_s = torch.full_like(state.elapsed_s, self.robot.period_s)
        if neighbours is None and "neighbours" in self.inputs:
            neighbours = state.neighbours
        elif neighbours is None:
            neighbours = state.pose.new_zeros(*state.pose.shape[:2], 0, 3)
        return Moment(
            robot=self.robot,
            conditions=self.conditions,
            pose=_flattened(state.pose),
            elapsed_s=_flattened(state.elapsed_s),
            duration_s=_flattened(duration_s),
            neighbours=_flattened(neighbours),
            neighbours_after=None if neighbours_after is None else _flattened(neighbours_after),
            velocity=_flattened(state.velocity),
        )

    def _measured_moment(self, situation: Situation) -> tuple[Moment, Tensor]:
        """Return N measured situations as mechanisms see them, and the measured poses (N, 3)."""
        count = len(situation)
        measured = situation.pose if situation.pose is not None else torch.zeros(count, 3)
        elapsed_s = situation.elapsed_s if situation.elapsed_s is not None else torch.zeros(count)
        period_s = self.robot.period_s
        duration_s = situation.duration_s if situation.duration_s is not None else torch.full((count,), period_s)
        neighbours = situation.neighbours if situation.neighbours is not None else torch.zeros(count, 0, 3)
        measured = measured.double()
        velocity = situation.velocity.double().nan_to_num() if situation.velocity is not None else None
        moment = Moment(
            robot=self.robot,
            conditions=self.conditions,
            pose=measured,
            elapsed_s=elapsed_s.double(),
            duration_s=duration_s.double(),
            neighbours=neighbours.double(),
            velocity=velocity,
        )
        return moment.at_true_poses(self.mechanisms), measured

    def _end_after(self, commands: Sequence[Tensor], moment: Moment) -> Tensor:
        """Return the true poses (N, 3) after the first of the commands; the others, (N, m), were held before it."""
        twists = self._twists(moment, commands)
        mechanisms = self._at_once if twists.has_momentum else self.mechanisms
        displacement, _ = self._motion(moment, commands, remembered_after_two(mechanisms, twists))
        return compose(moment.pose, displacement)

    def _motion(
        self, moment: Moment, commands: Sequence[Tensor], memory: Mapping[str, Tensor]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Return displacements (N, 3) under the first of the commands, (N, m), and what is remembered."""
        if not self.is_extended:
            return BaseTwists(self.dynamics, moment, commands).displacement(), dict(memory)
        command, *before = commands
        previous = self._known(before[0], self.command_at_rest.expand_as(command))
        filled = [command, previous, self._known(before[1], previous)]
        if "velocity" in self.dynamics.inputs:
            displacement, memory = self._motion_with_momentum(moment, filled, memory)
        else:
            displacement, memory = period_motion(self.mechanisms, self._twists(moment, filled), memory)
        if self.residual:
            displacement = exp_map(log_map(displacement) + self.residual.twist(moment, command, previous))
        return displacement, dict(memory)

    def _motion_with_momentum(
        self, moment: Moment, commands: Sequence[Tensor], memory: Mapping[str, Tensor]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the same of a dynamics model that goes on from its own velocity, by the settings in force."""
        moment = replace(moment, velocity=memory.get(OWN_VELOCITY, moment.velocity))
        twists, delays = self._twists(moment, commands), Delays.of(self.mechanisms, self.robot.period_s)
        command, previous, earlier = twists.commands
        before = InForce.of_memory(memory) or InForce.after_two(previous, earlier, delays)
        now = before.followed_by(command, previous, delays)
        twists = replace(twists, commands=commands_for(self.robot, before, now))
        kept = {name: values for name, values in memory.items() if name not in {OWN_VELOCITY, *now.memory()}}
        displacement, kept = period_motion(self._at_once, twists, kept)
        return displacement, kept | now.memory() | {OWN_VELOCITY: twists.velocity_after()}

    def _from_own_velocity(self, twists: BaseTwists, measured: Tensor, rounds: int = 8) -> Moment:
        """Return the moment with the velocity from which the dynamics model goes on, where the measured one is known.

        That velocity which mechanisms make the measured one of, when vehicles go on as they did: by repetition.
        """
        moment, shown = twists.moment, twists.moment.velocity
        assert shown is not None
        period_s = self.robot.period_s
        moment, own = replace(moment, duration_s=torch.full_like(moment.duration_s, period_s)), shown
        for _ in range(rounds):
            moving = replace(twists, moment=replace(moment, velocity=own)).moving_on()
            motion = period_motion(self._at_once, moving, remembered_after_two(self._at_once, moving))
            end = self.to_measured(compose(moment.pose, motion.displacement))
            own = own + shown - log_map(displacement_between(measured, end)) / period_s
        return replace(twists.moment, velocity=own)

    def _twists(self, moment: Moment, commands: Sequence[Tensor]) -> BaseTwists:
        """Prepare to ask the dynamics model for commands (N, m) as sent."""
        given = list(commands)
        for mechanism in self.mechanisms:
            given = passed_on(mechanism, given, moment)
        nominal = any(mechanism.follows_clock() for mechanism in self.mechanisms)
        return BaseTwists(self.dynamics, moment, given, clock_is_nominal=nominal)

    @staticmethod
    def _known(command: Tensor | None, otherwise: Tensor) -> Tensor:
        """Return commands (..., m), where there was none another one."""
        if command is None:
            return otherwise
        return torch.where(command.isnan(), otherwise, command.double())


def _flattened(values: Tensor) -> Tensor:
    return values.flatten(0, 1)


def _unflattened(memory: Mapping[str, Tensor], shape: Sequence[int]) -> dict[str, Tensor]:
    return {name: values.reshape(*shape, *values.shape[1:]) for name, values in memory.items()}
