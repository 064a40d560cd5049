"""Parameter fitting without model choice: every mechanism that makes sense is fitted at once, right or not."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from swarmtwin.dynamics.twist import twist_of
from swarmtwin.gap.catalogue import offered
from swarmtwin.gap.fitting import Problem
from swarmtwin.gap.mechanism import Mechanism, Quantity
from swarmtwin.gap.motion import alternatives
from swarmtwin.gap.noise import residual_of
from swarmtwin.gap.reference import Reference, surroundings_of
from swarmtwin.gap.session import Session
from swarmtwin.robot import Arena
from swarmtwin.transitions import Transitions

ITERATIONS = 3
DAMPING = 1e-3
NORMAL_95 = 1.959964
FARTHEST_Z = 4.0
MOST_TRANSITIONS = 2500
CLOCK = 0.01
"""Periods that spread by less than this share of them are as they should be."""


@dataclass(frozen=True)
class Fitted:
    """What came out.

    Attributes:
        values: of all parameters, by mechanism and name.
        named: mechanisms of which a parameter's 95 % interval excludes the value at which it does nothing, the one
            farthest outside first.
    """

    values: Mapping[tuple[str, str], float]
    named: tuple[str, ...]


def fit_all(reference: Reference, transitions: Transitions, arena: Arena) -> Fitted:
    """Fit all mechanisms together by least squares (Levenberg-Marquardt), with intervals by runs.

    `noise_change` and `timing_jitter` leave the mean as it is: the spread of the residuals that are left, and of the
    periods, tells of them.
    """
    surroundings = surroundings_of(transitions, arena).model_copy(update={"track_mm": reference.surroundings.track_mm})
    session = _first_runs(Session.of(transitions, surroundings))
    problem = Problem(reference.base, reference.noise, session)
    kinds = [kind for kind in offered(session.transitions.robot, surroundings).values() if _has_neutral(kind, problem)]
    search = _Search(problem, kinds)
    values = search.run()
    strengths = search.strengths(values)
    strengths |= _spreads(problem, search.residual(values))
    named = sorted((name for name, z in strengths.items() if z > NORMAL_95), key=lambda name: -strengths[name])
    keys = [(kinds[number].model_fields["name"].default, name) for number, name, _ in search.quantities]
    return Fitted(dict(zip(keys, values.tolist(), strict=True)), tuple(named))


def _first_runs(session: Session) -> Session:
    """Keep the first runs, about as many transitions as fit into a few seconds."""
    if len(session) <= MOST_TRANSITIONS:
        return session
    return session.where(session.run <= session.run[np.argsort(session.run, kind="stable")[MOST_TRANSITIONS]])


def _has_neutral(kind: type[Mechanism], problem: Problem) -> bool:
    name = kind.model_fields["name"].default
    return name not in ("noise_change", "timing_jitter") and bool(kind.quantities_of(problem.robot))


class _Search:
    """The joint least-squares problem over the parameters of several mechanisms."""

    def __init__(self, problem: Problem, kinds: Sequence[type[Mechanism]]) -> None:
        self.problem, self.kinds = problem, kinds
        self.quantities: list[tuple[int, str, Quantity]] = problem.quantities(kinds)
        self.low = np.array([quantity.low for _, _, quantity in self.quantities])
        self.high = np.array([quantity.high for _, _, quantity in self.quantities])
        self.step = np.array([quantity.response_step for _, _, quantity in self.quantities])
        self.by_run = problem.session.by_run

    def run(self) -> np.ndarray:
        """Return the values (P,) found from where every mechanism does nothing."""
        values = np.array([q.starts[0] if q.neutral is None else q.neutral for _, _, q in self.quantities])
        for _ in range(ITERATIONS):
            residual, response = self.residual(values), self.response(values)
            normal, pull = _normal(residual, response)
            change = -np.linalg.solve(normal + DAMPING * np.diag(np.diag(normal) + 1.0), pull)
            shorter = [np.clip(values + part * self.step * change, self.low, self.high) for part in (1.0, 0.3, 0.1)]
            best = min(shorter, key=lambda tried: _loss(self.residual(tried)))
            if _loss(self.residual(best)) >= _loss(residual):
                break
            values = best
        return values

    def residual(self, values: np.ndarray) -> np.ndarray:
        """Return standardised residuals (N, 3)."""
        mechanisms = [one for one in self.problem.assembled(self.kinds, values) if not self._does_nothing(one)]
        session = self.problem.session
        possible = alternatives(self.problem.base, mechanisms, session.drive)
        mean = torch.stack([one.probability * one.displacement for one in possible]).sum(dim=0)
        way: Tensor = twist_of(mean)
        whitened: np.ndarray = self.problem.whitener(residual_of(session, way)).numpy()
        return whitened

    def _does_nothing(self, mechanism: Mechanism) -> bool:
        neutral = {name: quantity.neutral for name, quantity in mechanism.quantities_of(self.problem.robot).items()}
        return all(value is None or getattr(mechanism, name) == value for name, value in neutral.items())

    def response(self, values: np.ndarray) -> np.ndarray:
        """Return (N, 3, P) how residuals change with each parameter, per step of it."""
        here = self.residual(values)
        columns = []
        for index, step in enumerate(self.step):
            moved = values.copy()
            moved[index] += step if values[index] + step <= self.high[index] else -step
            columns.append((self.residual(moved) - here) * np.sign(moved[index] - values[index]))
        return np.stack(columns, axis=-1)

    def strengths(self, values: np.ndarray) -> dict[str, float]:
        """Return for each mechanism by how many standard errors its size differs from nothing."""
        residual, response = self.residual(values), self.response(values)
        normal, _ = _normal(residual, response)
        inverse = np.linalg.pinv(normal, rcond=1e-8)
        held = np.clip(residual, -FARTHEST_Z, FARTHEST_Z)
        influence = self.by_run(np.einsum("nd,ndp->np", held, response)) @ inverse
        error = np.sqrt((influence**2).sum(axis=0)) * self.step + 1e-12
        strengths: dict[str, float] = {}
        for (number, _, quantity), value, own in zip(self.quantities, values, error, strict=True):
            if quantity.neutral is not None:
                name = self.kinds[number].model_fields["name"].default
                strengths[name] = max(strengths.get(name, 0.0), float(abs(value - quantity.neutral) / own))
        return strengths


def _normal(residual: np.ndarray, response: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    held = np.clip(residual, -FARTHEST_Z, FARTHEST_Z)
    return np.einsum("ndp,ndq->pq", response, response), np.einsum("nd,ndp->p", held, response)


def _loss(residual: np.ndarray) -> float:
    return float((np.clip(residual, -FARTHEST_Z, FARTHEST_Z) ** 2).sum())


def _spreads(problem: Problem, residual: np.ndarray) -> dict[str, float]:
    """Return by how many standard errors the residuals' and the periods' spread differ from the usual one."""
    session = problem.session
    count = session.by_run(np.ones(len(session)))
    squared = session.by_run(np.clip(residual, -FARTHEST_Z, FARTHEST_Z) ** 2).sum(axis=1) / (3 * count)
    noise = abs(squared.mean() - 1.0) / (squared.std(ddof=1) / np.sqrt(len(squared)) + 1e-12)
    periods = session.transitions.duration_s / problem.robot.period_s
    return {"noise_change": float(noise), "timing_jitter": float(np.inf if periods.std() > CLOCK else 0.0)}
