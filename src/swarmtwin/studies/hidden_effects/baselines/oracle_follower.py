"""The way of the oracle's filter through a session: what is expected of each picture, and what a picture corrects."""

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.special import gammaln

from swarmtwin.geometry import wrap_angle
from swarmtwin.standin.physics import Period, Physics, advance
from swarmtwin.standin.session import DrivenSession


@dataclass(frozen=True)
class Chance:
    """How surprises are distributed, and how the filter sees what chance does.

    Attributes:
        freedom: degrees of freedom of the surprises' Student's t; None: they are normal.
        usual_noise: factor on the motion's random part that makes normal surprises of heavy-tailed ones.
        astray: share of normal surprises that are `astray_factor` times as large: a filter is linear, a wall is not.
        astray_factor: see there.
        parts: of a period in which chance is taken to act alike, shorter at its beginning, where speeds change.
        nudge: of velocities, as a share of 100 mm/s or 1 rad/s, by which the equations are made linear.
    """

    freedom: float | None = None
    usual_noise: float = 1.0
    astray: float = 0.01
    astray_factor: float = 5.0
    parts: int = 8
    nudge: float = 0.05

    def judge(self, squared: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the log-density of surprises of squared size (R, V), but for a constant, and how much each counts."""
        if self.freedom is not None:
            weight = (self.freedom + 3.0) / (self.freedom + squared)
            return -0.5 * (self.freedom + 3.0) * np.log1p(squared / self.freedom), weight
        usual = np.log1p(-self.astray) - 0.5 * squared
        astray = np.log(self.astray) - 3.0 * np.log(self.astray_factor) - 0.5 * squared / self.astray_factor**2
        density = np.logaddexp(usual, astray)
        is_usual = np.exp(usual - density)
        return density, is_usual + (1.0 - is_usual) / self.astray_factor**2

    @property
    def constant(self) -> float:
        """What the log-density leaves out, but for that of a normal distribution."""
        if self.freedom is None:
            return 0.0
        half = self.freedom / 2
        return float(gammaln(half + 1.5) - gammaln(half) - 1.5 * np.log(half))


@dataclass(frozen=True)
class Pictures:
    """What the camera showed.

    Attributes:
        measured: (R, T + 1, V, 3) poses as recorded, NaN where there is none.
        is_seen: which of them there are, (R, T + 1, V).
    """

    measured: np.ndarray
    is_seen: np.ndarray


class Evaluation(NamedTuple):
    """A session under supposed effects.

    Attributes:
        nats: (R,) log-likelihood of each run.
        surprise: (N,) whitened differences between pictures and what was expected of them, weighted as they count.
        log_size: (T, R, V) log-determinant of the whitening.
    """

    nats: np.ndarray
    surprise: np.ndarray
    log_size: np.ndarray


class Follower:
    """The filter on its way through R runs of V vehicles, period by period.

    Attributes:
        state: (states, R, V) what it holds for likeliest.
        active: (m, R, V) the command in force.
    """

    def __init__(
        self, physics: Physics, driven: DrivenSession, pictures: Pictures, moved: np.ndarray, chance: Chance
    ) -> None:
        """Take vehicles at the beginning of all runs; chance moves the states of indices `moved` (n,)."""
        self.physics, self.driven, self.pictures, self.moved, self.chance = physics, driven, pictures, moved, chance
        self.duration_s, self.progress = driven.duration_s, driven.session.progress(driven.time_s)
        self.loss = physics.conditions.loss_probability
        self.state = physics.at_rest(np.moveaxis(self._start(), -1, 0))
        self.active = np.empty((len(physics.resting_command), *self.state.shape[1:]))
        self.active[:] = np.reshape(physics.resting_command, (-1, 1, 1))
        self.ways: list[tuple[float, np.ndarray, np.ndarray]] = []
        self.nats: list[np.ndarray] = []
        self.surprises: list[np.ndarray] = []

    def _start(self, rounds: int = 4) -> np.ndarray:
        """Return the poses (R, V, 3) that the first pictures show; where there is none, the true ones."""
        true = np.moveaxis(self.driven.state[:3, :, 0], 0, -1)
        shown = np.where(self.pictures.is_seen[:, 0, :, None], self.pictures.measured[:, 0], true)
        pose = shown.copy()
        for _ in range(rounds):
            pose = pose + apart(shown, self.physics.seen(pose, self.progress[:, 0, None]))
        return pose

    def go_on(self, step: int, shift: np.ndarray) -> None:
        """Let a period pass, with its command and, where commands are lost, without it as well.

        Chance moves states on average by a `shift` (n, R, V).
        """
        command = np.moveaxis(self.driven.command[:, step], -1, 0)
        self.ways = [(1.0 - self.loss, command, self._after(command, step))]
        if self.loss:
            self.ways.append((self.loss, self.active, self._after(self.active, step)))
        for _, _, after in self.ways:
            after[self.moved] += shift

    def _after(self, command: np.ndarray, step: int) -> np.ndarray:
        period = Period(command, self.active, self.duration_s[:, step, None], self.progress[:, step, None])
        return advance(self.physics, self.state, period)

    def look(self, step: int, gain: np.ndarray, whitening: np.ndarray) -> None:
        """Compare what was expected with the next picture, and correct the states that chance moves."""
        shown = self.pictures.measured[:, step + 1]
        nats, surprises, states = [], [], []
        for chance, _, after in self.ways:
            expected = self.physics.seen(np.moveaxis(after[:3], 0, -1), self.progress[:, step + 1, None])
            away = np.nan_to_num(apart(shown, expected))
            surprise = np.einsum("rvij,rvj->rvi", whitening, away)
            squared = (surprise**2).sum(axis=-1)
            density, weight = self.chance.judge(squared)
            corrected = after.copy()
            corrected[self.moved] += np.moveaxis(np.einsum("rvij,rvj->rvi", gain, away), -1, 0)
            nats.append(np.log(chance) + density)
            surprises.append(surprise * np.sqrt(weight)[..., None])
            states.append(corrected)
        likeliest = np.argmax(nats, axis=0)
        self.nats.append(np.logaddexp.reduce(nats, axis=0))
        self.surprises.append(np.where((likeliest == 0)[..., None], surprises[0], surprises[-1]))
        self.active = np.where(likeliest == 0, self.ways[0][1], self.ways[-1][1])
        self.state = np.where(likeliest == 0, states[0], states[-1])

    def evaluation(self, log_size: np.ndarray) -> Evaluation:
        """Return the likelihood of all that was seen."""
        seen = np.moveaxis(self.pictures.is_seen[:, 1:], 1, 0)
        nats = np.stack(self.nats) + log_size + self.chance.constant * seen
        surprise = np.stack(self.surprises).ravel()
        return Evaluation(nats.sum(axis=(0, 2)), surprise, log_size)

    def seen_slope(self, row: int, nudge: tuple[float, float, float] = (1.0, 1.0, 0.02)) -> np.ndarray:
        """Return how the picture of a row depends on the states that chance moves, (R, V, 3, n)."""
        ways = self.ways[:1]
        pose = np.moveaxis((ways[0][2] if row and ways else self.state)[:3], 0, -1)
        progress = self.progress[:, row, None]
        slope = np.zeros((*pose.shape[:2], 3, len(self.moved)))
        for axis, size in enumerate(nudge):
            shifted = pose.copy()
            shifted[..., axis] += size
            away = apart(self.physics.seen(shifted, progress), self.physics.seen(pose, progress))
            slope[..., axis] = away / size
        return slope

    def slopes(self, step: int, unseen: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return how the states that chance moves pass through a period.

        Args:
            step: number of the period.
            unseen: (R, V, n, n) covariance of the states before.

        Returns:
            transition (R, V, n, n), covariance that it adds (R, V, n, n), and by how much chance, and what is not known
            of the states before, move them on average (n, R, V), by differences to both sides.
        """
        moved, physics = self.moved, self.physics
        shares = np.linspace(0.0, 1.0, self.chance.parts + 1) ** 2
        edges = np.unique((physics.substeps * shares).round().astype(int))
        parts = len(edges) - 1
        runs, vehicles = self.state.shape[1:]
        nudges = np.array([0.02, *([100 * self.chance.nudge] * 2), self.chance.nudge])[: len(moved) - 2]
        first = len(nudges)
        half = first + parts * physics.noises
        columns = 1 + 2 * half
        state = np.repeat(self.state[:, None], columns, axis=1)
        noise = np.zeros((physics.substeps, physics.noises, columns, runs, vehicles))
        for sign, start in ((1.0, 1), (-1.0, 1 + half)):
            for index, size in enumerate(nudges):
                state[moved[2 + index], start + index] += sign * size
            for part, (low, high) in enumerate(pairwise(edges.tolist())):
                for channel in range(physics.noises):
                    column = start + first + part * physics.noises + channel
                    noise[low:high, channel, column] = sign / np.sqrt(high - low)
        after = self._all_after(step, state, noise)
        ahead, behind, middle = after[..., 1 : 1 + half], after[..., 1 + half :], after[..., :1]
        slope, bend = (ahead - behind) / 2.0, ahead + behind - 2.0 * middle
        transition = np.zeros((runs, vehicles, len(moved), len(moved)))
        transition[..., [0, 1], [0, 1]] = 1.0
        transition[..., 2:] = slope[..., :first] / nudges
        variance = np.diagonal(unseen, axis1=-2, axis2=-1)[..., None, 2:] / nudges**2
        shift = 0.5 * ((bend[..., :first] * variance).sum(axis=-1) + bend[..., first:].sum(axis=-1))
        pushed = slope[..., first:]
        return transition, pushed @ turned(pushed), np.moveaxis(shift, -1, 0)

    def _all_after(self, step: int, state: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return the moved states (R, V, n, columns) after a period of as many variants (states, columns, R, V)."""
        moved, (columns, runs, vehicles) = self.moved, state.shape[1:]
        command = np.moveaxis(self.driven.command[:, step], -1, 0)
        duration_s, progress = (np.tile(one[:, step], columns)[:, None] for one in (self.duration_s, self.progress))
        period = Period(np.tile(command, (1, columns, 1)), np.tile(self.active, (1, columns, 1)), duration_s, progress)
        flat = state.reshape(len(state), columns * runs, vehicles)
        after = advance(self.physics, flat, period, noise.reshape(*noise.shape[:2], columns * runs, vehicles))
        by_column = after[moved].reshape(len(moved), columns, runs, vehicles)
        return np.moveaxis(by_column, (0, 1), (-2, -1))


def apart(measured: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Return how far poses (..., 3) are from expected ones, headings wrapped."""
    away: np.ndarray = measured - expected
    return np.concatenate([away[..., :2], wrap_angle(away[..., 2:])], axis=-1)


def turned(matrix: np.ndarray) -> np.ndarray:
    """Return matrices (..., n, m) transposed."""
    return np.swapaxes(matrix, -1, -2)
