"""The reference's own noise: what measured motion differs by from the simulation where nothing is wrong."""

from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from scipy import optimize, stats
from torch import Tensor

from swarmtwin.gap.session import Session
from swarmtwin.geometry import rotate, wrap_angle

RIDGE = 1e-3
LARGEST_LOG = 3.0
DEGREES_OF_FREEDOM = (4.0, 5.0, 7.0, 10.0, 15.0, 30.0, 100.0)


@dataclass(frozen=True)
class Noise:
    """How residuals (measured minus simulated way, forward_mm, left_mm, turn_rad) spread and how long they last.

    A pose that is measured wrong makes two residuals wrong, the other way round; water that moves, moves on. So each
    residual is first freed of what the one before says of it, then divided by its own spread, which grows with the
    motion.

    Attributes:
        carry: (3, 5) what is expected of a residual after the one before, in the vehicle's frame: of its three numbers,
            and of its turn times the way ahead and to the left, since a heading that is measured wrong bends both.
        usual: (3,) usual size of the motion.
        log_spread: (8, 3) log standard deviation over [1, size, size², first of its run].
        mixing: (3, 3) makes what is left uncorrelated.
        degrees_of_freedom: of the tails (Student's t); 100 is normal.
    """

    carry: Tensor
    usual: Tensor
    log_spread: Tensor
    mixing: Tensor
    degrees_of_freedom: float

    @classmethod
    def learn(cls, residual: Tensor, way: Tensor, session: Session) -> Self:
        """Learn from residuals (N, 3) of transitions that the simulation was not fitted to, and simulated ways."""
        usual = way.std(dim=0).clamp(min=1e-6)
        follows = torch.as_tensor(session.follows >= 0)
        before = _before(residual, way / usual, session)
        carry = torch.linalg.lstsq(before[follows], residual[follows], driver="gelsd").solution.T
        fresh = residual - before @ carry.T
        columns = _columns(way / usual, follows)
        log_spread = torch.stack([_log_spread(columns, fresh[:, axis]) for axis in range(3)], dim=-1)
        scaled = fresh / _spread(columns, log_spread)
        clipped = scaled.clamp(-4, 4)
        mixing = torch.linalg.inv(torch.linalg.cholesky(torch.cov(clipped.T)))
        plain = cls(carry, usual, log_spread, mixing, 100.0)
        freedom = _degrees_of_freedom((scaled @ mixing.T).numpy())
        return cls(carry, usual, log_spread, mixing, freedom) if freedom < 100.0 else plain

    def whitener(self, way: Tensor, session: Session) -> "Whitener":
        """Prepare to standardise residuals of a session whose simulated ways are (N, 3)."""
        follows = torch.as_tensor(session.follows >= 0)
        size = way / self.usual
        return Whitener(self, session, size, _spread(_columns(size, follows), self.log_spread))


@dataclass(frozen=True)
class Whitener:
    """Standardises the residuals of one session.

    Attributes:
        noise: the reference's.
        session: whose residuals.
        size: (N, 3) simulated ways over usual ones.
        spread: (N, 3) their standard deviations.
    """

    noise: Noise
    session: Session
    size: Tensor
    spread: Tensor

    def __call__(self, residual: Tensor, earlier: Tensor | None = None) -> Tensor:
        """Return residuals (N, 3) in units of the reference's noise, independent of each other.

        `earlier` are the residuals that count as those before; by default the same ones.
        """
        before = _before(residual if earlier is None else earlier, self.size, self.session)
        whitened: Tensor = ((residual - before @ self.noise.carry.T) / self.spread) @ self.noise.mixing.T
        return whitened


def residual_of(session: Session, way: Tensor) -> Tensor:
    """Return measured minus simulated ways (N, 3), the angle wrapped."""
    difference = session.way - way
    return torch.cat([difference[:, :2], wrap_angle(difference[:, 2:])], dim=-1)


def _before(residual: Tensor, size: Tensor, session: Session) -> Tensor:
    """Return (N, 5) what the residual of the transition before says, seen from this one; 0 where there is none."""
    earlier = residual[np.maximum(session.follows, 0)]
    turned = rotate(earlier[:, :2], -session.turned)
    bent = earlier[:, 2:] * size[:, :2]
    said = torch.cat([turned, earlier[:, 2:], bent], dim=-1)
    return said * torch.as_tensor(session.follows >= 0)[:, None]


def _columns(size: Tensor, follows: Tensor) -> Tensor:
    size = size.abs().clamp(max=LARGEST_LOG)
    return torch.cat([torch.ones(len(size), 1), size, size**2, (~follows)[:, None].double()], dim=-1).double()


def _spread(columns: Tensor, log_spread: Tensor) -> Tensor:
    return (columns @ log_spread).clamp(-12.0, 12.0).exp()


def _log_spread(columns: Tensor, fresh: Tensor) -> Tensor:
    """Fit the log standard deviation (columns,) by maximum likelihood with a slight ridge, robust against outliers."""
    spread = float(1.4826 * fresh.abs().median())
    inputs = columns.numpy()
    squared = np.minimum((fresh.numpy() / spread) ** 2, 25.0)

    def loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
        log = inputs @ weights
        ratio = squared * np.exp(-2 * log)
        gradient = inputs.T @ (1 - ratio) / len(log) + 2 * RIDGE * np.r_[0.0, weights[1:]]
        return float((log + ratio / 2).mean() + RIDGE * (weights[1:] ** 2).sum()), gradient

    found = optimize.minimize(loss, np.zeros(inputs.shape[1]), jac=True, method="L-BFGS-B")
    found.x[0] += np.log(spread)
    return torch.as_tensor(found.x)


def _degrees_of_freedom(whitened: np.ndarray) -> float:
    def likelihood(freedom: float) -> float:
        scale = stats.t.fit(whitened.ravel()[:20_000], fdf=freedom, floc=0)[2]
        return float(stats.t.logpdf(whitened, freedom, scale=scale).sum())

    return max(DEGREES_OF_FREEDOM, key=likelihood)
