"""Synthetic transitions: drawn from a generator, believable every one, with their lineage."""

from typing import NamedTuple

import numpy as np
import torch

from swarmtwin.errors import UserError
from swarmtwin.generators.base import Generator
from swarmtwin.generators.columns import Columns
from swarmtwin.robot import Robot
from swarmtwin.trainer import one_thread
from swarmtwin.transitions import SPLITS, Transitions

VEHICLE = "synthetic"
RUN_LENGTH = 100
LEAST_BELIEVABLE = 0.05


class Drawn(NamedTuple):
    """Rows (N, width), all believable, and how many were drawn again because they were not."""

    rows: np.ndarray
    redrawn: int

    @property
    def redrawn_share(self) -> float:
        """The share of all drawn rows that could not be believed."""
        return self.redrawn / max(1, self.redrawn + len(self.rows))


def draw_believable(generator: Generator, count: int, seed: int) -> Drawn:
    """Draw `count` rows that a recording could hold; the same seed gives the same rows.

    Raises:
        UserError: hardly any row is believable.
    """
    source = torch.Generator().manual_seed(seed)
    kept: list[np.ndarray] = []
    drawn = found = 0
    with one_thread():
        while found < count:
            rows = generator.draw(max(count - found, 256), source).numpy().astype(float)
            rows = rows[generator.columns.believable(rows)]
            kept.append(rows)
            drawn, found = drawn + max(count - found, 256), found + len(rows)
            if found < LEAST_BELIEVABLE * drawn:
                raise UserError(
                    f"generator {generator.config.name!r}: {drawn - found} of {drawn} transitions drawn are beyond "
                    f"what robot {generator.robot.name!r} can do: train it longer, or take another generator"
                )
    return Drawn(np.concatenate(kept)[:count], drawn - found)


def synthetic_transitions(robot: Robot, rows: np.ndarray, validation: int) -> Transitions:
    """Turn rows (N, width) into transitions, the last `validation` of them for the validation split.

    Rows have nothing to do with each other, so there are no commands before and no time (NaN), and there are no
    neighbours; a run is merely a hundred of them.
    """
    row = Columns.of(robot).split(rows)
    count = len(rows)
    in_validation = np.arange(count) >= count - validation
    position = np.where(in_validation, np.arange(count) - (count - validation), np.arange(count))
    train_runs = -(-(count - validation) // RUN_LENGTH)
    run = position // RUN_LENGTH + np.where(in_validation, train_runs, 0)
    return Transitions(
        robot=robot,
        command=row.command,
        previous_command=np.full_like(row.command, np.nan),
        earlier_command=np.full_like(row.command, np.nan),
        pose=row.pose,
        displacement=row.displacement,
        neighbours=np.empty((count, 0, 3)),
        time_s=np.full(count, np.nan),
        duration_s=np.full(count, robot.period_s),
        run=run,
        vehicle=np.zeros(count, dtype=int),
        split=np.where(in_validation, SPLITS.index("validation"), SPLITS.index("train")).astype(np.int8),
        runs=tuple(f"synthetic-{number + 1:05}" for number in range(int(run.max()) + 1)),
        vehicles=(VEHICLE,),
    )
