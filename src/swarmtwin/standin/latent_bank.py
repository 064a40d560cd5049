"""States that nobody sees a vehicle in: what the same drive leads to when it is repeated with other chances."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.spatial import cKDTree

from swarmtwin.standin.session import DrivenSession


@dataclass(frozen=True)
class LatentBank:
    """Latent states of one vehicle, sorted into cells of like context and, in each cell, into strata of like state.

    Drawing one state from each stratum of the cell averages over the hidden states with far less error than drawing
    at random.

    Attributes:
        hidden: (states, N) all states but the pose; the pose is not hidden.
        command: (m, N) that held before.
        centres: the cells' mean contexts, or None where one cell holds for all.
        strata: (cells, strata, members) indices into N.
        scale: (c,) by which contexts are divided.
    """

    hidden: np.ndarray
    command: np.ndarray
    centres: cKDTree | None
    strata: np.ndarray
    scale: np.ndarray

    @classmethod
    def sorted_from(
        cls, hidden: np.ndarray, command: np.ndarray, context: np.ndarray, draws: int, cell_size: int = 512
    ) -> Self:
        """Sort states (states, N) and previous commands (m, N) by context (N, c).

        Args:
            hidden: (states, N).
            command: (m, N).
            context: (N, c) what of the situation the states depend on.
            draws: strata in a cell, a power of two.
            cell_size: least states in a cell.
        """
        scale = context.std(axis=0) + 1e-9
        cell_count = 1 << max(int(np.log2(len(context) / cell_size)), 0) if context.shape[1] else 1
        cells = halve(context / scale, np.arange(len(context))[None], cell_count)
        centres = cKDTree((context / scale)[cells].mean(axis=1)) if cell_count > 1 else None
        features = np.concatenate([hidden, command]).T
        strata = halve(features / (features.std(axis=0) + 1e-9), cells, draws)
        return cls(hidden, command, centres, strata.reshape(cell_count, draws, -1), scale)

    def draw(self, context: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return for rows with contexts (rows, c) indices (rows, draws) of states, one from each stratum."""
        row_count, (_, stratum_count, members) = len(context), self.strata.shape
        cell = np.zeros(row_count, int) if self.centres is None else self.centres.query(context / self.scale)[1]
        member = rng.integers(members, size=(row_count, stratum_count))
        return self.strata[cell[:, None], np.arange(stratum_count), member]


def halve(features: np.ndarray, groups: np.ndarray, parts: int) -> np.ndarray:
    """Split each group of indices (g, n) into `parts` of like features, halving along the widest feature each time.

    Args:
        features: (N, d), comparable in scale.
        groups: (g, n) indices into N; what does not divide evenly is left out.
        parts: a power of two.

    Returns:
        (g · parts, n // parts) indices into N.
    """
    while parts > 1:
        even = groups[:, : groups.shape[1] // parts * parts]
        values = features[even]
        widest = np.argmax(values.std(axis=1), axis=1)
        along = np.take_along_axis(values, widest[:, None, None], axis=2)[..., 0]
        groups = np.take_along_axis(even, np.argsort(along, axis=1), axis=1)
        groups = groups.reshape(2 * len(groups), -1)
        parts //= 2
    return groups


def contexts(driven: DrivenSession, vehicle: int) -> np.ndarray:
    """Return what of each row's situation its hidden state may depend on, (R · T, c).

    The pose where the robot remembers places, as `place_context` gives it, the session's time where an effect ages, the
    command where the operator chooses it in view of the one before.
    """
    session = driven.session
    columns = []
    if session.physics(session.vehicles).memory_of_place:
        pose = driven.state[:3, :, :-1, vehicle].reshape(3, -1)
        columns += list(place_context(pose, pose[1].std()))
    if session.conditions.ages:
        columns.append(np.broadcast_to(driven.time_s[:, :-1], driven.command.shape[:2]).ravel())
    if session.command_mode in ("held", "waypoints", "smooth") or session.drive is not None:
        columns += list(driven.command[:, :, vehicle].reshape(-1, driven.command.shape[-1]).T)
    return np.stack(columns, axis=1) if columns else np.empty((driven.command[:, :, 0, 0].size, 0))


def place_context(pose: np.ndarray, spread_mm: float) -> np.ndarray:
    """Return poses (3, N) as context (4, N), the heading as a point on a circle of 0.3 of the places' spread."""
    x_mm, y_mm, heading_rad = pose
    arm_mm = 0.3 * spread_mm
    return np.stack([x_mm, y_mm, arm_mm * np.cos(heading_rad), arm_mm * np.sin(heading_rad)])
