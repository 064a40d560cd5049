"""Step 1. What a simulation answers to its own reference, each transition by what has not seen it."""

from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
import torch
from torch import Tensor

from swarmtwin.diagnosis.measured_session import MeasuredSession
from swarmtwin.diagnosis.noise import Noise
from swarmtwin.diagnosis.session_prediction import SessionPredictor
from swarmtwin.diagnosis.settings import DiagnosisSettings
from swarmtwin.diagnosis.unit_spread import ReferenceUnits
from swarmtwin.geometry import displacement_between, exp_map, log_map
from swarmtwin.simulation.actuation import with_actuation
from swarmtwin.simulation.ensemble_dynamics import BaseDynamics, CrossFitted


@dataclass(frozen=True)
class OwnAnswers:
    """What a simulation answers to the transitions it was learned from, each by a member that has not seen its run.

    Attributes:
        base: the simulation.
        session: its N transitions, under conditions that say how it shows actuators to follow.
        cross_fitted: answers them.
        predictor: likewise, with mechanisms.
        twist: (N, 3) the answers.
        errors: (N, 3) from where these lead to where vehicles were measured, in the frame there.
        settings: of the diagnosis.
    """

    base: BaseDynamics
    session: MeasuredSession
    cross_fitted: CrossFitted
    predictor: SessionPredictor
    twist: Tensor
    errors: np.ndarray
    settings: DiagnosisSettings

    @classmethod
    def by(
        cls, base: BaseDynamics, session: MeasuredSession, fold: np.ndarray, seed: int, settings: DiagnosisSettings
    ) -> Self:
        """Return what a simulation answers to the session it was learned from; `fold` (N,) are the members' own."""
        session = session.under(with_actuation(session.conditions, base, seed))
        session = session.under(session.conditions.model_copy(update={"clearance_mm": _clearance_mm(session, base)}))
        cross_fitted = CrossFitted(base, fold)
        predictor = SessionPredictor(cross_fitted, session.conditions, session.situation, session.follows)
        twist = predictor.twist(())
        measured = torch.as_tensor(session.transitions.displacement, dtype=torch.float64)
        errors = log_map(displacement_between(exp_map(twist), measured)).numpy()
        return cls(base, session, cross_fitted, predictor, twist, errors, settings)

    @property
    def has_momentum(self) -> bool:
        """Whether the simulation looks at velocities."""
        return "velocity" in self.base.inputs

    @property
    def one_step(self) -> Tensor:
        """(N, 3) the answers as displacements, from the velocities measured where the simulation looks at these."""
        if not self.has_momentum:
            return exp_map(self.twist)
        return self.cross_fitted.predict(self.session.situation.only(self.base.inputs))

    @cached_property
    def rows(self) -> np.ndarray:
        """Mask (N,) of the transitions that noise is learned from."""
        return self.session.spread_over(self.settings.reference.most_transitions)

    @cached_property
    def part(self) -> MeasuredSession:
        """These transitions."""
        return self.session.where(self.rows)

    @cached_property
    def noise(self) -> Noise:
        """Of the errors, whatever they depend on."""
        return Noise.learn(self.errors[self.rows], self.twist[self.rows].numpy(), self.part, self.settings.noise)

    def units(self) -> ReferenceUnits:
        """Return what these transitions show of the units that drove them; the robot's file goes before settings."""
        usual = self.settings.units
        if stated := self.base.robot.unit_spread:
            usual = usual.model_copy(update={"spread": stated})
        return ReferenceUnits.estimate(self.predictor, self.noise, self.errors, self.session, self.twist, usual)


def _clearance_mm(session: MeasuredSession, base: BaseDynamics, doubted: float = 0.005) -> tuple[float, float] | None:
    """Return how near vehicles came to walls that they faced, and to walls that they lay along.

    A share `doubted` of the poses came nearer. None where the base does not look at the pose: then nothing stops its
    robot anywhere.
    """
    if "pose" not in base.inputs:
        return None
    arena, pose = session.conditions.arena_mm, session.transitions.pose
    away_mm = np.concatenate([pose[:, :2] - arena.low_mm, arena.high_mm - pose[:, :2]], axis=1)
    across = np.abs(np.cos(pose[:, 2, None] - np.pi * np.array([1.0, 1.5, 0.0, 0.5])))
    facing_mm, along_mm = away_mm[across > 0.87], away_mm[across < 0.5]  # within 30 degrees
    if not (len(facing_mm) and len(along_mm)):
        return None
    return float(np.quantile(facing_mm, doubted)), float(np.quantile(along_mm, doubted))
