"""Dynamics models that a diagnosis learns by itself: cross-fitted ensembles, alone or as a correction of another model.

Both answer member by member, so that what the reference leaves open can be told from what is wrong.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from swarmtwin.dynamics.predictor import DynamicsModel, DynamicsModule, NetworkDynamics
from swarmtwin.learning.encoding import Encoding, Feature
from swarmtwin.learning.ensemble import Ensemble
from swarmtwin.learning.situation import Situation
from swarmtwin.robot import Robot, SituationPart
from swarmtwin.simulation.arcs import exp_map, log_map
from swarmtwin.simulation.conditions import SessionConditions

KNOWN_INPUTS: tuple[SituationPart, ...] = ("command", "previous_command", "pose", "velocity")


def wall_reaches_over(conditions: SessionConditions) -> tuple[float, ...]:
    """Return distances in mm over which walls may be felt: nobody knows them beforehand, so a ladder over the arena."""
    shorter_mm = float(min(conditions.arena_mm.high_mm - conditions.arena_mm.low_mm))
    return shorter_mm / 8, shorter_mm / 32


def ensemble_encoding(
    robot: Robot, inputs: Sequence[SituationPart], wall_reaches_mm: Sequence[float], conditions: SessionConditions
) -> tuple[Encoding, list[list[int]]]:
    """Return how an ensemble sees a situation, and the groups of columns whose effects add up.

    Commands and velocities are scaled by their limits, the pose is seen as walls that fade over `wall_reaches_mm`.
    Groups: the columns of each actuator, or where there is only one those of the command, and all together.
    """
    features: list[Feature] = ["command"]
    if "previous_command" in inputs:
        features.append("previous_command")
    if "pose" in inputs:
        features.append("walls")
    if "velocity" in inputs:
        features.append("velocity")
    encoding = Encoding(robot, features, "limits", arena_mm=conditions.arena_mm, wall_reaches_mm=wall_reaches_mm)
    everything = list(range(encoding.width))
    command, previous = encoding.columns_of("command"), encoding.columns_of("previous_command")
    efforts = [robot.command_columns.index(name) for name in robot.actuation.effort]
    if len(efforts) < 2:
        return encoding, [command, everything]
    return encoding, [
        *([columns[effort] for columns in (command, previous) if columns] for effort in efforts),
        everything,
    ]


def coasting(robot: Robot, inputs: Sequence[SituationPart], situation: Situation) -> Tensor:
    """Return the twists (N, 3) of going on as before, from which an ensemble that is given the velocity starts; else 0.

    Momentum changes motion little in a period: so the ensemble learns the change, which is smaller than the motion, and
    errs less where its answers are put in again and again.
    """
    if "velocity" not in inputs or situation.velocity is None:
        return torch.zeros(len(situation), 3, dtype=torch.float64, device=situation.command.device)
    return situation.velocity.double().nan_to_num() * robot.period_s


class EnsembleDynamics(DynamicsModule):
    """A dynamics model of several additive networks, each of which has not seen one part of the runs.

    Attributes:
        robot: whose motion it predicts.
        inputs: the parts of a situation that it looks at.
        conditions: of the session that it was learned from.
        encoding: of the inputs as columns.
        ensemble: predicts twists over a nominal period, beyond what `coasting` says.
        batch_size: the most situations asked for at a time; this many fit a processor's cache.
    """

    batch_size: int = 512

    def __init__(
        self,
        robot: Robot,
        inputs: tuple[SituationPart, ...],
        wall_reaches_mm: Sequence[float],
        conditions: SessionConditions,
        ensemble: Ensemble,
    ) -> None:
        super().__init__()
        self.robot, self.inputs = robot, inputs
        self.conditions = conditions
        self.encoding, _ = ensemble_encoding(robot, inputs, wall_reaches_mm, conditions)
        self.ensemble = ensemble

    @property
    def members(self) -> int:
        """How many fits stand for what the reference leaves open."""
        return self.ensemble.members

    def description(self) -> dict[str, Any]:
        """Return what makes it up, without its weights."""
        return {
            "kind": "learned",
            "situation": list(self.inputs),
            "members": self.members,
            "groups": self.ensemble.groups,
            "wall_reaches_mm": list(self.encoding.wall_reaches_mm),
            "surroundings": self.conditions.model_dump(mode="json"),
        }

    def predict(self, situation: Situation) -> Tensor:
        """Return the expected displacements (N, 3), float64: the mean of all members."""
        return exp_map(self.twist(situation))

    def twist(self, situation: Situation, member: int | None = None) -> Tensor:
        """Return twists (N, 3), float64, over a nominal period: the mean of all members, or one member's."""
        if member is None:
            return self.member_twists(situation).mean(dim=0).double()
        with torch.no_grad():
            twist = self.ensemble.answer(self._encoded(situation), member).double().to(situation.command.device)
        return twist + coasting(self.robot, self.inputs, situation)

    def member_twists(self, situation: Situation) -> Tensor:
        """Return every member's twists (M, N, 3), float32."""
        inputs = self._encoded(situation)
        with torch.no_grad():
            twists = torch.cat([self.ensemble(part) for part in inputs.split(self.batch_size)], dim=1)
        return twists.to(situation.command.device) + coasting(self.robot, self.inputs, situation).float()

    def _encoded(self, situation: Situation) -> Tensor:
        """Return the inputs (N, columns) where the weights are."""
        columns: Tensor = self.encoding(situation)
        return columns.to(self.ensemble.scale.device)


class CorrectedDynamics(DynamicsModule):
    """A trained dynamics model, and what the reference is known to do beyond it.

    The correction is learned from the evidence kept beside the model: what the simulation already got wrong when it was
    learned is no news in a later session.

    Attributes:
        robot: whose motion it predicts.
        inputs: the parts of a situation that it looks at.
        dynamics: the trained model, or what answers in its place.
        correction: added to its twists; None: nothing.
    """

    def __init__(self, dynamics: DynamicsModule, correction: EnsembleDynamics | None) -> None:
        super().__init__()
        self.dynamics, self.correction = dynamics, correction
        self.robot = dynamics.robot
        inputs = set(dynamics.inputs) | set(correction.inputs if correction else ())
        self.inputs: tuple[SituationPart, ...] = tuple(part for part in KNOWN_INPUTS if part in inputs)

    @property
    def members(self) -> int:
        """How many fits stand for what the reference leaves open."""
        return self.correction.members if self.correction else 0

    def description(self) -> dict[str, Any]:
        """Return what makes it up, without its weights."""
        assert isinstance(self.dynamics, NetworkDynamics)  # what answers in its place is in no simulation that is kept
        return {
            "kind": "simulation",
            "model": self.dynamics.config.model_dump(mode="json"),
            "correction": self.correction.description() if self.correction else None,
        }

    def predict(self, situation: Situation) -> Tensor:
        """Return the expected displacements (N, 3), float64."""
        return exp_map(self.twist(situation))

    def twist(self, situation: Situation, member: int | None = None) -> Tensor:
        """Return twists (N, 3), float64, over a nominal period, with the mean correction or one member's."""
        alone = twist_of(self.dynamics, situation)
        return alone + self.correction.twist(situation, member) if self.correction else alone

    def member_twists(self, situation: Situation) -> Tensor:
        """Return the twists with every member's correction, (M, N, 3)."""
        assert self.correction is not None
        return twist_of(self.dynamics, situation) + self.correction.member_twists(situation)


BaseDynamics = EnsembleDynamics | CorrectedDynamics


class OneMember(DynamicsModule):
    """A base with one member's answer in the place of the mean of all: what the reference leaves open."""

    def __init__(self, base: BaseDynamics, member: int) -> None:
        super().__init__()
        self.robot, self.inputs = base.robot, base.inputs
        self.base, self.member = base, member

    def predict(self, situation: Situation) -> Tensor:
        """Return the member's expected displacements (N, 3), float64."""
        return exp_map(self.twist(situation))

    def twist(self, situation: Situation, member: int | None = None) -> Tensor:
        """Return its twists (N, 3), float64, over a nominal period, whichever member is asked for."""
        return self.base.twist(situation, self.member)


def one_member(base: BaseDynamics, member: int) -> DynamicsModule:
    """Return a base with one member's answer in the place of the mean of all; the model that it corrects stays."""
    if isinstance(base, CorrectedDynamics) and base.correction:
        return CorrectedDynamics(base.dynamics, OneMember(base.correction, member))  # type: ignore[arg-type]
    return OneMember(base, member)


class CrossFitted(DynamicsModule):
    """A base on its own reference: each transition is answered by the member that has not seen its run.

    Attributes:
        fold: (N,) the member that answers each of the reference's N transitions.
    """

    members = 0

    def __init__(self, base: BaseDynamics, fold: np.ndarray) -> None:
        super().__init__()
        self.robot, self.inputs = base.robot, base.inputs
        self.base, self.fold = base, fold

    def of_rows(self, rows: np.ndarray) -> "CrossFitted":
        """Return what answers the transitions at indices (n,) in their order."""
        return CrossFitted(self.base, self.fold[rows])

    def predict(self, situation: Situation) -> Tensor:
        """Return the expected displacements (N, 3) of the reference's own transitions, in their order, float64."""
        return exp_map(self.twist(situation))

    def twist(self, situation: Situation) -> Tensor:
        """Return their twists (N, 3), float64, over a nominal period."""
        return self.base.member_twists(situation)[self.fold, np.arange(len(self.fold))].double()


def twist_of(dynamics: DynamicsModel, situation: Situation) -> Tensor:
    """Return the expected twists (N, 3), float64, over a nominal period that a model answers, or its displacements'."""
    if isinstance(dynamics, EnsembleDynamics | CorrectedDynamics | OneMember | CrossFitted):
        return dynamics.twist(situation)
    return log_map(dynamics.predict(situation).double())
