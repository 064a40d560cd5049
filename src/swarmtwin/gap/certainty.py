"""How sure fitted parameters are: runs are the blocks, and the simulation itself is not exact."""

from dataclasses import dataclass

import numpy as np
import torch

from swarmtwin.dynamics.twist import twist_of
from swarmtwin.gap.base import AnyBase
from swarmtwin.gap.fitting import FARTHEST_Z, Fit, Problem
from swarmtwin.gap.motion import alternatives
from swarmtwin.gap.noise import residual_of

RIDGE = 1e-6


@dataclass(frozen=True)
class Certainty:
    """What is known of P fitted parameters.

    Attributes:
        values: (P,) likeliest values.
        information: (P, P) curvature of the log-likelihood.
        by_run: (R, P) what each run would move the values by.
        by_member: (M, P) values with each of the simulation's members in the place of their mean; M = 0 where it has
            none.
    """

    values: np.ndarray
    information: np.ndarray
    by_run: np.ndarray
    by_member: np.ndarray

    @property
    def sampling(self) -> np.ndarray:
        """Covariance (P, P) by the choice of measured runs."""
        runs = len(self.by_run)
        return self.by_run.T @ self.by_run * (runs / max(runs - 1, 1))

    @property
    def simulation(self) -> np.ndarray:
        """Covariance (P, P) by what the reference leaves open: a jackknife over the folds of its runs."""
        members = len(self.by_member)
        if members < 2:
            return np.zeros_like(self.information)
        away = self.by_member - self.by_member.mean(axis=0)
        return away.T @ away * ((members - 1) / members)

    @property
    def covariance(self) -> np.ndarray:
        """Covariance (P, P) of the values."""
        return self.sampling + self.simulation

    @property
    def penalty(self) -> float:
        """Nats by which a session is likelier than another one like it, for having been fitted to."""
        return float(np.trace(self.information @ self.covariance))

    def draws(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Return (count, P) values that are as likely as these: resampled runs, and the simulation's uncertainty."""
        runs = len(self.by_run)
        weights = rng.multinomial(runs, np.full(runs, 1 / runs), count) - 1.0
        drawn = self.values + weights @ self.by_run
        members = len(self.by_member)
        if members >= 2:
            away = self.by_member - self.by_member.mean(axis=0)
            chances = rng.standard_t(members - 1, (count, members))
            drawn = drawn + chances @ away * np.sqrt((members - 1) / members)
        return drawn


def certainty(problem: Problem, base: AnyBase, fit: Fit) -> Certainty:
    """Examine fitted parameters, by their influence on the likelihood of each run."""
    kinds = fit.kinds
    values = problem.values(fit.mechanisms)
    if not len(values):
        return Certainty(values, np.zeros((0, 0)), np.zeros((problem.session.runs, 0)), np.zeros((0, 0)))
    if any(kind.overrides("arriving") for kind in kinds):
        scores = _scores(problem, fit, values)
        information = scores.T @ scores
    else:
        response = problem.jacobian(kinds, values) / fit.scale[:, None]
        whitened = fit.residual / fit.scale
        held = np.clip(whitened, -FARTHEST_Z, FARTHEST_Z)
        scores = -np.einsum("nd,ndp->np", held, response)
        information = np.einsum("ndp,ndq->pq", response, response)
    inverse = _inverse(information)
    by_run = problem.session.by_run(scores) @ inverse
    by_member = _by_member(problem, base, fit, values, scores, inverse)
    return Certainty(values, information, by_run, by_member)


def _inverse(information: np.ndarray) -> np.ndarray:
    """Invert, with each parameter in its own size; one that changes nothing stays where it is."""
    size = np.sqrt(np.maximum(np.diag(information), 1e-300))
    alike = information / np.outer(size, size) + RIDGE * np.eye(len(information))
    inverse: np.ndarray = np.linalg.pinv(alike) / np.outer(size, size)
    inverse[size <= 1e-100] = 0.0
    inverse[:, size <= 1e-100] = 0.0
    return inverse


def _scores(problem: Problem, fit: Fit, values: np.ndarray) -> np.ndarray:
    """Return (N, P) the likelihood's slopes, by differences."""
    columns = []
    for index, (_, _, quantity) in enumerate(problem.quantities(fit.kinds)):
        ends = []
        for sign in (1.0, -1.0):
            moved = values.copy()
            moved[index] = np.clip(moved[index] + sign * quantity.response_step, quantity.low, quantity.high)
            ends.append((moved[index], problem.evaluate(problem.assembled(fit.kinds, moved)).likelihood))
        (ahead, first), (back, second) = ends
        columns.append((first - second) / max(ahead - back, 1e-12))
    return np.stack(columns, axis=-1)


def _by_member(
    problem: Problem, base: AnyBase, fit: Fit, values: np.ndarray, scores: np.ndarray, inverse: np.ndarray
) -> np.ndarray:
    """Return (M, P): one Newton step from `values` with each member of the simulation."""
    if not base.members or any(kind.overrides("arriving") for kind in fit.kinds):
        return np.empty((0, len(values)))
    response = problem.jacobian(fit.kinds, values) / fit.scale[:, None]
    found = []
    for member in range(base.members):
        base.member = member
        try:
            predicted = alternatives(base, fit.mechanisms, problem.session.drive)[0].displacement
        finally:
            base.member = None
        with torch.no_grad():
            whitened = problem.whitener(residual_of(problem.session, twist_of(predicted))).numpy() / fit.scale
        held = np.clip(whitened, -FARTHEST_Z, FARTHEST_Z)
        found.append(values - inverse @ np.einsum("nd,ndp->p", held, response))
    return np.array(found)
