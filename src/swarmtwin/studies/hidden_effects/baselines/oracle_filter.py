"""The true likelihood of a stand-in's session under supposed effects: its own equations, and a Kalman filter on them.

Nothing is told of what only the stand-in saw: the filter is given what a laboratory records. Hidden states are carried
from the run's beginning by the equations themselves under the supposed effects; those that chance moves (the pose, and
the velocities of what swims) are estimated from one picture to the next, so that the camera's noise at both ends of a
step, and the motion's between them, weigh as they truly do.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
from scipy.special import gammaln

from swarmtwin.geometry import wrap_angle
from swarmtwin.recordings.recording import Recording
from swarmtwin.standin.effect import Effect
from swarmtwin.standin.physics import Period, Physics, advance
from swarmtwin.standin.session import DrivenSession
from swarmtwin.studies.hidden_effects.baselines.recorded_poses import recorded_poses


class Linearised(NamedTuple):
    """How chance enters each period of R runs of V vehicles, n states of which are moved by it.

    Attributes:
        transition: (T, R, V, n, n) how those states at the period's end depend on them at its beginning.
        spread: (T, R, V, n, n) covariance that the period itself adds.
        shift: (T, n, R, V) by which chance moves those states on average, since the equations are not linear.
        seen: (T + 1, R, V, 3, n) how the picture of a row depends on them.
    """

    transition: np.ndarray
    spread: np.ndarray
    shift: np.ndarray
    seen: np.ndarray


class Gains(NamedTuple):
    """What a Kalman filter does with each picture after the first.

    Attributes:
        gain: (T, R, V, n, 3) on what surprises it; zero where there is no picture.
        whitening: (T, R, V, 3, 3) by which surprises become independent and of variance 1; zero likewise.
        log_size: (T, R, V) log-determinant of the whitening; zero likewise.
        shift: (T, n, R, V) that chance adds to the states on average.
    """

    gain: np.ndarray
    whitening: np.ndarray
    log_size: np.ndarray
    shift: np.ndarray


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


@dataclass(frozen=True)
class TrueLikelihood:
    """The likelihood of one recorded session: who drove, when and by which commands is known, effects are supposed.

    Command loss is averaged over: each period is expected both ways, and the likelier one goes on. Where chance is
    heavy-tailed, surprises follow Student's t. What the first picture of a run says of the place it began at is not
    counted: the likelihood is that of all further pictures given the first.

    Attributes:
        driven: what the stand-in yielded; its states are looked at for the size of the camera's noise alone.
        measured: (R, T + 1, V, 3) poses as recorded, NaN where there is none.
        freedom: degrees of freedom of the surprises' Student's t; None: they are normal.
        usual_noise: factor on the motion's random part that makes normal surprises of heavy-tailed ones.
        parts: of a period in which chance is taken to act alike.
        astray: share of normal surprises that are `astray_factor` times as large: a filter is linear, a wall is not.
        astray_factor: see there.
        nudge: of velocities, as a share of 100 mm/s or 1 rad/s, by which the equations are made linear.
    """

    driven: DrivenSession
    measured: np.ndarray
    freedom: float | None = None
    usual_noise: float = 1.0
    parts: int = 5
    astray: float = 0.01
    astray_factor: float = 5.0
    nudge: float = 0.05

    @classmethod
    def of(cls, driven: DrivenSession, recording: Recording) -> Self:
        """Take a session and its recording, which may be rounded or blurred."""
        return cls(driven, recorded_poses(driven, recording))

    def with_tails_of(self, twin: Self, noises: Sequence[float] = (0.8, 1.0, 1.15, 1.3, 1.5)) -> Self:
        """Return it with the tails of a session in which nothing hides, where the stand-in's chance has heavy ones.

        Sums of Student's t are none themselves: its degrees of freedom, and the motion's noise that goes with them, are
        those under which the twin is likeliest.
        """
        if self.driven.session.conditions.character.motion_freedom is None:
            return self
        linear = twin.linearise(())
        tried = [(freedom, noise) for freedom in (2.5, 3.2, 4.0, 6.0) for noise in noises]

        def nats(freedom: float, noise: float) -> float:
            supposed = replace(twin, freedom=freedom, usual_noise=noise)
            return float(supposed.evaluate((), supposed.gains(linear)).nats.sum())

        freedom, noise = max(tried, key=lambda one: nats(*one))
        return replace(self, freedom=freedom, usual_noise=noise)

    def physics(self, effects: Sequence[Effect]) -> Physics:
        """Return the vehicles' equations under supposed effects."""
        return replace(self.driven.session, effects=effects).physics(self.driven.session.vehicles)

    @cached_property
    def is_seen(self) -> np.ndarray:
        """Which poses (R, T + 1, V) there are."""
        return np.isfinite(self.measured).all(axis=-1)

    @cached_property
    def camera(self) -> np.ndarray:
        """Covariance (3, 3) of the camera's noise: the stand-in's own, and as much more as the recording is blurred."""
        physics = self.physics(self.driven.session.effects)
        progress = self.driven.session.progress(self.driven.time_s)[:, :, None]
        true = physics.seen(np.moveaxis(self.driven.state[:3], 0, -1), progress)
        usual = np.array([physics.position_noise_mm, physics.position_noise_mm, physics.heading_noise_rad])
        own, recorded = (
            np.nanmean((self._apart(pose, true) / usual) ** 2) for pose in (self.driven.pose, self.measured)
        )
        return np.diag(usual**2) * max(recorded / own, 1.0)

    @cached_property
    def moved(self) -> np.ndarray:
        """Indices (n,) of the states that chance moves, the pose first."""
        physics = self.physics(())
        state = physics.at_rest(np.zeros((3, 1, len(self.driven.session.vehicles))))
        state[:2] = np.mean(self.driven.state[:2])
        command = np.full((len(physics.resting_command), *state.shape[1:]), 0.0)
        command[:] = np.reshape(self.driven.session.robot.command_high, (-1, 1, 1)) / 2
        period = Period(command, command, self.driven.session.robot.period_s, 0.0)
        noise = np.ones((physics.substeps, physics.noises, *state.shape[1:]))
        differs = advance(physics, state, period, noise) != advance(physics, state, period)
        return np.union1d(np.arange(3), np.flatnonzero(differs.any(axis=(1, 2))))

    def linearise(self, effects: Sequence[Effect]) -> Linearised:
        """Return how chance enters, along the course that the filter takes under supposed effects."""
        course = self._course(effects, None)
        return course[1]

    def gains(self, linear: Linearised, noise: float = 1.0) -> Gains:
        """Return what the filter does where chance is `noise` times as large as it was where it was linearised."""
        steps, runs, vehicles, count, _ = linear.transition.shape
        gain, whitening = np.zeros((steps, runs, vehicles, count, 3)), np.zeros((steps, runs, vehicles, 3, 3))
        log_size = np.zeros((steps, runs, vehicles))
        unseen = np.zeros((runs, vehicles, count, count))
        back = np.linalg.inv(linear.seen[0, ..., :3])
        unseen[..., :3, :3] = back @ self.camera @ _turned(back)
        for step in range(steps):
            before = linear.transition[step] @ unseen @ _turned(linear.transition[step])
            before = before + (noise * self.usual_noise) ** 2 * linear.spread[step]
            gain[step], whitening[step] = self._gain(before, linear.seen[step + 1], self.is_seen[:, step + 1])
            diagonal = np.diagonal(whitening[step], axis1=-2, axis2=-1)
            log_size[step] = np.log(np.where(diagonal > 0, diagonal, 1.0)).sum(axis=-1)
            unseen = before - gain[step] @ linear.seen[step + 1] @ before
        return Gains(gain, whitening, log_size, (noise * self.usual_noise) ** 2 * linear.shift)

    def _gain(self, before: np.ndarray, seen: np.ndarray, is_seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        spread = seen @ before @ _turned(seen) + self.camera
        whitening = np.linalg.inv(np.linalg.cholesky(spread)) * is_seen[..., None, None]
        gain: np.ndarray = before @ _turned(seen) @ _turned(whitening) @ whitening
        return gain, whitening

    def evaluate(self, effects: Sequence[Effect], gains: Gains) -> Evaluation:
        """Return the likelihood under supposed effects, by a filter whose gains are known."""
        return self._course(effects, gains)[0]

    def _course(self, effects: Sequence[Effect], gains: Gains | None) -> tuple[Evaluation, Linearised]:
        """Follow all runs by the filter; without gains, by its own, and say how it is linear."""
        driven = replace(self.driven, session=replace(self.driven.session, effects=effects))
        physics = driven.session.physics(driven.session.vehicles)
        follower = Follower(self, physics, driven)
        if gains is not None:
            for step in range(driven.session.steps):
                follower.go_on(step, gains.shift[step])
                follower.look(step, gains.gain[step], gains.whitening[step])
            nothing = np.empty(0)
            return follower.evaluation(gains.log_size), Linearised(nothing, nothing, nothing, nothing)
        seen = [follower.seen_slope(0)]
        back = np.linalg.inv(seen[0][..., :3])
        unseen = np.zeros((*back.shape[:2], len(self.moved), len(self.moved)))
        unseen[..., :3, :3] = back @ self.camera @ _turned(back)
        slopes = []
        for step in range(driven.session.steps):
            slopes.append(follower.slopes(step, unseen))
            transition, spread, shift = slopes[-1]
            before = transition @ unseen @ _turned(transition) + self.usual_noise**2 * spread
            follower.go_on(step, self.usual_noise**2 * shift)
            seen.append(follower.seen_slope(step + 1))
            gain, whitening = self._gain(before, seen[-1], self.is_seen[:, step + 1])
            unseen = before - gain @ seen[-1] @ before
            follower.look(step, gain, whitening)
        linear = Linearised(*(np.stack(one) for one in zip(*slopes, strict=True)), np.stack(seen))
        return follower.evaluation(np.zeros(())), linear

    def _apart(self, measured: np.ndarray, expected: np.ndarray) -> np.ndarray:
        apart: np.ndarray = measured - expected
        return np.concatenate([apart[..., :2], wrap_angle(apart[..., 2:])], axis=-1)


class Follower:
    """The filter on its way through R runs of V vehicles, period by period.

    Attributes:
        state: (states, R, V) what it holds for likeliest.
        active: (m, R, V) the command in force.
    """

    def __init__(self, likelihood: TrueLikelihood, physics: Physics, driven: DrivenSession) -> None:
        self.likelihood, self.physics, self.driven = likelihood, physics, driven
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
        shown = np.where(self.likelihood.is_seen[:, 0, :, None], self.likelihood.measured[:, 0], true)
        pose = shown.copy()
        for _ in range(rounds):
            pose = pose + self.likelihood._apart(shown, self.physics.seen(pose, self.progress[:, 0, None]))
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
            after[self.likelihood.moved] += shift

    def _after(self, command: np.ndarray, step: int) -> np.ndarray:
        period = Period(command, self.active, self.duration_s[:, step, None], self.progress[:, step, None])
        return advance(self.physics, self.state, period)

    def look(self, step: int, gain: np.ndarray, whitening: np.ndarray) -> None:
        """Compare what was expected with the next picture, and correct the states that chance moves."""
        shown, freedom = self.likelihood.measured[:, step + 1], self.likelihood.freedom
        nats, surprises, states = [], [], []
        for chance, _, after in self.ways:
            expected = self.physics.seen(np.moveaxis(after[:3], 0, -1), self.progress[:, step + 1, None])
            apart = np.nan_to_num(self.likelihood._apart(shown, expected))
            surprise = np.einsum("rvij,rvj->rvi", whitening, apart)
            squared = (surprise**2).sum(axis=-1)
            density, weight = self._normal(squared) if freedom is None else self._heavy_tailed(squared, freedom)
            corrected = after.copy()
            corrected[self.likelihood.moved] += np.moveaxis(np.einsum("rvij,rvj->rvi", gain, apart), -1, 0)
            nats.append(np.log(chance) + density)
            surprises.append(surprise * np.sqrt(weight)[..., None])
            states.append(corrected)
        likeliest = np.argmax(nats, axis=0)
        self.nats.append(np.logaddexp.reduce(nats, axis=0))
        self.surprises.append(np.where((likeliest == 0)[..., None], surprises[0], surprises[-1]))
        self.active = np.where(likeliest == 0, self.ways[0][1], self.ways[-1][1])
        self.state = np.where(likeliest == 0, states[0], states[-1])

    def _normal(self, squared: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the log-density of surprises of squared size (R, V), and how much each counts: few are astray."""
        share, factor = self.likelihood.astray, self.likelihood.astray_factor
        usual = np.log1p(-share) - 0.5 * squared
        astray = np.log(share) - 3.0 * np.log(factor) - 0.5 * squared / factor**2
        density = np.logaddexp(usual, astray)
        is_usual = np.exp(usual - density)
        return density, is_usual + (1.0 - is_usual) / factor**2

    def _heavy_tailed(self, squared: np.ndarray, freedom: float) -> tuple[np.ndarray, np.ndarray]:
        """Return likewise where they follow Student's t."""
        return -0.5 * (freedom + 3.0) * np.log1p(squared / freedom), (freedom + 3.0) / (freedom + squared)

    def evaluation(self, log_size: np.ndarray) -> Evaluation:
        """Return the likelihood of all that was seen."""
        nats = np.stack(self.nats) + log_size
        freedom = self.likelihood.freedom
        if freedom is not None:
            constant = gammaln((freedom + 3) / 2) - gammaln(freedom / 2) - 1.5 * np.log(freedom / 2)
            nats = nats + np.moveaxis(self.likelihood.is_seen[:, 1:], 1, 0) * constant
        surprise = np.stack(self.surprises).ravel()
        return Evaluation(nats.sum(axis=(0, 2)), surprise, log_size)

    def seen_slope(self, row: int, nudge: tuple[float, float, float] = (1.0, 1.0, 0.02)) -> np.ndarray:
        """Return how the picture of a row depends on the states that chance moves, (R, V, 3, n)."""
        ways = self.ways[:1]
        pose = np.moveaxis((ways[0][2] if row and ways else self.state)[:3], 0, -1)
        progress = self.progress[:, row, None]
        slope = np.zeros((*pose.shape[:2], 3, len(self.likelihood.moved)))
        for axis, size in enumerate(nudge):
            shifted = pose.copy()
            shifted[..., axis] += size
            apart = self.likelihood._apart(self.physics.seen(shifted, progress), self.physics.seen(pose, progress))
            slope[..., axis] = apart / size
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
        moved, physics, parts = self.likelihood.moved, self.physics, self.likelihood.parts
        runs, vehicles = self.state.shape[1:]
        nudges = np.array([0.02, *([100 * self.likelihood.nudge] * 2), self.likelihood.nudge])[: len(moved) - 2]
        first = len(nudges)
        half = first + parts * physics.noises
        columns = 1 + 2 * half
        state = np.repeat(self.state[:, None], columns, axis=1)
        noise = np.zeros((physics.substeps, physics.noises, columns, runs, vehicles))
        edges = np.linspace(0, physics.substeps, parts + 1).round().astype(int)
        for sign, start in ((1.0, 1), (-1.0, 1 + half)):
            for index, size in enumerate(nudges):
                state[moved[2 + index], start + index] += sign * size
            for part, (low, high) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
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
        shares = slope[..., first:]
        return transition, shares @ _turned(shares), np.moveaxis(shift, -1, 0)

    def _all_after(self, step: int, state: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return the moved states (R, V, n, columns) after a period of as many variants (states, columns, R, V)."""
        moved, (columns, runs, vehicles) = self.likelihood.moved, state.shape[1:]
        command = np.moveaxis(self.driven.command[:, step], -1, 0)
        duration_s, progress = (np.tile(one[:, step], columns)[:, None] for one in (self.duration_s, self.progress))
        period = Period(np.tile(command, (1, columns, 1)), np.tile(self.active, (1, columns, 1)), duration_s, progress)
        flat = state.reshape(len(state), columns * runs, vehicles)
        after = advance(self.physics, flat, period, noise.reshape(*noise.shape[:2], columns * runs, vehicles))
        by_column = after[moved].reshape(len(moved), columns, runs, vehicles)
        return np.moveaxis(by_column, (0, 1), (-2, -1))


def _turned(matrix: np.ndarray) -> np.ndarray:
    """Return matrices (..., n, m) transposed."""
    return np.swapaxes(matrix, -1, -2)
