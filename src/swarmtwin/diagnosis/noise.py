"""The reference's own noise: what measured motion differs by from the simulation where nothing is wrong."""

from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from scipy import optimize, stats
from torch import Tensor

from swarmtwin.diagnosis.measured_session import MeasuredSession
from swarmtwin.diagnosis.settings import NoiseSettings


@dataclass(frozen=True)
class Noise:
    """How residuals (measured minus simulated twist: forward_mm, left_mm, turn_rad) spread and how long they last.

    A pose that is measured wrong makes two residuals wrong, the other way round; water that moves, moves on. So each
    residual is first freed of what the one before says of it, then divided by its own spread, which grows with the
    motion.

    Attributes:
        carry: (3, 5) what is expected of a residual after the one before, in the vehicle's frame: of its three numbers,
            and of its turn times the twist ahead and to the left, since a heading that is measured wrong bends both.
        usual: (3,) usual size of the motion.
        log_scale: (8, 3) log standard deviation over [1, size, size², first of its run].
        largest_motion: sizes beyond which it grows no more.
        mixing: (3, 3) makes what is left uncorrelated.
        degrees_of_freedom: of the tails (Student's t); None: normal.
    """

    carry: Tensor
    usual: Tensor
    log_scale: Tensor
    largest_motion: float
    mixing: Tensor
    degrees_of_freedom: float | None

    @classmethod
    def learn(
        cls, residual: Tensor, twist: Tensor, session: MeasuredSession, settings: NoiseSettings | None = None
    ) -> Self:
        """Learn from residuals (N, 3) of transitions that the simulation was not fitted to, and simulated twists."""
        settings = settings or NoiseSettings()
        usual = twist.std(dim=0).clamp(min=1e-6)
        follows = torch.as_tensor(session.follows >= 0)
        before = _regressors_before(residual, twist / usual, session)
        carry = torch.linalg.lstsq(before[follows], residual[follows], driver="gelsd").solution.T
        innovation = residual - before @ carry.T
        columns = _scale_regressors(twist / usual, follows, settings.largest_motion)
        log_scale = torch.stack([_log_scale(columns, innovation[:, axis], settings) for axis in range(3)], dim=-1)
        scaled = innovation / _scale(columns, log_scale)
        clipped = scaled.clamp(-settings.clip_z, settings.clip_z)
        mixing = torch.linalg.inv(torch.linalg.cholesky(torch.cov(clipped.T)))
        freedom = _degrees_of_freedom((scaled @ mixing.T).numpy(), settings.degrees_of_freedom)
        heavy = freedom if freedom < settings.normal_from else None
        return cls(carry, usual, log_scale, settings.largest_motion, mixing, heavy)

    def scale(self, twist: Tensor, first: Tensor) -> Tensor:
        """Return standard deviations (N, 3) of residuals at simulated twists (N, 3), `first` (N,) of their runs."""
        return _scale(_scale_regressors(twist / self.usual, ~first, self.largest_motion), self.log_scale)

    def whitener(self, twist: Tensor, session: MeasuredSession) -> "Whitener":
        """Prepare to standardise residuals of a session whose simulated twists are (N, 3)."""
        first = torch.as_tensor(session.follows < 0)
        return Whitener(self, session, twist / self.usual, self.scale(twist, first))


@dataclass(frozen=True)
class Whitener:
    """Standardises the residuals of one session.

    Attributes:
        noise: the reference's.
        session: whose residuals.
        size: (N, 3) simulated twists over usual ones.
        residual_scale: (N, 3) standard deviations of the residuals.
    """

    noise: Noise
    session: MeasuredSession
    size: Tensor
    residual_scale: Tensor

    def __call__(self, residual: Tensor, earlier: Tensor | None = None) -> Tensor:
        """Return residuals (N, 3) in units of the reference's noise, independent of each other.

        `earlier` (N, 3) are the residuals that count as those before; by default the same ones.
        """
        before = _regressors_before(residual if earlier is None else earlier, self.size, self.session)
        whitened: Tensor = ((residual - before @ self.noise.carry.T) / self.residual_scale) @ self.noise.mixing.T
        return whitened


def _regressors_before(residual: Tensor, size: Tensor, session: MeasuredSession) -> Tensor:
    """Return (N, 5) what the residual of the transition before says, seen from this one; 0 where there is none."""
    before = session.before(residual)
    bent = before[:, 2:] * size[:, :2]
    return torch.cat([before, bent], dim=-1) * torch.as_tensor(session.follows >= 0)[:, None]


def _scale_regressors(size: Tensor, follows: Tensor, largest: float) -> Tensor:
    size = size.abs().clamp(max=largest)
    return torch.cat([torch.ones(len(size), 1), size, size**2, (~follows)[:, None].double()], dim=-1).double()


def _scale(columns: Tensor, log_scale: Tensor) -> Tensor:
    return (columns @ log_scale).clamp(-12.0, 12.0).exp()  # e±12: beyond any believable mm or rad, but finite


def _log_scale(columns: Tensor, innovation: Tensor, settings: NoiseSettings) -> Tensor:
    """Fit the log standard deviation (columns,) by maximum likelihood with a slight ridge, robust against outliers."""
    usual = float(1.4826 * innovation.abs().median())  # the median of |z| is 1 / 1.4826
    inputs = columns.numpy()
    squared = np.minimum((innovation.numpy() / usual) ** 2, settings.clip_squared)
    ridge = settings.ridge

    def loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
        log = inputs @ weights
        ratio = squared * np.exp(-2 * log)
        gradient = inputs.T @ (1 - ratio) / len(log) + 2 * ridge * np.r_[0.0, weights[1:]]
        return float((log + ratio / 2).mean() + ridge * (weights[1:] ** 2).sum()), gradient

    found = optimize.minimize(loss, np.zeros(inputs.shape[1]), jac=True, method="L-BFGS-B")
    found.x[0] += np.log(usual)
    return torch.as_tensor(found.x)


def _degrees_of_freedom(whitened: np.ndarray, candidates: tuple[float, ...]) -> float:
    """Return the likeliest of the candidates, each with its own scale; 20,000 values tell the scale well enough."""

    def likelihood(freedom: float) -> float:
        scale = stats.t.fit(whitened.ravel()[:20_000], fdf=freedom, floc=0)[2]
        return float(stats.t.logpdf(whitened, freedom, scale=scale).sum())

    return max(candidates, key=likelihood)
