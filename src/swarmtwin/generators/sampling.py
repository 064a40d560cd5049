"""Synthetic transitions: drawn from a generator, believable every one, with their lineage."""

from typing import NamedTuple

import numpy as np
import torch

from swarmtwin.errors import UserError
from swarmtwin.generators.columns import Columns
from swarmtwin.generators.generator import Generator
from swarmtwin.learning.device import one_thread
from swarmtwin.transitions import SPLITS, Transitions


class Drawn(NamedTuple):
    """Rows (N, width), all believable, and how many were drawn again because they were not."""

    rows: np.ndarray
    redrawn: int

    @property
    def redrawn_share(self) -> float:
        """The share of all drawn rows that could not be believed."""
        return self.redrawn / max(1, self.redrawn + len(self.rows))


def draw_believable(generator: Generator, count: int, seed: int, least_share: float = 0.05) -> Drawn:
    """Draw `count` rows that a recording could hold; the same seed gives the same rows.

    Args:
        generator: to draw from.
        count: how many rows.
        seed: of the drawing.
        least_share: a generator of which less can be believed has learned nothing.

    Raises:
        UserError: hardly any row is believable.
    """
    rng = torch.Generator().manual_seed(seed)
    kept: list[np.ndarray] = []
    drawn = found = 0
    with one_thread():
        while found < count:
            rows = generator.sample(max(count - found, 256), rng).cpu().numpy().astype(float)
            rows = rows[generator.columns.believable(rows)]
            kept.append(rows)
            drawn, found = drawn + max(count - found, 256), found + len(rows)
            if found < least_share * drawn:
                raise UserError(
                    f"generator {generator.config.name!r}: {drawn - found} of {drawn} transitions drawn are beyond "
                    f"what robot {generator.columns.robot.name!r} can do: train it longer, or take another generator"
                )
    return Drawn(np.concatenate(kept)[:count], drawn - found)


def synthetic_transitions(columns: Columns, rows: np.ndarray, validation: int, run_length: int = 100) -> Transitions:
    """Turn rows (N, width) into transitions, the last `validation` of them for the validation split.

    Rows have nothing to do with each other, so there are no commands before and no time (NaN), and there are no
    neighbours; a run is merely `run_length` of them.
    """
    row = columns.split(rows)
    count = len(rows)
    in_validation = np.arange(count) >= count - validation
    position = np.where(in_validation, np.arange(count) - (count - validation), np.arange(count))
    train_runs = -(-(count - validation) // run_length)
    run = position // run_length + np.where(in_validation, train_runs, 0)
    return Transitions(
        robot=columns.robot,
        arena_mm=columns.arena_mm,
        command=row.command,
        previous_command=np.full_like(row.command, np.nan),
        earlier_command=np.full_like(row.command, np.nan),
        pose=row.pose,
        displacement=row.displacement,
        neighbours=np.empty((count, 0, 3)),
        time_s=np.full(count, np.nan),
        duration_s=np.full(count, columns.robot.period_s),
        run=run,
        vehicle=np.zeros(count, dtype=int),
        split=np.where(in_validation, SPLITS.index("validation"), SPLITS.index("train")).astype(np.int8),
        runs=tuple(f"synthetic-{number + 1:05}" for number in range(int(run.max()) + 1)),
        vehicles=("synthetic",),
    )
