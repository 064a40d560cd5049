"""Exact mean displacements of driven rows, given what a model may know: for floors and model errors, nothing else."""

from dataclasses import replace
from typing import Any

import numpy as np

from swarmtwin.geometry import displacement_between
from swarmtwin.standin.driven_rows import DrivenRows
from swarmtwin.standin.latent_bank import LatentBank, contexts
from swarmtwin.standin.latent_history import LatentHistory
from swarmtwin.standin.physics import Physics, advance
from swarmtwin.standin.session import DrivenSession, drive_session
from swarmtwin.standin.streams import Streams


def mean_given_state(driven: DrivenSession) -> np.ndarray:
    """Return the expected measured displacement (R, T, V, 3) of each row given its true physical state.

    The expectation is over what is yet to happen: the motion's noise, the loss of the command, the camera's noise. The
    length of the period counts as known, since the recording shows it. No model sees the state: of what a model may
    know, see `means_given_commands`.
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
            parts = LatentHistory(physics, driven, index, bank, before).parts(rng)
            expected = [_expected(physics, rows, state, active, rng) for rows, state, active in parts]
            means[before, :, :, index] = np.concatenate(expected).reshape(*means.shape[1:3], 3)
    return list(means)


def mean_given_situation(driven: DrivenSession) -> np.ndarray:
    """Return the expected measured displacement (R, T, V, 3) of each row given its situation alone."""
    return means_given_commands(driven, 0)[0]


def _expected(
    physics: Physics, rows: DrivenRows, state: np.ndarray, previous_command: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Return the expected displacements (N, 3) from states (states, N, draws), averaged over the draws.

    Each draw moves with its own noise. Draws come in pairs, one with the noise and one with its opposite, so that only
    what does not cancel is left: the little that noise changes of the mean.
    A lost command is averaged over exactly, by moving both ways: each is as probable whatever was lost before, also
    where losses come in bursts. The camera's error of the heading at the start turns the measured displacement to and
    fro, which shortens its mean by exp(−σ²/2).
    """
    conditions = physics.conditions
    loss = conditions.loss_probability
    command = np.broadcast_to(rows.command, previous_command.shape)
    ways: list[tuple[float, np.ndarray]] = [(1.0 - loss, command)]
    if loss:
        ways.append((loss, previous_command))
    half = rng.standard_normal((physics.substeps, physics.noises, 1, state.shape[-1] // 2), np.float32)
    noise = np.stack([half, -half], axis=-1).reshape(*half.shape[:-1], -1)
    before = physics.seen(np.moveaxis(state[:3], 0, -1), rows.progress)
    mean: Any = 0.0
    for weight, held in ways:
        after = advance(physics, state, rows.period(held, previous_command), noise)
        seen_after = physics.seen(np.moveaxis(after[:3], 0, -1), rows.progress_after)
        mean = mean + weight * displacement_between(before, seen_after).mean(axis=1)
    shortened = np.exp(-(physics.heading_noise_rad**2) / 2)
    return mean * np.array([shortened, shortened, 1.0], np.float32)
