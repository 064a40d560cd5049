"""Exact mean displacements of driven rows, given what a model may know: for floors and model errors, nothing else."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from swarmtwin.geometry import compose, displacement_between
from swarmtwin.standin.latent_bank import LatentBank, contexts, place_context
from swarmtwin.standin.physics import Period, Physics, advance, others_in_run
from swarmtwin.standin.session import DrivenSession, drive_session
from swarmtwin.standin.streams import Streams


@dataclass(frozen=True)
class DrivenRows:
    """N driven rows of one vehicle, as the physics takes them; ... is (N, 1).

    Attributes:
        state: (states, ...) true states.
        command: (m, ...) as sent.
        active_command: (m, ...) that held before.
        duration_s: (...) true lengths of the periods.
        progress: (...) share of the session that has passed.
        others: (2, 2, others, ...) x and y of the neighbours at start and end.
    """

    state: np.ndarray
    command: np.ndarray
    active_command: np.ndarray
    duration_s: np.ndarray
    progress: np.ndarray
    others: np.ndarray

    @classmethod
    def of(cls, driven: DrivenSession, vehicle: int) -> "DrivenRows":
        """Take the rows of one vehicle, in order of run and time."""
        others = np.stack([others_in_run(coordinate)[..., vehicle] for coordinate in driven.state[:2]])
        return cls(
            _flat(driven.state[:, :, :-1, vehicle]),
            _flat(np.moveaxis(driven.command[:, :, vehicle], -1, 0)),
            _flat(driven.active_command[:, :, :-1, vehicle]),
            _flat(np.diff(driven.time_s)),
            _flat(driven.session.progress(driven.time_s[:, :-1])),
            _flat(np.stack([others[..., :-1], others[..., 1:]])),
        )

    def at(self, rows: np.ndarray | slice) -> "DrivenRows":
        """Return some of the rows, in single precision."""
        return DrivenRows(*(value[..., rows, :].astype(np.float32) for value in vars(self).values()))

    def chunks(self, draws: int) -> Iterator[tuple[slice, "DrivenRows"]]:
        """Cut the rows into parts that, `draws` times each, fit the processor's cache."""
        size = max(16_384 // draws, 1)
        for first in range(0, self.duration_s.shape[0], size):
            part = slice(first, first + size)
            yield part, self.at(part)

    def period(self, command: np.ndarray, previous_command: np.ndarray) -> Period:
        """Return the rows' periods with other commands in them."""
        return Period(command, previous_command, self.duration_s, self.progress, self.others)


def _flat(values: np.ndarray) -> np.ndarray:
    """Turn (..., R, T) into (..., R · T, 1)."""
    return values.reshape(*values.shape[:-2], values.shape[-2] * values.shape[-1], 1)


def mean_given_state(driven: DrivenSession) -> np.ndarray:
    """Return the expected measured displacement (R, T, V, 3) of each row given its true physical state.

    The expectation is over what is yet to happen: the motion's noise, the loss of the command, the camera's noise. The
    length of the period counts as known, since the recording shows it. No model sees the state: of what a model may
    know, see `mean_given_commands`.
    """
    session = driven.session
    rng = Streams(session.seed, "truth").of("everything")
    mean = np.empty((*driven.command.shape[:3], 3), np.float32)
    for index, vehicle in enumerate(session.vehicles):
        physics = session.physics([vehicle], np.float32)
        expected = []
        for _, rows in DrivenRows.of(driven, index).chunks(physics.noise_draws):
            draws = (rows.state.shape[1], physics.noise_draws)
            state = np.broadcast_to(rows.state, (len(rows.state), *draws))
            previous_command = np.broadcast_to(rows.active_command, (len(rows.active_command), *draws))
            expected.append(_expected(physics, rows, state, previous_command, rng))
        mean[:, :, index] = np.concatenate(expected).reshape(*mean.shape[:2], 3)
    return mean


def means_given_commands(driven: DrivenSession, most_before: int = 2) -> list[np.ndarray]:
    """Return the expected measured displacements of each row given its situation and the commands before.

    A situation is the command, at this time and place and under the effects that are on. Beyond the expectation given
    the state it is one over the hidden states, that is over the motion and the commands before those given. They are
    drawn from a bank of what the same drive leads to when it is repeated with other chances, for a robot that remembers
    places from those of like pose, and brought up to the row by the commands given.

    Returns:
        `most_before` + 1 arrays (R, T, V, 3): given no command before, given the previous one, given the one before it
        as well, and so on. Where the run is younger than that the vehicle came from rest.
    """
    session = driven.session
    repeats = -(-Physics.bank_rows // (session.runs * session.steps))
    repeated = drive_session(replace(session, repeats=repeats), "bank")
    streams = Streams(session.seed, "truth")
    means = np.empty((most_before + 1, *driven.command.shape[:3], 3), np.float32)
    for index, vehicle in enumerate(session.vehicles):
        physics = session.physics([vehicle], np.float32)
        bank_rows = DrivenRows.of(repeated, index)
        bank = LatentBank.sorted_from(
            bank_rows.state[3:, :, 0].astype(np.float32),
            bank_rows.active_command[:, :, 0].astype(np.float32),
            contexts(repeated, index),
            physics.latent_draws,
        )
        for before in range(most_before + 1):
            rng = streams.of("draws" if before == 0 else f"draws {before} commands before")
            history = _History(physics, driven, index, bank, before)
            means[before, :, :, index] = history.mean(rng).reshape(*means.shape[1:3], 3)
    return list(means)


def mean_given_situation(driven: DrivenSession) -> np.ndarray:
    """Return the expected measured displacement (R, T, V, 3) of each row given its situation alone."""
    return means_given_commands(driven, 0)[0]


class _History:
    """One vehicle's rows, as someone knows them who has seen the commands of the `before` periods before each."""

    def __init__(self, physics: Physics, driven: DrivenSession, vehicle: int, bank: LatentBank, before: int) -> None:
        self.physics, self.bank, self.before = physics, bank, before
        self.rows = DrivenRows.of(driven, vehicle)
        self.context = contexts(driven, vehicle)
        self.step = np.tile(np.arange(driven.session.steps), len(driven.command))
        self.period_s = driven.session.robot.period_s

    def mean(self, rng: np.random.Generator) -> np.ndarray:
        """Return the expected displacements (N, 3)."""
        physics = self.physics
        expected = []
        if not self.before:
            drawn = self.bank.draw(self.context, rng)
        for part, rows in self.rows.chunks(physics.latent_draws):
            if self.before:
                hidden, active = self._brought_up(np.arange(self.step.size)[part], rows.state[:3, :, 0], rng)
            else:
                hidden, active = self.bank.hidden[:, drawn[part]], self.bank.command[:, drawn[part]]
            pose = np.broadcast_to(rows.state[:3], (3, *hidden.shape[1:]))
            expected.append(_expected(physics, rows, np.concatenate([pose, hidden]), active, rng))
        return np.concatenate(expected)

    def _brought_up(
        self, index: np.ndarray, pose: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return hidden states (states, n, draws) and commands in force (m, n, draws) at rows `index`.

        Where the vehicle was when the commands given began is not known. For a robot that remembers places it is taken
        to be where it must have come from to be at `pose` (3, n) now, going as far as vehicles go on average, of eight.
        The commands given leave half as much open as there is without them, so half as many draws tell the mean.
        """
        start, draws = pose, self.physics.latent_draws
        if self.physics.memory_of_place:
            state, _ = self._replayed(index, start, draws // 8, rng)
            moved = displacement_between(start.T[:, None], np.moveaxis(state[:3], 0, -1)).mean(axis=1)
            start = self._inside(_started_from(pose.T, moved).T)
        state, active = self._replayed(index, start, 2, rng)
        return state[3:], active

    def _replayed(
        self, index: np.ndarray, start: np.ndarray, every: int, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return states and commands in force at rows `index` after the periods before, begun at poses (3, n).

        Only one in `every` of the bank's strata is drawn from.
        """
        physics = self.physics
        age = self.step[index]
        first = np.maximum(index - self.before, 0)
        context = self.context[first].copy()
        if physics.memory_of_place:
            context[:, :4] = place_context(start, self.rows.state[1].std()).T
        drawn = self.bank.draw(context, rng)[:, ::every]
        fresh = (age < self.before)[:, None]
        state = physics.at_rest(np.broadcast_to(start[:, :, None], (3, *drawn.shape)).copy())
        resting = np.reshape(physics.resting_command, (-1, 1, 1)).astype(np.float32)
        state[3:] = np.where(fresh, state[3:], self.bank.hidden[:, drawn])
        active = np.where(fresh, resting, self.bank.command[:, drawn])
        for periods in range(self.before, 0, -1):
            rows = self.rows.at(np.maximum(index - periods, 0))
            rows = replace(rows, duration_s=np.full_like(rows.duration_s, self.period_s))
            lost = rng.random(active.shape[1:], np.float32) < physics.conditions.loss_probability
            arriving = np.where(lost, active, rows.command)
            noise = rng.standard_normal((physics.substeps, physics.noises, *active.shape[1:]), np.float32)
            driven = (age >= periods)[:, None]
            state = np.where(driven, advance(physics, state, rows.period(arriving, active), noise), state)
            active = np.where(driven, arriving, active)
        return state, active

    def _inside(self, pose: np.ndarray) -> np.ndarray:
        """Keep places (3, n) where the vehicle has been."""
        seen_mm = self.rows.state[:2, :, 0]
        position_mm = np.clip(pose[:2], seen_mm.min(axis=1, keepdims=True), seen_mm.max(axis=1, keepdims=True))
        return np.concatenate([position_mm, pose[2:]]).astype(np.float32)


def _started_from(pose: np.ndarray, displacement: np.ndarray) -> np.ndarray:
    """Return the poses (n, 3) from which displacements (n, 3) lead to `pose` (n, 3)."""
    origin = np.zeros_like(pose)
    return compose(pose, displacement_between(displacement, origin))


def _expected(
    physics: Physics, rows: DrivenRows, state: np.ndarray, previous_command: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Return the expected displacements (N, 3) from states (states, N, draws), averaged over the draws.

    Each draw moves with its own noise. Draws come in pairs, one with the noise and one with its opposite, so that only
    what does not cancel is left: the little that noise changes of the mean.
    A lost command is averaged over exactly, by moving both ways. The camera's error of the heading at the start turns
    the measured displacement to and fro, which shortens its mean by exp(−σ²/2).
    """
    conditions = physics.conditions
    loss = conditions.loss_probability
    command = np.broadcast_to(rows.command, previous_command.shape)
    ways: list[tuple[float, np.ndarray]] = [(1.0 - loss, command)]
    if loss:
        ways.append((loss, previous_command))
    half = rng.standard_normal((physics.substeps, physics.noises, 1, state.shape[-1] // 2), np.float32)
    noise = np.stack([half, -half], axis=-1).reshape(*half.shape[:-1], -1)
    before = conditions.seen(np.moveaxis(state[:3], 0, -1))
    mean: Any = 0.0
    for weight, held in ways:
        after = advance(physics, state, rows.period(held, previous_command), noise)
        seen_after = conditions.seen(np.moveaxis(after[:3], 0, -1))
        mean = mean + weight * displacement_between(before, seen_after).mean(axis=1)
    shortened = np.exp(-(physics.heading_noise_rad**2) / 2)
    return mean * np.array([shortened, shortened, 1.0], np.float32)
