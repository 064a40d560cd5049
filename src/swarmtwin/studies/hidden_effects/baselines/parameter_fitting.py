"""Parameter fitting without model choice: every mechanism that makes sense is fitted at once, right or not."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy.stats import norm

from swarmtwin.diagnosis.likelihood import SessionLikelihood
from swarmtwin.diagnosis.measured_session import MeasuredSession
from swarmtwin.diagnosis.reference import Reference
from swarmtwin.diagnosis.session_prediction import arrival_probability
from swarmtwin.geometry import exp_map, log_map
from swarmtwin.simulation.mechanism import Mechanism, Parameter, offered
from swarmtwin.transitions import Transitions


def fitted_causes(reference: Reference, transitions: Transitions, most_transitions: int = 2500) -> tuple[str, ...]:
    """Fit all mechanisms together by least squares (Levenberg-Marquardt), with intervals by runs, and name some.

    Named are those of which a parameter's interval excludes the value at which it does nothing, the one farthest
    outside first: intervals that all together hold the truth with 95 % (Bonferroni). `noise_change` and `timing_jitter`
    leave the mean as it is: the spread of the residuals that are left, and of the periods, tells of them.

    Args:
        reference: with the simulation.
        transitions: N measured ones.
        most_transitions: fitted to, the first runs: about as many as fit into a few seconds.
    """
    conditions = reference.conditions_for(transitions)
    session = MeasuredSession.of(transitions, conditions)
    if len(session) > most_transitions:
        last = session.run[np.argsort(session.run, kind="stable")[most_transitions]]
        session = session.where(session.run <= last)
    model = SessionLikelihood(reference.base, reference.noise, session, settings=reference.settings)
    kinds = offered(model.robot, conditions)
    of_the_mean = [kind for name, kind in kinds.items() if name not in ("noise_change", "timing_jitter")]
    fit = JointFit(model, [kind for kind in of_the_mean if model.parameters([kind])])
    values = fit.run()
    strengths = fit.strengths(values) | fit.spreads(fit.residual(values))
    outside = [name for name, z in strengths.items() if z > norm.ppf(1 - 0.025 / len(strengths))]
    return tuple(sorted(outside, key=lambda name: -strengths[name]))


@dataclass(frozen=True)
class JointFit:
    """The least-squares problem over all parameters of several mechanisms at once.

    Attributes:
        model: of the session.
        kinds: the mechanisms.
        iterations: of Levenberg and Marquardt's method.
        damping: of its steps.
        clip_z: standardised residuals are clipped here.
        steady_clock: spread of the periods, as a share of them, below which they are as they should be.
    """

    model: SessionLikelihood
    kinds: Sequence[type[Mechanism]]
    iterations: int = 3
    damping: float = 1e-3
    clip_z: float = 4.0
    steady_clock: float = 0.01

    @cached_property
    def parameters(self) -> list[tuple[int, str, Parameter]]:
        """All P parameters, each with the number of its mechanism."""
        return self.model.parameters(self.kinds)

    @cached_property
    def step(self) -> np.ndarray:
        """By how much each parameter (P,) is changed to see how the residuals respond."""
        return np.array([parameter.response_step for _, _, parameter in self.parameters])

    @cached_property
    def high(self) -> np.ndarray:
        """The parameters' upper bounds (P,)."""
        return np.array([parameter.high for _, _, parameter in self.parameters])

    def run(self) -> np.ndarray:
        """Return the values (P,) found from where every mechanism does nothing."""
        values = np.array(
            [q.initial_values[0] if q.null_value is None else q.null_value for _, _, q in self.parameters]
        )
        low = np.array([parameter.low for _, _, parameter in self.parameters])
        for _ in range(self.iterations):
            residual, response = self.residual(values), self.response(values)
            normal, pull = self._normal(residual, response)
            change = -np.linalg.solve(normal + self.damping * np.diag(np.diag(normal) + 1.0), pull)
            shorter = [np.clip(values + part * self.step * change, low, self.high) for part in (1.0, 0.3, 0.1)]
            best = min(shorter, key=lambda tried: self._loss(self.residual(tried)))
            if self._loss(self.residual(best)) >= self._loss(residual):
                break
            values = best
        return values

    def residual(self, values: np.ndarray) -> np.ndarray:
        """Return standardised residuals (N, 3)."""
        mechanisms = [one for one in self.model.assembled(self.kinds, values) if not self._does_nothing(one)]
        model, arrives = self.model, arrival_probability(mechanisms)
        if arrives >= 1.0:
            return model.whitened(mechanisms)
        lost = 1 - arrives
        chances = (arrives * arrives, arrives * lost, arrives * lost, lost**2)
        courses = model.predictor.outcomes(mechanisms)
        mean = torch.stack([chance * exp_map(one) for chance, one in zip(chances, courses, strict=True)]).sum(dim=0)
        return model.filter(model.errors_of(log_map(mean))[..., None])[..., 0]

    def _does_nothing(self, mechanism: Mechanism) -> bool:
        parameters = self.model.parameters([type(mechanism)])
        return all(one.null_value is None or getattr(mechanism, name) == one.null_value for _, name, one in parameters)

    def response(self, values: np.ndarray) -> np.ndarray:
        """Return (N, 3, P) how residuals change with each parameter, per step of it."""
        here = self.residual(values)
        columns = []
        for index, (_, _, parameter) in enumerate(self.parameters):
            moved = values.copy()
            moved[index] = parameter.stepped_from(values[index])
            columns.append((self.residual(moved) - here) * np.sign(moved[index] - values[index]))
        return np.stack(columns, axis=-1)

    def strengths(self, values: np.ndarray) -> dict[str, float]:
        """Return for each mechanism by how many standard errors its size differs from nothing."""
        residual, response = self.residual(values), self.response(values)
        normal, _ = self._normal(residual, response)
        inverse = np.linalg.pinv(normal, rcond=1e-8)
        influence = self.model.session.by_run(np.einsum("nd,ndp->np", self._held(residual), response)) @ inverse
        error = np.sqrt((influence**2).sum(axis=0)) * self.step + 1e-12
        strengths: dict[str, float] = {}
        for (number, _, parameter), value, own in zip(self.parameters, values, error, strict=True):
            if parameter.null_value is not None:
                name = self.kinds[number].model_fields["name"].default
                strengths[name] = max(strengths.get(name, 0.0), float(abs(value - parameter.null_value) / own))
        return strengths

    def spreads(self, residual: np.ndarray) -> dict[str, float]:
        """Return by how many standard errors the residuals' and the periods' spread differ from the usual one."""
        transitions = self.model.session.transitions
        count = self.model.session.by_run(np.ones(len(transitions)))
        squared = self.model.session.by_run(self._held(residual) ** 2).sum(axis=1) / (3 * count)
        noise = abs(squared.mean() - 1.0) / (squared.std(ddof=1) / np.sqrt(len(squared)) + 1e-12)
        is_steady = (transitions.duration_s / self.model.robot.period_s).std() <= self.steady_clock
        return {"noise_change": float(noise), "timing_jitter": 0.0 if is_steady else float("inf")}

    def _held(self, residual: np.ndarray) -> np.ndarray:
        return np.clip(residual, -self.clip_z, self.clip_z)

    def _normal(self, residual: np.ndarray, response: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pull = np.einsum("nd,ndp->p", self._held(residual), response)
        return np.einsum("ndp,ndq->pq", response, response), pull

    def _loss(self, residual: np.ndarray) -> float:
        return float((self._held(residual) ** 2).sum())
