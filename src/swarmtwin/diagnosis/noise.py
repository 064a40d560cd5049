"""The reference's own noise: what measured motion differs by from the simulation where nothing is wrong.

An error e is the displacement from where the simulation says a vehicle goes to where it was measured, as a twist
(forward_mm, left_mm, turn_rad) in the frame at the period's end. The motion's own part is a change of its twist. A pose
that is measured wrong makes two of them wrong: with camera errors ε before and after a period, and η of the motion,

    e_t = −A_t ε_t + η_t + ε_{t+1},    A_t = Ad(displacement_t⁻¹),

to first order. So errors of one run are jointly normal with a block-tridiagonal covariance, and a filter over ε makes
them independent of each other.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy import optimize
from scipy.special import gammaln

from swarmtwin.diagnosis.measured_session import MeasuredSession
from swarmtwin.diagnosis.noise_filter import Chains, NoiseFilter
from swarmtwin.diagnosis.settings import NoiseSettings


@dataclass(frozen=True)
class Noise:
    """How errors spread: motion that grows with what is moved, and the camera's part.

    Attributes:
        usual: (2,) usual way ahead in mm and turn in rad.
        growth: (3, 3) for each axis of the twist its variance over
            [1, (forward / usual)², (turn / usual)²].
        forward_with_turn: covariance of way ahead and turn over forward · turn, which unlike wheels have.
        camera: (3,) variance of a measured pose: x and y in mm², heading in rad².
        degrees_of_freedom: of the tails (Student's t with this scale); None: normal.
    """

    usual: np.ndarray
    growth: np.ndarray
    forward_with_turn: float
    camera: np.ndarray
    degrees_of_freedom: float | None

    @classmethod
    def learn(
        cls, error: np.ndarray, twist: np.ndarray, session: MeasuredSession, settings: NoiseSettings | None = None
    ) -> Self:
        """Learn from errors (N, 3) of transitions that the simulation was not fitted to, and their twists (N, 3)."""
        settings = settings or NoiseSettings()
        usual = np.maximum(np.sqrt((twist[:, [0, 2]] ** 2).mean(axis=0)), 1e-6)
        scale = np.tile(np.maximum(error.std(axis=0), 1e-9), (len(error), 1))
        size, to_twist = _size(twist, usual), np.linalg.inv(right_jacobian(twist))
        along = np.einsum("nij,nj->ni", to_twist, error)
        for _ in range(settings.rounds):
            kept = (np.abs(along) / scale).max(axis=1) <= settings.clip_z
            camera = _camera_variance(error, twist, session, kept)
            seen = to_twist @ _camera_covariance(twist, camera) @ to_twist.transpose(0, 2, 1)
            own = seen[:, range(3), range(3)]
            growth = np.stack([_growth(size, along[:, axis], own[:, axis], scale[:, axis], kept) for axis in range(3)])
            growth[:, 0] += settings.least_share * (growth.sum(axis=1) + camera)
            scale = np.sqrt(size @ growth.T + own)
        both = twist[:, 0] * twist[:, 2]
        together = (along[:, 0] * along[:, 2] - seen[:, 0, 2])[kept]
        with_turn = float(together @ both[kept] / max(float(both[kept] @ both[kept]), 1e-12))
        noise = cls(usual, growth, with_turn, camera, None)
        noise = noise._with_scales(error, twist, session, settings)._with_tails(error, twist, session, settings)
        return noise._with_some_camera(settings.least_share)

    def _with_some_camera(self, least_share: float) -> Self:
        """Return it with a camera that has at least a share of all variance, of x and y that of the quieter axis.

        Motion that goes on as it was disturbed makes neighbouring errors alike, and hides the camera. A session in
        which the camera errs more is told by a factor on that, which must not be 0.
        """
        least = least_share * (self.growth.sum(axis=1) + self.camera)
        least[:2] = least[:2].min()
        return replace(self, camera=np.maximum(self.camera, least))

    def _with_scales(
        self, error: np.ndarray, twist: np.ndarray, session: MeasuredSession, settings: NoiseSettings
    ) -> Self:
        return self.scaled(likeliest_scales(self, error, twist, session, settings.scale_spread))

    def _with_tails(
        self,
        error: np.ndarray,
        twist: np.ndarray,
        session: MeasuredSession,
        settings: NoiseSettings,
        worth: float = 2.0,
    ) -> Self:
        """Return it with tails where these make errors likelier by more nats than a parameter is worth."""
        whitened = self.filter(twist, session)(error[..., None])[..., 0]
        best, most = None, float(log_density(whitened, None).sum()) + worth
        for freedom in settings.degrees_of_freedom:
            scale2 = 1.0
            for _ in range(10):
                scale2 = float((tail_weights(whitened / np.sqrt(scale2), freedom)[:, None] * whitened**2).mean())
            likelihood = log_density(whitened / np.sqrt(scale2), freedom).sum() - 1.5 * len(whitened) * np.log(scale2)
            if likelihood > most:
                alike = NoiseScales(scale2, scale2, scale2)
                best, most = replace(self.scaled(alike), degrees_of_freedom=freedom), float(likelihood)
        return best._with_scales(error, twist, session, settings) if best else self

    def scaled(self, scales: "NoiseScales") -> Self:
        """Return it with other variances of motion, measured positions and measured headings."""
        camera = self.camera * np.array([scales.position, scales.position, scales.heading])
        growth, with_turn = self.growth * scales.motion, self.forward_with_turn * scales.motion
        return replace(self, growth=growth, forward_with_turn=with_turn, camera=camera)

    def motion_covariance(self, twist: np.ndarray) -> np.ndarray:
        """Return the covariances (N, 3, 3) of the motion's own part at twists (N, 3), in the frame at the end."""
        variance = _size(twist, self.usual) @ self.growth.T
        covariance = np.zeros((len(twist), 3, 3))
        covariance[:, range(3), range(3)] = variance
        most = 0.9 * np.sqrt(variance[:, 0] * variance[:, 2])
        shared = np.clip(self.forward_with_turn * twist[:, 0] * twist[:, 2], -most, most)
        covariance[:, 0, 2] = covariance[:, 2, 0] = shared
        jacobian = right_jacobian(twist)
        at_end: np.ndarray = jacobian @ covariance @ jacobian.transpose(0, 2, 1)
        return at_end

    def motion_variance(self, twist: np.ndarray) -> np.ndarray:
        """Return the mean variances (3,) of the motion's own part over twists (N, 3)."""
        mean: np.ndarray = (_size(twist, self.usual) @ self.growth.T).mean(axis=0)
        return mean

    def log_from_usual(self, twist: np.ndarray) -> float:
        """Return how far the log of the way and turn in twists (N, 3) is from the reference's, root mean square."""
        moved = np.maximum(np.sqrt((twist[:, [0, 2]] ** 2).mean(axis=0)), 1e-6)
        return float(np.sqrt((np.log(moved / self.usual) ** 2).mean()))

    def spread(self, twist: np.ndarray) -> np.ndarray:
        """Return standard deviations (N, 3) of single errors at twists (N, 3)."""
        total = self.motion_covariance(twist) + _camera_covariance(twist, self.camera)
        spread: np.ndarray = np.sqrt(total[:, range(3), range(3)])
        return spread

    def filter(self, twist: np.ndarray, session: MeasuredSession) -> "NoiseFilter":
        """Prepare to make errors of a session independent, whose vehicles truly move by about `twist` (N, 3)."""
        chains = Chains.of(session.chains())
        return NoiseFilter.prepared(chains, -inverse_adjoint(twist), self.motion_covariance(twist), self.camera)

    def log_likelihood(self, error: np.ndarray, twist: np.ndarray, session: MeasuredSession) -> float:
        """Return the log-likelihood of errors (N, 3), nats."""
        prepared = self.filter(twist, session)
        density = log_density(prepared(error[..., None])[..., 0], self.degrees_of_freedom)
        return float(density.sum() - prepared.log_volume.sum())


@dataclass(frozen=True)
class NoiseScales:
    """Factors on the variances of the motion, of measured positions and of measured headings."""

    motion: float = 1.0
    position: float = 1.0
    heading: float = 1.0


def likeliest_scales(
    noise: Noise, error: np.ndarray, twist: np.ndarray, session: MeasuredSession, spread: float, most_pieces: int = 160
) -> NoiseScales:
    """Return the likeliest factors on a session's noise, of short pieces of its runs, as if each were a run.

    Args:
        noise: of the reference.
        error: (N, 3) of what no longer depends on anything.
        twist: (N, 3) by which vehicles move.
        session: theirs.
        spread: standard deviation of the logs of the factors' square roots, normal prior.
        most_pieces: that are looked at.
    """
    pieces = session.chains(longest=16)
    pieces = pieces[:: max(1, len(pieces) // most_pieces)]
    chains = Chains.of(pieces)
    rows, chains = chains.rows, chains.alone()
    carry, motion, seen = -inverse_adjoint(twist[rows]), noise.motion_covariance(twist[rows]), error[rows, :, None]

    def loss(logs: np.ndarray) -> float:
        scales = NoiseScales(*np.exp(2 * logs))
        prepared = NoiseFilter.prepared(chains, carry, scales.motion * motion, noise.scaled(scales).camera)
        density = log_density(prepared(seen)[..., 0], noise.degrees_of_freedom)
        likelihood = density.sum() - prepared.log_volume.sum()
        return float(-likelihood * len(error) / len(rows) + ((logs / spread) ** 2).sum() / 2)

    neighbours = _camera_variance(error, twist, session, np.ones(len(error), bool))
    camera = np.log(np.divide(neighbours, noise.camera, out=np.ones(3), where=noise.camera > 0)) / 2
    starts = np.zeros(3), np.clip([0.0, camera[0], camera[2]], -3.0, 3.0)
    start = min(starts, key=loss)  # from next to no camera a search hardly sees that it may be larger
    simplex = start + np.concatenate([np.zeros((1, 3)), 0.15 * np.eye(3)])
    options = {"initial_simplex": simplex, "xatol": 0.004, "fatol": 0.2, "maxfev": 60}
    found = optimize.minimize(loss, start, method="Nelder-Mead", options=options)
    return NoiseScales(*np.exp(2 * np.clip(found.x, -3.0, 3.0)))


def motion_scale_log(
    noise: Noise,
    scales: NoiseScales,
    error: np.ndarray,
    twist: np.ndarray,
    session: MeasuredSession,
    spread: float,
    most_steps: int = 20,
) -> tuple[float, float]:
    """Return the log of the factor on the motion's standard deviation, with its standard error over runs.

    By Newton's method from factors that are nearly the likeliest. Where the likelihood is curved upwards along some
    axis, so that a step would lead down, it leads the other way, as far (Dauphin et al., 2014).

    Args:
        noise: of the session, with these factors.
        scales: the factors.
        error: (N, 3) of what no longer depends on anything.
        twist: (N, 3) by which vehicles move.
        session: theirs.
        spread: standard deviation of the logs of the factors' square roots, normal prior.
        most_steps: of Newton's method; two are usual.
    """
    began, longest, enough = np.log([scales.motion, scales.position, scales.heading]) / 2, 0.2, 0.02

    def by_run(logs: np.ndarray) -> np.ndarray:
        scaled = noise.scaled(NoiseScales(*np.exp(2 * logs)))
        prepared = scaled.filter(twist, session)
        density = log_density(prepared(error[..., None])[..., 0], noise.degrees_of_freedom) - prepared.log_volume
        return session.by_run(density)

    logs, prior = np.zeros(3), np.eye(3) / spread**2
    for _ in range(most_steps):
        scores, curvature = _derivatives(by_run, logs)
        sizes, axes = np.linalg.eigh(curvature + prior)
        inverse = axes / np.maximum(np.abs(sizes), 1 / spread**2) @ axes.T
        step = inverse @ (scores.sum(axis=0) - prior @ (began + logs))
        length = np.abs(step).max()
        logs = logs + step * longest / max(length, longest)
        if length <= enough:
            break
    scores = scores - scores.mean(axis=0)
    covariance = inverse @ (scores.T @ scores) @ inverse
    return float(began[0] + logs[0]), float(np.sqrt(max(covariance[0, 0], 1e-12)))


def _derivatives(
    by_run: Callable[[np.ndarray], np.ndarray], logs: np.ndarray, step: float = 0.03
) -> tuple[np.ndarray, np.ndarray]:
    """Return how log-likelihoods (R,) of runs change with logs (3,): (R, 3), and the curvature (3, 3) of their sum."""
    steps = step * np.eye(3)
    ends = [(by_run(logs + one), by_run(logs - one)) for one in steps]
    middle = by_run(logs)
    scores = np.stack([(ahead - back) / (2 * step) for ahead, back in ends], axis=-1)
    curvature = np.empty((3, 3))
    for one in range(3):
        curvature[one, one] = -(ends[one][0] + ends[one][1] - 2 * middle).sum() / step**2
        for other in range(one):
            both = by_run(logs + steps[one] + steps[other]) - ends[one][0] - ends[other][0] + middle
            curvature[one, other] = curvature[other, one] = -both.sum() / step**2
    return scores, curvature


def log_density(whitened: np.ndarray, freedom: float | None) -> np.ndarray:
    """Return the log densities (...,) of whitened errors (..., 3), normal or Student's t of three dimensions."""
    squared = np.einsum("...i,...i->...", whitened, whitened)
    if freedom is None:
        normal: np.ndarray = -0.5 * squared - 1.5 * np.log(2 * np.pi)
        return normal
    constant = gammaln((freedom + 3) / 2) - gammaln(freedom / 2) - 1.5 * np.log(freedom * np.pi)
    student: np.ndarray = constant - 0.5 * (freedom + 3) * np.log1p(squared / freedom)
    return student


def inverse_adjoint(twist: np.ndarray) -> np.ndarray:
    """Return (N, 3, 3) how a small motion before a period looks in the frame after it: Ad(exp(twist)⁻¹)."""
    turn = twist[:, 2]
    near = np.abs(turn) < 1e-6
    safe = np.where(near, 1.0, turn)
    sine = np.where(near, 1.0, np.sin(safe) / safe)
    cosine = np.where(near, turn / 2, (1 - np.cos(safe)) / safe)
    x = sine * twist[:, 0] - cosine * twist[:, 1]
    y = cosine * twist[:, 0] + sine * twist[:, 1]
    cos, sin = np.cos(turn), np.sin(turn)
    adjoint = np.zeros((len(twist), 3, 3))
    adjoint[:, 0, 0], adjoint[:, 0, 1], adjoint[:, 0, 2] = cos, sin, -cos * y + sin * x
    adjoint[:, 1, 0], adjoint[:, 1, 1], adjoint[:, 1, 2] = -sin, cos, sin * y + cos * x
    adjoint[:, 2, 2] = 1.0
    return adjoint


def _size(twist: np.ndarray, usual: np.ndarray) -> np.ndarray:
    return np.column_stack([np.ones(len(twist)), (twist[:, [0, 2]] / usual) ** 2])


def _camera_covariance(twist: np.ndarray, camera: np.ndarray) -> np.ndarray:
    """Return (N, 3, 3) what the camera adds to the covariance of single errors."""
    adjoint = inverse_adjoint(twist)
    covariance: np.ndarray = adjoint * camera @ adjoint.transpose(0, 2, 1) + np.diag(camera)
    return covariance


def _growth(size: np.ndarray, error: np.ndarray, camera: np.ndarray, scale: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Return (3,) by which an error's variance grows with what is moved; each square counts as it is known itself."""
    known = 1 / scale[kept] ** 2
    found: np.ndarray = optimize.nnls(size[kept] * known[:, None], (error[kept] ** 2 - camera[kept]) * known)[0]
    return found


def right_jacobian(twist: np.ndarray) -> np.ndarray:
    """Return (N, 3, 3) how a small change of a twist looks in the frame at its end (Solà et al., 2018, eq. 163)."""
    x, y, turn = twist.T
    near = np.abs(turn) < 1e-4
    safe = np.where(near, 1.0, turn)
    sine = np.where(near, 1.0, np.sin(safe) / safe)
    cosine = np.where(near, turn / 2, (1 - np.cos(safe)) / safe)
    lag = np.where(near, turn / 6, (safe - np.sin(safe)) / safe**2)
    curve = np.where(near, 0.5, (1 - np.cos(safe)) / safe**2)
    jacobian = np.zeros((len(twist), 3, 3))
    jacobian[:, 0, 0], jacobian[:, 0, 1], jacobian[:, 0, 2] = sine, cosine, x * lag - y * curve
    jacobian[:, 1, 0], jacobian[:, 1, 1], jacobian[:, 1, 2] = -cosine, sine, y * lag + x * curve
    jacobian[:, 2, 2] = 1.0
    return jacobian


def _camera_variance(error: np.ndarray, twist: np.ndarray, session: MeasuredSession, kept: np.ndarray) -> np.ndarray:
    """Return (3,) the camera's variance: neighbouring errors disagree by it, Cov(e_t, A_{t+1}⁻¹ e_{t+1}) = −C."""
    later = np.flatnonzero((session.follows >= 0) & kept)
    later = later[kept[session.follows[later]]]
    most = 0.45 * error[kept].var(axis=0)
    if len(later) < 100:  # too few pairs for a covariance: all is taken for motion
        return 1e-3 * most + 1e-12
    back = np.linalg.solve(inverse_adjoint(twist[later]), error[later][..., None])[..., 0]
    shared = -(error[session.follows[later]] * back).mean(axis=0)
    shared[:2] = shared[:2].mean()  # a camera errs alike along both axes of its image
    most[:2] = most[:2].min() if most[:2].min() > 0 else most[:2].max()
    return np.clip(shared, 1e-3 * most + 1e-12, most + 1e-12)


def tail_weights(whitened: np.ndarray, freedom: float | None) -> np.ndarray:
    """Return (N,) how much errors count in least squares that stand for the likelihood under Student's t."""
    if freedom is None:
        return np.ones(len(whitened))
    weight: np.ndarray = (freedom + 3) / (freedom + (whitened**2).sum(axis=-1))
    return weight
