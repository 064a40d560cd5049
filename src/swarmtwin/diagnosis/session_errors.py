"""Step 1. What was measured beside what is simulated: errors, what they depend on, and their noise."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from swarmtwin.diagnosis.flexible_residual import FlexibleRegressions, FlexibleResidual
from swarmtwin.diagnosis.measured_session import MeasuredSession
from swarmtwin.diagnosis.noise import (
    Noise,
    NoiseScales,
    likeliest_scales,
    motion_scale_log,
    tail_weights,
)
from swarmtwin.diagnosis.noise_filter import NoiseFilter
from swarmtwin.diagnosis.session_prediction import SessionPredictor
from swarmtwin.diagnosis.settings import DiagnosisSettings
from swarmtwin.diagnosis.unit_spread import UnitSpread
from swarmtwin.dynamics.predictor import DynamicsModel
from swarmtwin.geometry import compose, exp_map, log_map
from swarmtwin.simulation.arcs import moved_along, twist_between
from swarmtwin.simulation.mechanism import Mechanism


class SessionErrors:
    """A session, the simulation and its noise: what is measured beside what is simulated, and by how much that varies.

    Args:
        base: the simulation.
        noise: of errors that it was not fitted to.
        session: of N transitions.
        known_vehicles: ids of the vehicles that the simulation knows by itself; None: all of the session.
        unit_spread: by how much other vehicles are expected to differ; None: by the settings' prior.
        settings: of the diagnosis; None: the defaults.
        explained: mechanisms that are known to be there, so that the noise is that of what they leave.
        quick: answers nearly as the simulation, in a fraction of its time; None: it answers itself.
    """

    def __init__(
        self,
        base: DynamicsModel,
        noise: Noise,
        session: MeasuredSession,
        known_vehicles: tuple[str, ...] | None = None,
        unit_spread: UnitSpread | None = None,
        settings: DiagnosisSettings | None = None,
        explained: Sequence[Mechanism] = (),
        quick: DynamicsModel | None = None,
    ) -> None:
        self.explained = tuple(explained)
        self.session, self.reference_noise, self.robot = session, noise, base.robot
        self.settings = settings or DiagnosisSettings()
        self.has_momentum = "velocity" in base.inputs
        self.members: int = getattr(base, "members", 0)
        given = session.conditions, session.situation, session.follows, session.sent
        self.predictor = SessionPredictor(base, *given, quick)
        self.simulated = self.predictor.twist(())
        self._measured = torch.as_tensor(session.transitions.displacement, dtype=torch.float64)
        self._nowhere = torch.zeros_like(self._measured)
        self.unknown_vehicles = tuple(
            vehicle
            for vehicle in (session.transitions.vehicles[index] for index in np.unique(session.transitions.vehicle))
            if known_vehicles is not None and vehicle not in known_vehicles
        )
        self.unit_spread = unit_spread or UnitSpread(self.settings.units.spread)

    def errors_of(self, twist: Tensor) -> np.ndarray:
        """Return (N, 3) from where twists (N, 3) lead to where vehicles were measured, in the frame there."""
        return self._uncorrected(twist) - self.correction

    def _uncorrected(self, twist: Tensor) -> np.ndarray:
        errors: np.ndarray = twist_between(moved_along(self._nowhere, twist), self._measured).numpy()
        return errors

    @cached_property
    def one_member(self) -> SessionPredictor:
        """One member of the simulation, or of what answers quickly in its place: for differences."""
        return self.predictor.with_member(0)

    def errors(self, mechanisms: Sequence[Mechanism]) -> np.ndarray:
        """Return the errors (N, 3) of the simulation with mechanisms, where every command arrives."""
        return self.errors_of(self.predictor.twist(mechanisms))

    def errors_near(self, mechanisms: Sequence[Mechanism], near: Sequence[Mechanism]) -> np.ndarray:
        """Return the errors (N, 3) with mechanisms, nearly: one member says by how much they differ from others `near`.

        Members agree in that but for a small share of the change, and to ask one of them takes a fraction of the time.
        """
        if self.members < 2:
            return self.errors(mechanisms)
        change = self.one_member.twist(mechanisms) - self.one_member.twist(near)
        return self.errors_of(self.predictor.twist(near) + change)

    def changes_of(self, twist: Tensor, center: Tensor | None = None) -> np.ndarray:
        """Return (N, 3) by what errors change with twists (N, 3) instead of others, by default the simulation's."""
        return self._uncorrected(twist) - self._uncorrected(self.simulated if center is None else center)

    @cached_property
    def correction(self) -> np.ndarray:
        """(N, 3) errors that the simulation is known to make; none here."""
        return np.zeros((len(self.session), 3))

    def errors_left(self, mechanisms: Sequence[Mechanism]) -> np.ndarray:
        """Return the errors (N, 3) that mechanisms leave."""
        return self.errors(mechanisms)

    @cached_property
    def _plain_errors(self) -> np.ndarray:
        return self.errors_of(self.simulated)

    @cached_property
    def flexible(self) -> FlexibleResidual:
        """What errors may depend on."""
        steady, before = (twist.numpy() for twist in self.predictor.steady_twists())
        return FlexibleResidual.of(self.session, steady, before, self.settings.flexible)

    @cached_property
    def usual_spread(self) -> np.ndarray:
        """(N, 3) standard deviations of errors by the reference's noise, were the simulation right."""
        return self.reference_noise.spread(self.simulated.numpy())

    @cached_property
    def expected_errors(self) -> np.ndarray:
        """(N, 3) what the simulation's errors depend on: the vehicle, if it is unknown, and all else that can be told.

        By a regression that has not seen their runs; vehicles are no features of it.
        """
        left = self.errors_left(self.explained) if self.explained else self._plain_errors
        own = self.unit_errors(left)
        weight = np.ones(len(left))
        return self._plain_errors - left + own + self.flexible.predicted(left - own, self.usual_spread, weight)

    def unit_errors(self, errors: np.ndarray) -> np.ndarray:
        """Return (N, 3) what of errors (N, 3) unknown vehicles make by fabrication; nothing here."""
        return np.zeros_like(errors)

    @property
    def unpredicted_errors(self) -> np.ndarray:
        """(N, 3) errors less what they depend on."""
        left: np.ndarray = self._plain_errors - self.expected_errors
        return left

    @cached_property
    def motion(self) -> np.ndarray:
        """(N, 3) twists by which vehicles really move, as well as it is known without a cause."""
        moved = compose(exp_map(self.simulated), exp_map(torch.as_tensor(self.expected_errors)))
        twist: np.ndarray = log_map(moved).numpy()
        return twist

    @cached_property
    def noise_scales(self) -> NoiseScales:
        """Factors on the reference's noise, from what no longer depends on anything."""
        spread = self.settings.noise.scale_spread
        return likeliest_scales(self.reference_noise, self.unpredicted_errors, self.motion, self.session, spread)

    @cached_property
    def noise(self) -> Noise:
        """The session's noise."""
        return self.reference_noise.scaled(self.noise_scales)

    @cached_property
    def filter(self) -> NoiseFilter:
        """Makes the session's errors independent."""
        return self.noise.filter(self.motion, self.session)

    def by_usual_noise(self, errors: np.ndarray) -> np.ndarray:
        """Return errors (N, 3) made independent and divided by the reference's noise, not the session's."""
        return self._usual_filter(errors[..., None])[..., 0]

    @cached_property
    def _usual_filter(self) -> NoiseFilter:
        return self.reference_noise.filter(self.motion, self.session)

    @cached_property
    def weight(self) -> np.ndarray:
        """(N,) how much each transition counts in least squares: outliers little, vehicles in contact not at all."""
        left = self.filter(self.unpredicted_errors[..., None])[..., 0]
        return np.where(self.in_contact, 0.0, tail_weights(left, self.noise.degrees_of_freedom))

    @cached_property
    def in_contact(self) -> np.ndarray:
        """(N,) whether a vehicle begins nearer to another than half its width, centre to centre.

        Such vehicles go on together: how one goes then hangs on what chance does to the other, which a model of one
        vehicle's period does not know.
        """
        away_mm = np.linalg.norm(self.session.transitions.neighbours[..., :2], axis=-1)
        nearer: np.ndarray = (away_mm < min(self.robot.vehicle_size_mm) / 2).any(axis=1)
        return nearer

    @cached_property
    def regressions(self) -> FlexibleRegressions:
        """What may be left of errors when causes are taken off, by everything that they may depend on."""
        return self.flexible.alternatives(self.noise.spread(self.motion), self.weight)

    def motion_noise_log(self) -> tuple[float, float]:
        """Return the log of the factor on the motion's standard deviation, and its standard error over runs."""
        spread, left = self.settings.noise.scale_spread, self.unpredicted_errors
        return motion_scale_log(self.noise, self.noise_scales, left, self.motion, self.session, spread)
