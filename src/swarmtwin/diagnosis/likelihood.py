"""Step 3, its ground: how likely a measured session is, given the simulation, its noise and mechanisms."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from scipy import stats
from torch import Tensor

from swarmtwin.diagnosis.measured_session import MeasuredSession
from swarmtwin.diagnosis.noise import Noise
from swarmtwin.diagnosis.one_step import OneStepPredictor, Outcome
from swarmtwin.diagnosis.reference import Reference
from swarmtwin.diagnosis.settings import DiagnosisSettings
from swarmtwin.diagnosis.unit_spread import UnitDifferences
from swarmtwin.dynamics.predictor import DynamicsModel
from swarmtwin.simulation.mechanism import Mechanism, Parameter

MechanismClass = type[Mechanism]


@dataclass(frozen=True)
class FittedMechanisms:
    """Mechanisms with values, and how likely they make a session of N transitions.

    Attributes:
        mechanisms: with their values, in the order in which they were found.
        log_likelihood: (N,) of each transition, nats.
        residual: (N, 3) standardised residuals, those of the likeliest outcome.
        residual_scale: (3,) how much wider they spread than the reference's.
    """

    mechanisms: tuple[Mechanism, ...]
    log_likelihood: np.ndarray
    residual: np.ndarray
    residual_scale: np.ndarray

    @property
    def total(self) -> float:
        """Log-likelihood of the whole session, nats."""
        return float(self.log_likelihood.sum())

    @property
    def kinds(self) -> tuple[MechanismClass, ...]:
        """The classes of its mechanisms."""
        return tuple(type(mechanism) for mechanism in self.mechanisms)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of its mechanisms."""
        return tuple(mechanism.name for mechanism in self.mechanisms)


class LikelihoodModel:
    """A session, the simulation and its noise: says how likely what was measured is, given mechanisms.

    Args:
        base: the simulation.
        noise: of residuals that it was not fitted to.
        session: of N transitions.
        known_vehicles: ids of the vehicles that the simulation was learned from; empty: all of the session.
        unit_spread: by how much other vehicles are expected to differ; None: the settings' prior.
        settings: of the diagnosis; None: the defaults.
    """

    def __init__(
        self,
        base: DynamicsModel,
        noise: Noise,
        session: MeasuredSession,
        known_vehicles: tuple[str, ...] = (),
        unit_spread: float | None = None,
        settings: DiagnosisSettings | None = None,
    ) -> None:
        self.session, self.noise, self.robot = session, noise, base.robot
        self.settings = settings or DiagnosisSettings()
        self.members: int = getattr(base, "members", 0)
        self.predictor = OneStepPredictor(base, session.conditions, session.situation)
        self.simulated = self.predictor.simulated()
        self.whitener = noise.whitener(self.simulated, session)
        vehicles = known_vehicles or session.transitions.vehicles
        spread = self.settings.units.spread if unit_spread is None else unit_spread
        self.units = UnitDifferences(self.predictor, self.whitener, session, self.simulated, vehicles, spread)
        self._log_volume = -self.whitener.residual_scale.log().sum(dim=-1).numpy()

    @classmethod
    def of_measured(cls, reference: Reference, session: MeasuredSession) -> Self:
        """Compare a measured session with a reference."""
        return cls(
            reference.base,
            reference.noise,
            session,
            reference.vehicles,
            reference.unit_spread,
            reference.settings,
        )

    @classmethod
    def of_reference(cls, reference: Reference) -> Self:
        """Compare the reference's own transitions with what has not seen them."""
        return cls(reference.cross_fitted, reference.noise, reference.session, settings=reference.settings)

    def outcomes(self, mechanisms: Sequence[Mechanism], member: int | None = None) -> list[Outcome]:
        """Predict the session's measured twists, with one member of the simulation in the place of their mean if asked.

        Several outcomes result where commands may be lost.
        """
        predictor = self.predictor if member is None else self.predictor.with_member(member)
        return predictor.outcomes(mechanisms)

    def likeliest_twist(self, mechanisms: Sequence[Mechanism], member: int | None = None) -> Tensor:
        """Return the twists (N, 3) of the likeliest outcome."""
        return max(self.outcomes(mechanisms, member), key=lambda one: one.probability).twist

    def simulated_by(self, member: int) -> Tensor:
        """Return the twists (N, 3) that one member of the simulation answers, without mechanisms."""
        return self.predictor.with_member(member).simulated()

    def residual(self, mechanisms: Sequence[Mechanism]) -> np.ndarray:
        """Return standardised residuals (N, 3), those of the likeliest outcome, freed of differences between units."""
        found = self.outcomes(mechanisms)
        _, whitened = self._likeliest(found, [self.session.residual_of(one.twist) for one in found])
        return self.units.free(whitened.numpy())[0]

    def evaluate(self, mechanisms: Sequence[Mechanism]) -> FittedMechanisms:
        """Return how likely the session is with mechanisms as they are."""
        found = self.outcomes(mechanisms)
        raw = [self.session.residual_of(one.twist) for one in found]
        earlier, whole = self._likeliest(found, raw)
        best, price = self.units.free(whole.numpy())
        by_units = best - whole.numpy()
        outlier_z = self.settings.estimation.outlier_z
        scale = self.scale(best if len(found) == 1 else np.clip(best, -outlier_z, outlier_z))
        if len(found) == 1:
            density = self._log_density(best / scale)
        else:
            whitened = [(self.whitener(one, earlier).numpy() + by_units) / scale for one in raw]
            logs = [
                np.log(max(one.probability, 1e-12)) + self._log_density(values)
                for one, values in zip(found, whitened, strict=True)
            ]
            density = np.logaddexp.reduce(logs, axis=0)
        log_likelihood = density + self._log_volume - np.log(scale).sum() - price / len(density)
        return FittedMechanisms(tuple(mechanisms), log_likelihood, best, scale)

    def _likeliest(self, found: Sequence[Outcome], raw: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Return the raw and the standardised residuals (N, 3) of each transition's likeliest outcome."""
        if len(raw) == 1:
            return raw[0], self.whitener(raw[0])
        cost = torch.stack(
            [
                ((one / self.whitener.residual_scale) ** 2).sum(dim=-1) - 2 * np.log(max(outcome.probability, 1e-12))
                for one, outcome in zip(raw, found, strict=True)
            ]
        )
        chosen = cost.argmin(dim=0)
        earlier = torch.stack(list(raw))[chosen, torch.arange(len(chosen))]
        return earlier, self.whitener(earlier)

    def _log_density(self, whitened: np.ndarray) -> np.ndarray:
        """Return the log density (N,) of residuals (N, 3) in units of their own spread."""
        freedom = self.noise.degrees_of_freedom
        logs: np.ndarray = stats.norm.logpdf(whitened) if freedom is None else stats.t.logpdf(whitened, freedom)
        return logs.sum(axis=-1)

    def scale(self, whitened: np.ndarray) -> np.ndarray:
        """Return (3,) the likeliest spread of standardised residuals (N, 3)."""
        squared = whitened**2
        scale2 = squared.mean(axis=0)
        freedom = self.noise.degrees_of_freedom
        if freedom is not None:
            for _ in range(self.settings.estimation.scale_rounds):
                weight = (freedom + 1) / (freedom + squared / scale2)
                scale2 = (weight * squared).mean(axis=0)
        return np.sqrt(np.maximum(scale2, 1e-6))

    def parameters(self, kinds: Sequence[MechanismClass]) -> list[tuple[int, str, Parameter]]:
        """Return the parameters of several mechanisms: number of the mechanism, name, parameter."""
        return [
            (number, name, parameter)
            for number, kind in enumerate(kinds)
            for name, parameter in kind.parameters_of(self.robot, self.session.conditions).items()
        ]

    def values(self, mechanisms: Sequence[Mechanism]) -> np.ndarray:
        """Return the values (P,) of all parameters of mechanisms."""
        kinds = [type(mechanism) for mechanism in mechanisms]
        return np.array([getattr(mechanisms[number], name) for number, name, _ in self.parameters(kinds)])

    def assembled(self, kinds: Sequence[MechanismClass], values: np.ndarray) -> list[Mechanism]:
        """Return mechanisms with values (P,) for all their parameters."""
        given: list[dict[str, float]] = [{} for _ in kinds]
        for (number, name, _), value in zip(self.parameters(kinds), values, strict=True):
            given[number][name] = float(value)
        return [kind.at({**self.read_off_clock(kind), **own}) for kind, own in zip(kinds, given, strict=True)]

    def read_off_clock(self, kind: MechanismClass) -> dict[str, float]:
        """Return what a mechanism reads off the session's clock."""
        return kind.read_from_clock(self.session.transitions.duration_s, self.robot.period_s) or {}

    def can_show(self, kind: MechanismClass) -> bool:
        """Say whether the session can show a mechanism at all."""
        transitions = self.session.transitions
        if kind.read_from_clock(transitions.duration_s, self.robot.period_s) is None:
            return False
        return "neighbours" not in kind.inputs or bool(np.isfinite(transitions.neighbours).any())


def loses_commands(kinds: Sequence[MechanismClass]) -> bool:
    """Say whether one of the mechanisms makes several outcomes: whether it decides that a command arrives."""
    return any(kind.arrival_probability is not Mechanism.arrival_probability for kind in kinds)
