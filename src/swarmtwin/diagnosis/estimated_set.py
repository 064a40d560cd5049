"""Step 3, its outcome: a set of mechanisms with its likeliest values, how sure they are, and its evidence."""

from dataclasses import dataclass, field, replace

import numpy as np

from swarmtwin.diagnosis.likelihood import FittedMechanisms
from swarmtwin.simulation.mechanism import Mechanism


@dataclass(frozen=True)
class EstimatedSet:
    """A set of mechanisms, fitted to a session.

    Attributes:
        fitted: with the likeliest values.
        values: (P,) these.
        information: (P, P) curvature of the log posterior, random effects and forms integrated out.
        by_run: (R, P) what each run would move the values by.
        naive: (P, P) their covariance if runs were as independent as the likelihood has it, and nothing else unknown.
        evidence: log marginal likelihood, nats: parameters integrated out by Laplace's method, prior uniform in bounds.
        resampled: (P,) standard deviations of the values over resampled runs, where that was looked at.
        common: (P, M) what is the same in all runs and may move the values, each by a standard deviation: none where
            that was not looked at.
    """

    fitted: FittedMechanisms
    values: np.ndarray
    information: np.ndarray
    by_run: np.ndarray
    naive: np.ndarray
    evidence: float
    resampled: np.ndarray = field(default_factory=lambda: np.zeros(0))
    common: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def mechanisms(self) -> tuple[Mechanism, ...]:
        """The mechanisms with their values."""
        return self.fitted.mechanisms

    @property
    def names(self) -> tuple[str, ...]:
        """Their names."""
        return self.fitted.names

    @property
    def covariance(self) -> np.ndarray:
        """Posterior covariance (P, P); wider where runs differ more than the likelihood expects (a sandwich).

        To it adds what is the same in all runs (`common`).
        """
        posterior = np.linalg.inv(self.information)
        runs = len(self.by_run)
        if runs < 2 or not len(self.values):
            return posterior
        clustered = self.by_run.T @ self.by_run * (runs / (runs - 1))
        wider = np.sqrt(np.maximum(np.diag(clustered) / np.maximum(np.diag(self.naive), 1e-300), 1.0))
        if len(self.resampled):
            wider = np.maximum(wider, self.resampled / np.sqrt(np.diag(posterior)))
        covariance: np.ndarray = posterior * np.outer(wider, wider)
        return covariance + self.common @ self.common.T if self.common.size else covariance

    def beyond(self, shift: np.ndarray, moved: np.ndarray) -> "EstimatedSet":
        """Return it with values `shift` (P,) higher, and (P, M) more of what may move them."""
        return replace(self, values=self.values + shift, common=np.column_stack([*self.common.T, *moved.T]))

    def draws(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Draw (count, P) values from the posterior."""
        if not len(self.values):
            return np.zeros((count, 0))
        return rng.multivariate_normal(self.values, self.covariance, count, method="eigh")
