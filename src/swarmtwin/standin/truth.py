"""The answer book: the exact mean displacement of every recorded row, for floors and model errors, and nothing else."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from swarmtwin.errors import UserError
from swarmtwin.geometry import displacement_between
from swarmtwin.robot import DISPLACEMENT_COLUMNS
from swarmtwin.standin.effect import Rng
from swarmtwin.standin.latent import LatentBank, contexts
from swarmtwin.standin.physics import Period, Physics, advance, others_in_run
from swarmtwin.standin.session import Footage, film
from swarmtwin.standin.streams import Streams

TRUTH_FILE = "truth.parquet"
LEVELS = ("situation", "everything")
TRUTH_COLUMNS = tuple(f"{level}_{column}" for level in LEVELS for column in DISPLACEMENT_COLUMNS)

BANK_ROWS = 131_072
CHUNK = 16_384
NOISE_DRAWS = 32


@dataclass(frozen=True)
class Rows:
    """N recorded rows of one vehicle, as the physics takes them; ... is (N, 1).

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
    def of(cls, footage: Footage, vehicle: int) -> "Rows":
        """Take the rows of one vehicle, in order of run and time."""
        others = np.stack([others_in_run(coordinate)[..., vehicle] for coordinate in footage.state[:2]])
        return cls(
            _flat(footage.state[:, :, :-1, vehicle]),
            _flat(np.moveaxis(footage.command[:, :, vehicle], -1, 0)),
            _flat(footage.active_command[:, :, :-1, vehicle]),
            _flat(np.diff(footage.time_s)),
            _flat(footage.session.progress(footage.time_s[:, :-1])),
            _flat(np.stack([others[..., :-1], others[..., 1:]])),
        )

    def chunks(self, size: int) -> Iterator[tuple[slice, "Rows"]]:
        """Cut the rows into parts, in single precision, that fit the processor's cache."""
        for first in range(0, self.duration_s.shape[0], size):
            part = slice(first, first + size)
            yield part, Rows(*(value[..., part, :].astype(np.float32) for value in vars(self).values()))

    def period(self, command: np.ndarray, previous_command: np.ndarray) -> Period:
        """Return the rows' periods with other commands in them."""
        return Period(command, previous_command, self.duration_s, self.progress, self.others)


def _flat(values: np.ndarray) -> np.ndarray:
    """Turn (..., R, T) into (..., R · T, 1)."""
    return values.reshape(*values.shape[:-2], values.shape[-2] * values.shape[-1], 1)


def expected_given_everything(footage: Footage) -> np.ndarray:
    """Return the expected measured displacement (R, T, V, 3) of each row given its true physical state.

    The expectation is over what is yet to happen: the motion's noise, the loss of the command, the camera's noise. The
    length of the period counts as known, since the recording shows it.
    """
    session = footage.session
    rng = Streams(session.seed, "truth").of("everything")
    mean = np.empty((*footage.command.shape[:3], 3), np.float32)
    for index, vehicle in enumerate(session.vehicles):
        physics = session.physics([vehicle], np.float32)
        expected = []
        for _, rows in Rows.of(footage, index).chunks(CHUNK // NOISE_DRAWS):
            draws = (rows.state.shape[1], NOISE_DRAWS)
            state = np.broadcast_to(rows.state, (len(rows.state), *draws))
            previous_command = np.broadcast_to(rows.active_command, (len(rows.active_command), *draws))
            expected.append(_expected(physics, rows, state, previous_command, rng))
        mean[:, :, index] = np.concatenate(expected).reshape(*mean.shape[:2], 3)
    return mean


def expected_given_situation(footage: Footage) -> np.ndarray:
    """Return the expected measured displacement (R, T, V, 3) of each row given its situation.

    That is the command, at this time and place and under the effects that are on. Beyond the expectation above it is
    one over the hidden state, that is over the motion and the commands before: drawn from a bank of what the same drive
    leads to when it is repeated with other chances, for a robot that remembers places from those of like pose.
    """
    session = footage.session
    repeats = -(-BANK_ROWS // (session.runs * session.steps))
    bank_footage = film(replace(session, repeats=repeats), "bank")
    rng = Streams(session.seed, "truth").of("draws")
    mean = np.empty((*footage.command.shape[:3], 3), np.float32)
    for index, vehicle in enumerate(session.vehicles):
        physics = session.physics([vehicle], np.float32)
        bank_rows = Rows.of(bank_footage, index)
        bank = LatentBank.sorted_from(
            bank_rows.state[3:, :, 0].astype(np.float32),
            bank_rows.active_command[:, :, 0].astype(np.float32),
            contexts(bank_footage, index),
            physics.latent_draws,
        )
        rows = Rows.of(footage, index)
        drawn = bank.draw(contexts(footage, index), rng)
        expected = []
        for part, some in rows.chunks(CHUNK // physics.latent_draws):
            hidden = bank.hidden[:, drawn[part]]
            pose = np.broadcast_to(some.state[:3], (3, *hidden.shape[1:]))
            state = np.concatenate([pose, hidden])
            expected.append(_expected(physics, some, state, bank.command[:, drawn[part]], rng))
        mean[:, :, index] = np.concatenate(expected).reshape(*mean.shape[:2], 3)
    return mean


def _expected(physics: Physics, rows: Rows, state: np.ndarray, previous_command: np.ndarray, rng: Rng) -> np.ndarray:
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


def answer_book(footage: Footage, run_names: Sequence[str]) -> pd.DataFrame:
    """Return the answers as a table, one row for each row of the recording that has a command.

    Columns: run, vehicle, time_s, then `TRUTH_COLUMNS` in mm and rad. R · V · T rows, in order of run, vehicle, time.
    """
    run_count, step_count, vehicle_count = footage.command.shape[:3]
    expected = np.concatenate([expected_given_situation(footage), expected_given_everything(footage)], axis=-1)
    answers = np.moveaxis(expected, 2, 1).reshape(-1, len(TRUTH_COLUMNS))
    index = pd.MultiIndex.from_product([run_names, footage.session.vehicles, range(step_count)])
    time_s = np.broadcast_to(footage.time_s[:, None, :-1], (run_count, vehicle_count, step_count))
    table = pd.DataFrame(
        {"run": index.get_level_values(0), "vehicle": index.get_level_values(1), "time_s": time_s.ravel()}
    )
    return table.join(pd.DataFrame(answers, columns=list(TRUTH_COLUMNS)))


def write_truth(folder: Path, table: pd.DataFrame) -> None:
    """Write an answer book into a recording's folder."""
    table.to_parquet(folder / TRUTH_FILE, index=False)


def read_truth(folder: Path) -> pd.DataFrame:
    """Read a stand-in recording's answer book: columns run, vehicle, time_s and `TRUTH_COLUMNS`, in mm and rad.

    Raises:
        UserError: there is none, since the recording is of a real robot, or it is damaged.
    """
    path = Path(folder) / TRUTH_FILE
    if not path.exists():
        raise UserError(
            f"{path} is missing: only recordings of stand-ins made by `swarmtwin record` have an answer book"
        )
    columns = ["run", "vehicle", "time_s", *TRUTH_COLUMNS]
    try:
        return pd.read_parquet(path, columns=columns)
    except (pa.ArrowException, OSError, ValueError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise UserError(
            f"{path} is damaged ({reason}): copy it again, or record again with the same options and seed"
        ) from None
