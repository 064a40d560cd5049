"""The simulation that a diagnosis examines: learned from the reference recording, or one that was trained before."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor, nn

from swarmtwin.dynamics.base import Dynamics
from swarmtwin.dynamics.situation import Situation
from swarmtwin.dynamics.twist import twist_of
from swarmtwin.gap.ensemble import Ensemble
from swarmtwin.gap.surroundings import Surroundings
from swarmtwin.robot import Robot, SituationPart

KNOWN_PARTS: tuple[SituationPart, ...] = ("command", "previous_command", "pose")
CHUNK = 512  # fits a processor's cache
LOT = 8192
TRIALS = 2000


class Columns:
    """The inputs of a learned base: commands by their limits, the pose by the walls as the vehicle sees them."""

    def __init__(self, robot: Robot, parts: Sequence[SituationPart], surroundings: Surroundings) -> None:
        self.robot, self.parts, self.surroundings = robot, tuple(parts), surroundings
        self._middle = torch.as_tensor((robot.command_low + robot.command_high) / 2)
        self._half = torch.as_tensor((robot.command_high - robot.command_low) / 2)
        self._reach_mm = 0.4 * max(robot.vehicle_size_mm)

    def of(self, command: Tensor, previous_command: Tensor, pose: Tensor) -> Tensor:
        """Return (N, columns), float32."""
        columns = [(command - self._middle) / self._half]
        if "previous_command" in self.parts:
            columns.append((previous_command - self._middle) / self._half)
        if "pose" in self.parts:
            columns.append(self.surroundings.walls_seen(pose, self._reach_mm))
        return torch.cat(columns, dim=-1).float()

    def groups(self) -> list[list[int]]:
        """Return the groups of columns whose effects add up: each actuator's, or the command's, and all together."""
        names, efforts = self.robot.command_columns, self.robot.actuation.effort
        commands = len(names)
        repeats = 2 if "previous_command" in self.parts else 1
        everything = list(range(commands * repeats + (5 if "pose" in self.parts else 0)))
        if len(efforts) > 1:
            own = [[names.index(effort) + commands * repeat for repeat in range(repeats)] for effort in efforts]
            return [*own, everything]
        return [list(range(commands)), everything]


class LearnedBase(nn.Module):
    """An ensemble of additive networks that predicts the way along an arc (N, 3)."""

    def __init__(
        self, robot: Robot, parts: tuple[SituationPart, ...], surroundings: Surroundings, ensemble: Ensemble
    ) -> None:
        super().__init__()
        self.robot, self.parts = robot, parts
        self.columns = Columns(robot, parts, surroundings)
        self.ensemble = ensemble
        self.member: int | None = None

    @property
    def members(self) -> int:
        """How many fits stand for what the reference leaves open."""
        return self.ensemble.members

    def description(self) -> dict[str, Any]:
        """Return what makes it up, without its weights."""
        return {
            "kind": "learned",
            "situation": list(self.parts),
            "members": self.members,
            "groups": self.ensemble.groups,
            "surroundings": self.columns.surroundings.model_dump(mode="json"),
        }

    def each(self, command: Tensor, previous_command: Tensor, pose: Tensor) -> Tensor:
        """Return every member's answer (M, N, 3), float32."""
        inputs = self.columns.of(command, previous_command, pose)
        with torch.no_grad():
            chunks = [self.ensemble(part) for part in inputs.split(CHUNK)]
        return torch.cat(chunks, dim=1)

    def way(self, command: Tensor, previous_command: Tensor, pose: Tensor) -> Tensor:
        """Return the mean of all members (N, 3), or the answer of `member` where one is chosen."""
        if self.member is None:
            return self.each(command, previous_command, pose).mean(dim=0).double()
        with torch.no_grad():
            return self.ensemble.answer(self.columns.of(command, previous_command, pose), self.member).double()


class SimulationBase(nn.Module):
    """A trained dynamics model, and what the reference is known to do beyond it.

    The correction is learned from the evidence kept beside the model: what the simulation already got wrong when it was
    learned is no news in a later session.
    """

    def __init__(self, dynamics: Dynamics, correction: LearnedBase | None) -> None:
        super().__init__()
        self.dynamics, self.correction = dynamics, correction
        self.robot = dynamics.robot
        parts = set(dynamics.parts) | set(correction.parts if correction else ())
        self.parts = tuple(part for part in KNOWN_PARTS if part in parts)

    @property
    def members(self) -> int:
        """How many fits stand for what the reference leaves open."""
        return self.correction.members if self.correction else 0

    def description(self) -> dict[str, Any]:
        """Return what makes it up, without its weights."""
        return {
            "kind": "simulation",
            "model": self.dynamics.config.model_dump(mode="json"),
            "correction": self.correction.description() if self.correction else None,
        }

    @property
    def member(self) -> int | None:
        """Which member answers; None: their mean."""
        return self.correction.member if self.correction else None

    @member.setter
    def member(self, member: int | None) -> None:
        if self.correction:
            self.correction.member = member

    def each(self, command: Tensor, previous_command: Tensor, pose: Tensor) -> Tensor:
        """Return every member's answer (M, N, 3)."""
        assert self.correction is not None
        alone = self._alone(command, previous_command, pose)
        return alone + self.correction.each(command, previous_command, pose)

    def way(self, command: Tensor, previous_command: Tensor, pose: Tensor) -> Tensor:
        """Return the model's answer with its correction, (N, 3)."""
        way = self._alone(command, previous_command, pose)
        return way + self.correction.way(command, previous_command, pose) if self.correction else way

    def _alone(self, command: Tensor, previous_command: Tensor, pose: Tensor) -> Tensor:
        given = {"command": command, "previous_command": previous_command, "pose": pose}
        situation = Situation(**{part: given[part].float() for part in self.dynamics.parts})
        with torch.no_grad():
            chunks = [self.dynamics(situation[slice(start, start + LOT)]) for start in range(0, len(situation), LOT)]
        return twist_of(torch.cat(chunks).double())


AnyBase = LearnedBase | SimulationBase


class CrossFitted:
    """A base on its own reference: each transition is answered by the member that has not seen its run."""

    def __init__(self, base: AnyBase, fold: np.ndarray) -> None:
        self.robot, self.parts = base.robot, base.parts
        self._base, self._fold = base, fold

    def way(self, command: Tensor, previous_command: Tensor, pose: Tensor) -> Tensor:
        """Return the answers (N, 3) for the reference's own transitions, in their order."""
        answers = self._base.each(command, previous_command, pose)
        return answers[self._fold, np.arange(len(self._fold))].double()


@dataclass(frozen=True)
class Trial:
    """Random commands to ask a base for, in the middle of the arena."""

    command: Tensor
    previous_command: Tensor
    pose: Tensor

    @classmethod
    def draw(cls, robot: Robot, seed: int) -> Self:
        """Draw commands over the robot's limits."""
        rng = np.random.default_rng(seed)
        drawn = rng.uniform(robot.command_low, robot.command_high, (2, TRIALS, len(robot.command)))
        middle = (robot.arena_mm.low_mm + robot.arena_mm.high_mm) / 2
        pose = np.concatenate([np.tile(middle, (TRIALS, 1)), rng.uniform(-np.pi, np.pi, (TRIALS, 1))], axis=1)
        return cls(*(torch.as_tensor(values) for values in (*drawn, pose)))


def learned_track_mm(base: AnyBase, trial: Trial) -> float | None:
    """Return the distance between the wheels that a base has learned: how much a wheel turns, by how far it brings.

    None where the robot has no left and right wheel, or the base knows nothing of them.
    """
    robot = base.robot
    if robot.actuation.track_mm:
        return robot.actuation.track_mm
    if robot.actuation.kind != "wheel" or len(robot.actuation.effort) != 2:
        return None
    ahead, turned = [], []
    for name, sign in zip(robot.actuation.effort, (-1.0, 1.0), strict=True):
        column = robot.command_columns.index(name)
        high, low = trial.command.clone(), trial.command.clone()
        high[:, column], low[:, column] = robot.command_high[column], robot.command_low[column]
        change = base.way(high, high, trial.pose) - base.way(low, low, trial.pose)
        ahead.append(change[:, 0])
        turned.append(sign * change[:, 2])
    track_mm = float(2 * torch.cat(ahead).mean() / torch.cat(turned).mean())
    return track_mm if track_mm > 0 else None


def learned_own_lag(base: AnyBase, trial: Trial) -> float:
    """Return how late, in periods, a base's actuators follow: the part of the old way that is left after a change."""
    if "previous_command" not in base.parts:
        return 0.0
    now = base.way(trial.command, trial.previous_command, trial.pose)
    settled = base.way(trial.command, trial.command, trial.pose)
    late = base.way(trial.previous_command, trial.previous_command, trial.pose) - settled
    size = late.std(dim=0).clamp(min=1e-9)
    own = float((((now - settled) / size) * (late / size)).sum() / ((late / size) ** 2).sum())
    return min(max(own, 0.0), 0.5)
