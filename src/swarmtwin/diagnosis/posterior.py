"""Step 3. How sure estimated parameters are: runs are the blocks, and the simulation itself is not exact."""

from dataclasses import dataclass

import numpy as np

from swarmtwin.diagnosis.estimation import jacobian, scores
from swarmtwin.diagnosis.likelihood import FittedMechanisms, LikelihoodModel, loses_commands


@dataclass(frozen=True)
class Posterior:
    """What is known of P estimated parameters.

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
    def optimism(self) -> float:
        """Nats by which a session is likelier than another one like it, for having been fitted to (Takeuchi, 1976)."""
        return float(np.trace(self.information @ self.covariance))

    def draws(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Return (count, P) values that are as likely as these: resampled runs, and the simulation's uncertainty."""
        runs = len(self.by_run)
        weights = rng.multinomial(runs, np.full(runs, 1 / runs), count) - 1.0
        drawn = self.values + weights @ self.by_run
        members = len(self.by_member)
        if members >= 2:
            away = self.by_member - self.by_member.mean(axis=0)
            factors = rng.standard_t(members - 1, (count, members))
            drawn = drawn + factors @ away * np.sqrt((members - 1) / members)
        return drawn


def posterior(model: LikelihoodModel, fitted: FittedMechanisms) -> Posterior:
    """Return how sure estimated parameters are, by their influence on the likelihood of each run."""
    kinds = fitted.kinds
    values = model.values(fitted.mechanisms)
    if not len(values):
        return Posterior(values, np.zeros((0, 0)), np.zeros((model.session.runs, 0)), np.zeros((0, 0)))
    by_member = np.empty((0, len(values)))
    ridge = model.settings.estimation.information_ridge
    if loses_commands(kinds):
        slopes = scores(model, kinds, values)
        information = slopes.T @ slopes
        inverse = _inverse(information, ridge)
    else:
        response = jacobian(model, kinds, values) / fitted.residual_scale[:, None]
        slopes = -np.einsum("nd,ndp->np", _held(model, fitted.residual / fitted.residual_scale), response)
        information = np.einsum("ndp,ndq->pq", response, response)
        inverse = _inverse(information, ridge)
        if model.members:
            by_member = _by_member(model, fitted, values, response, inverse)
    return Posterior(values, information, model.session.by_run(slopes) @ inverse, by_member)


def _held(model: LikelihoodModel, scaled: np.ndarray) -> np.ndarray:
    huber_z = model.settings.estimation.huber_z
    return np.clip(scaled, -huber_z, huber_z)


def _inverse(information: np.ndarray, ridge: float) -> np.ndarray:
    """Invert, with each parameter in its own size; one that changes nothing stays where it is."""
    size = np.sqrt(np.maximum(np.diag(information), 1e-300))
    alike = information / np.outer(size, size) + ridge * np.eye(len(information))
    inverse: np.ndarray = np.linalg.pinv(alike) / np.outer(size, size)
    inverse[size <= 1e-100] = 0.0
    inverse[:, size <= 1e-100] = 0.0
    return inverse


def _by_member(
    model: LikelihoodModel,
    fitted: FittedMechanisms,
    values: np.ndarray,
    response: np.ndarray,
    inverse: np.ndarray,
) -> np.ndarray:
    """Return (M, P): one Newton step from `values` with each member of the simulation."""
    found = []
    for member in range(model.members):
        residual = model.session.residual_of(model.likeliest_twist(fitted.mechanisms, member))
        scaled = model.whitener(residual).numpy() / fitted.residual_scale
        found.append(values - inverse @ np.einsum("nd,ndp->p", _held(model, scaled), response))
    return np.array(found)
