"""What a dynamics model answers to the last commands of N vehicles, as twists (N, 3) per nominal period.

Forward and left in mm, turn in rad: the constant motion that leads to the displacement it predicts.

A model that looks at velocity has momentum: no twist is steady, and what a command brings about hangs on all before it.
It goes on from its own velocity, that of its answer to the period before, whatever mechanisms made of that answer; so a
command before the present one stands for the motion it left. What acts late and gradually on it says
`commands_in_force.py`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from swarmtwin.dynamics.predictor import DynamicsModel, NetworkDynamics
from swarmtwin.geometry import rotate
from swarmtwin.learning.situation import Situation
from swarmtwin.simulation.arcs import exp_map
from swarmtwin.simulation.ensemble_dynamics import CorrectedDynamics, CrossFitted, twist_of
from swarmtwin.simulation.mechanism import Moment


@dataclass
class Answers:
    """Twists (N, 3) that a dynamics model has answered to the same commands from the same poses.

    Attributes:
        to_commands: by the indices of the command and of the one before it.
        between: to settings between those of two commands, by their indices and the share of the way that is left.
        to_settings: to settings on their way, by the roles of the commands, the way and the share of it that is left.
        delays: lateness and lag for which these settings hold.
        velocity: (N, 3) forward_mm_s, left_mm_s, turn_rad_s, from which a model with momentum goes on; None: not known.
        held_back: (N, 2) mm by which walls held vehicles back, by the same indices.
        of_part: of the parts of a model whose answers add up.
    """

    to_commands: dict[tuple[int, int], Tensor] = field(default_factory=dict)
    between: dict[tuple[int, int, float], Tensor] = field(default_factory=dict)
    to_settings: dict[tuple[object, ...], Tensor] = field(default_factory=dict)
    delays: tuple[float, float] = (0.0, 0.0)
    velocity: Tensor | None = None
    held_back: dict[tuple[int, int], Tensor] = field(default_factory=dict)
    of_part: "dict[str, Answers]" = field(default_factory=dict)


@dataclass(frozen=True)
class BaseTwists:
    """What a dynamics model answers to the last commands of N vehicles, each question asked once.

    Attributes:
        dynamics: the model.
        moment: where the vehicles are.
        commands: (N, m) each, as the actuators are given them: the present one, the one before, and so on.
        known: answers so far; shared between evaluations in which commands, poses and what came before are the same.
        roles: which of the commands stands in each place: (0, 1, 2), unless a command was lost and another goes on.
        clock_is_nominal: whether the model is told the nominal period whatever the measured one, since a mechanism
            accounts for the difference.
        follows: (N,) index of the one of these N periods that came just before, of the same vehicle, −1 where it is not
            among them: what a model that looks at commands alone answered there is not asked again. None: none is.
        undisturbed: of the same periods, where commands may be others: what such a model answered to the same commands
            there is not asked again either. None: not known.
    """

    dynamics: DynamicsModel
    moment: Moment
    commands: Sequence[Tensor]
    known: Answers = field(default_factory=Answers)
    roles: Sequence[int] = (0, 1, 2)
    clock_is_nominal: bool = False
    follows: np.ndarray | None = None
    undisturbed: "BaseTwists | None" = None

    def setting(self, place: int) -> Tensor:
        """Return the commands (N, m) in a place: 0 for the present one."""
        return self.commands[self.roles[place]]

    def of_rows(self, rows: np.ndarray) -> "BaseTwists":
        """Return it for some of the vehicles, nothing known of them yet."""
        dynamics = self.dynamics.of_rows(rows) if isinstance(self.dynamics, CrossFitted) else self.dynamics
        return replace(
            self,
            dynamics=dynamics,
            moment=self.moment.of_rows(rows),
            commands=[command[rows] for command in self.commands],
            known=Answers(),
            follows=None,
            undisturbed=None,
        )

    @property
    def has_momentum(self) -> bool:
        """Whether the model looks at velocity."""
        return "velocity" in self.dynamics.inputs

    def response(self, place: int) -> Tensor:
        """Return the twists under the command in a place after the one before it, held over one period each."""
        if place and self.has_momentum:
            return self.coasting()
        return self._answer(self.roles[place], self.roles[place + 1])

    def steady(self, place: int) -> Tensor:
        """Return the twists under the command in a place, held for long; with momentum, over its one period."""
        if self.has_momentum:
            return self.response(place)
        return self._answer(self.roles[place], self.roles[place])

    def coasting(self) -> Tensor:
        """Return the twists (N, 3) with which the period before went."""
        assert self.moment.velocity is not None
        return self.moment.velocity * self.moment.robot.period_s

    def moving_on(self) -> "BaseTwists":
        """Return what would be answered if vehicles went on as in the period before."""
        now, before, *_ = self.roles
        return replace(self, known=Answers({(now, before): self.coasting(), (now, now): self.coasting()}))

    def velocity_after(self) -> Tensor:
        """Return the velocity (N, 3) in mm/s and rad/s from which a model with momentum goes on next."""
        return self.response(0) / self.moment.robot.period_s

    def held_back_mm(self) -> Tensor:
        """Return how much further vehicles would come in the middle of the arena, (N, 2) mm along its axes.

        Nothing where no walls stop them, and for those so far from all walls that they cannot reach one.
        """
        key = (self.roles[0], self.roles[1])
        if key not in self.known.held_back:
            self.known.held_back[key] = self._held_back_mm()
        return self.known.held_back[key]

    def _held_back_mm(self) -> Tensor:
        conditions, pose = self.moment.conditions, self.moment.pose
        held_back = torch.zeros_like(pose[:, :2])
        if conditions.clearance_mm is None:
            return held_back
        reach_mm = max(conditions.clearance_mm) + self.moment.robot.largest_displacement.forward_mm
        rows = (conditions.wall_distance_mm(pose[:, :2]) < reach_mm).nonzero()[:, 0]
        if len(rows):
            middle = torch.cat([conditions.centre_mm.expand(len(rows), 2), pose[rows, 2:]], dim=-1)
            near = self.of_rows(rows.numpy())
            free = replace(near, moment=replace(near.moment, pose=middle)).response(0)
            more = exp_map(free) - exp_map(self.response(0)[rows])
            held_back[rows] = rotate(more[:, :2], pose[rows, 2])
        return held_back

    def displacement(self) -> Tensor:
        """Return the model's own answer to the present command, displacements (N, 3), with nothing beyond it."""
        before, earlier = self.commands[1], self.commands[2]
        return self.dynamics.predict(self._situation(self.commands[0], before, earlier)).double()

    def drawn_displacement(self, member: Tensor, rng: torch.Generator) -> Tensor:
        """Draw displacements (N, 3) from what the model's members (N,) answer to the present command.

        Of a model with `drawn_members` alone; −1 stands for all of them together.
        """
        assert isinstance(self.dynamics, NetworkDynamics)
        return self.dynamics.sample(self._situation(*self.commands[:3]), rng, member)

    def between(self, start: int, target: int, left: float) -> Tensor:
        """Return the twists under a setting held for long that lies between those of two commands.

        Args:
            start: the place of the one.
            target: of the other.
            left: share of the way that is left.
        """
        if start == target or left in (0.0, 1.0):
            return self.steady(start if left else target)
        key = (self.roles[start], self.roles[target], left)
        if key not in self.known.between:
            setting = self.setting(target) + left * (self.setting(start) - self.setting(target))
            self.known.between[key] = self._ask(setting, setting, setting)
        return self.known.between[key]

    def at_setting(self, setting: Tensor, way: tuple[object, ...], delays: tuple[float, float]) -> Tensor:
        """Return the twists under a setting (N, m) held for long.

        Args:
            setting: which fins or propellers pass through within the period.
            way: tells the setting from others: from where to where it leads, and how much of that is left.
            delays: lateness and lag for which the same way leads through the same settings.
        """
        if delays != self.known.delays:
            self.known.to_settings, self.known.delays = {}, delays
        key = (*self.roles, *way)
        if key not in self.known.to_settings:
            self.known.to_settings[key] = self._ask(setting, setting, setting)
        return self.known.to_settings[key]

    def _answer(self, now: int, before: int) -> Tensor:
        if "previous_command" not in self.dynamics.inputs:
            before = now
        known = self.known.to_commands
        if (now, before) not in known:
            known[now, before] = self._new_answer(now, before)
        return known[now, before]

    def _new_answer(self, now: int, before: int) -> Tensor:
        if isinstance(self.dynamics, CorrectedDynamics) and self.dynamics.correction:
            alone, correction = self._part("dynamics"), self._part("correction")
            return alone._answer(now, before) + correction._answer(now, before)
        by_commands = {"command", "previous_command"}.issuperset(self.dynamics.inputs)
        return self._completed(now, before) if by_commands else self._asked(now, before)

    def _part(self, name: str) -> "BaseTwists":
        """Return a part of a model whose twists add up: it may look at less, and be asked less often."""
        return replace(
            self,
            dynamics=getattr(self.dynamics, name),
            known=self.known.of_part.setdefault(name, Answers()),
            undisturbed=self.undisturbed._part(name) if self.undisturbed else None,
        )

    def _asked(self, now: int, before: int) -> Tensor:
        earlier = before if now == before else min(before + 1, len(self.commands) - 1)
        return self._ask(*(self.commands[index] for index in (now, before, earlier)))

    def _completed(self, now: int, before: int) -> Tensor:
        """Return what was answered to the same two commands elsewhere, and ask where they are not the same."""
        commands = torch.cat([self.commands[now], self.commands[before]], dim=-1)
        twist, is_new = torch.empty(len(commands), 3, dtype=torch.float64), torch.ones(len(commands), dtype=torch.bool)
        for others, twists in self._answered(now, before):
            same = is_new & (commands == others).all(dim=-1)
            twist[same] = twists[same]
            is_new &= ~same
        if is_new.all():
            return self._asked(now, before)
        if is_new.any():
            twist[is_new] = self.of_rows(is_new.nonzero()[:, 0].numpy())._asked(now, before)
        return twist

    def _answered(self, now: int, before: int) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield pairs of commands (N, 2 m) and what was answered to them, (N, 3)."""
        if now and before and self.follows is not None:
            rows = torch.as_tensor(np.maximum(self.follows, 0))
            commands = torch.cat([self.commands[now - 1], self.commands[before - 1]], dim=-1)[rows]
            yield commands, self._answer(now - 1, before - 1)[rows]
        if self.undisturbed:
            others = self.undisturbed.commands
            yield torch.cat([others[now], others[before]], dim=-1), self.undisturbed._answer(now, before)

    def _ask(self, command: Tensor, previous: Tensor, earlier: Tensor) -> Tensor:
        return twist_of(self.dynamics, self._situation(command, previous, earlier))

    def _situation(self, command: Tensor, previous: Tensor, earlier: Tensor) -> Situation:
        moment = self.moment
        if self.clock_is_nominal:
            moment = replace(moment, duration_s=torch.full_like(moment.duration_s, moment.robot.period_s))
        return moment.situation(command, previous, earlier).only(self.dynamics.inputs)
