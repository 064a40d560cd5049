"""The true likelihood of a stand-in's session under supposed effects: its own equations, and a Kalman filter on them.

Nothing is told of what only the stand-in saw: the filter is given what a laboratory records. Hidden states are carried
from the run's beginning by the equations themselves under the supposed effects; those that chance moves (the pose, and
the velocities of what swims) are estimated from one picture to the next, so that the camera's noise at both ends of a
step, and the motion's between them, weigh as they truly do.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np
from scipy.optimize import minimize

from swarmtwin.recordings.recording import Recording
from swarmtwin.standin.effect import Effect
from swarmtwin.standin.physics import Period, Physics, advance
from swarmtwin.standin.session import DrivenSession
from swarmtwin.studies.hidden_effects.baselines.oracle_follower import (
    Chance,
    Evaluation,
    Follower,
    Pictures,
    apart,
    turned,
)
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


@dataclass(frozen=True)
class TrueLikelihood:
    """The likelihood of one recorded session: who drove, when and by which commands is known, effects are supposed.

    Command loss is averaged over: each period is expected both ways, and the likelier one goes on. Where chance is
    heavy-tailed, surprises follow Student's t. What the first picture of a run says of the place it began at is not
    counted: the likelihood is that of all further pictures given the first.

    Attributes:
        driven: what the stand-in yielded. Its states and effects are looked at for the size of the camera's noise, its
            poses for where runs began whose first picture is missing, and for where chance moves states.
        measured: (R, T + 1, V, 3) poses as recorded, NaN where there is none.
        chance: how surprises are distributed.
    """

    driven: DrivenSession
    measured: np.ndarray
    chance: Chance = field(default_factory=Chance)

    @classmethod
    def of(cls, driven: DrivenSession, recording: Recording) -> Self:
        """Take a session and its recording, which may be rounded or blurred."""
        return cls(driven, recorded_poses(driven, recording))

    def with_tails_of(self, twin: Self, tries: int = 40) -> Self:
        """Return it with the tails of a session in which nothing hides, where the stand-in's chance has heavy ones.

        Sums of Student's t are none themselves: its degrees of freedom, and the motion's noise that goes with them, are
        those under which the twin is likeliest.
        """
        if self.driven.session.conditions.character.motion_freedom is None:
            return self
        linear = twin.linearise(())

        def chance(logs: np.ndarray) -> Chance:
            return replace(self.chance, freedom=float(np.exp(logs[0])), usual_noise=float(np.exp(logs[1])))

        def cost(logs: np.ndarray) -> float:
            supposed = replace(twin, chance=chance(logs))
            return -float(supposed.evaluate((), supposed.gains(linear)).nats.sum())

        options = {"maxfev": tries, "initial_simplex": np.log([[3.2, 1.15], [4.5, 1.15], [3.2, 1.4]])}
        return replace(
            self, chance=chance(minimize(cost, np.log([3.2, 1.15]), method="Nelder-Mead", options=options).x)
        )

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
        own, recorded = (np.nanmean((apart(pose, true) / usual) ** 2) for pose in (self.driven.pose, self.measured))
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
        unseen[..., :3, :3] = back @ self.camera @ turned(back)
        for step in range(steps):
            before = linear.transition[step] @ unseen @ turned(linear.transition[step])
            before = before + (noise * self.chance.usual_noise) ** 2 * linear.spread[step]
            gain[step], whitening[step] = self._gain(before, linear.seen[step + 1], self.is_seen[:, step + 1])
            diagonal = np.diagonal(whitening[step], axis1=-2, axis2=-1)
            log_size[step] = np.log(np.where(diagonal > 0, diagonal, 1.0)).sum(axis=-1)
            unseen = before - gain[step] @ linear.seen[step + 1] @ before
        return Gains(gain, whitening, log_size, (noise * self.chance.usual_noise) ** 2 * linear.shift)

    def _gain(self, before: np.ndarray, seen: np.ndarray, is_seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        spread = seen @ before @ turned(seen) + self.camera
        whitening = np.linalg.inv(np.linalg.cholesky(spread)) * is_seen[..., None, None]
        gain: np.ndarray = before @ turned(seen) @ turned(whitening) @ whitening
        return gain, whitening

    def evaluate(self, effects: Sequence[Effect], gains: Gains) -> Evaluation:
        """Return the likelihood under supposed effects, by a filter whose gains are known."""
        return self._course(effects, gains)[0]

    def _course(self, effects: Sequence[Effect], gains: Gains | None) -> tuple[Evaluation, Linearised]:
        """Follow all runs by the filter; without gains, by its own, and say how it is linear."""
        driven = replace(self.driven, session=replace(self.driven.session, effects=effects))
        physics = driven.session.physics(driven.session.vehicles)
        follower = Follower(physics, driven, Pictures(self.measured, self.is_seen), self.moved, self.chance)
        if gains is not None:
            for step in range(driven.session.steps):
                follower.go_on(step, gains.shift[step])
                follower.look(step, gains.gain[step], gains.whitening[step])
            nothing = np.empty(0)
            return follower.evaluation(gains.log_size), Linearised(nothing, nothing, nothing, nothing)
        seen = [follower.seen_slope(0)]
        back = np.linalg.inv(seen[0][..., :3])
        unseen = np.zeros((*back.shape[:2], len(self.moved), len(self.moved)))
        unseen[..., :3, :3] = back @ self.camera @ turned(back)
        slopes = []
        for step in range(driven.session.steps):
            slopes.append(follower.slopes(step, unseen))
            transition, spread, shift = slopes[-1]
            before = transition @ unseen @ turned(transition) + self.chance.usual_noise**2 * spread
            follower.go_on(step, self.chance.usual_noise**2 * shift)
            seen.append(follower.seen_slope(step + 1))
            gain, whitening = self._gain(before, seen[-1], self.is_seen[:, step + 1])
            unseen = before - gain @ seen[-1] @ before
            follower.look(step, gain, whitening)
        transition, spread, shift = (np.stack(one) for one in zip(*slopes, strict=True))
        linear = Linearised(transition, spread, shift, np.stack(seen))
        return follower.evaluation(np.zeros(())), linear
