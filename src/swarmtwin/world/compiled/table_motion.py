"""Vehicles moved by a table of displacements, compiled: `SimulatedMotion` by such a simulation, for far less time."""

import json
import math

import numpy as np

from swarmtwin.compiled import compiled
from swarmtwin.simulation.displacement_table import DisplacementTable
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.world.compiled.elementary import cos_and_sin
from swarmtwin.world.motion import Motion, check_can_be_sampled


class TableMotion(Motion):
    """W worlds of K vehicles that a bare dynamics model moves by the table of its displacements.

    Attributes:
        robot: whose vehicles they are.
        is_sampled: whether motion and camera have their random part, or are the most likely.
    """

    def __init__(
        self, simulation: Simulation, worlds: int, vehicles: int, sampled: bool | None = None, seed: int = 0
    ) -> None:
        """Put `worlds` · `vehicles` at the arena's origin; `place` puts them elsewhere.

        Args:
            simulation: what moves the vehicles: a table of displacements, and nothing that extends it.
            worlds: how many groups are side by side, W.
            vehicles: how many there are in each, K.
            sampled: whether the random part is drawn; None: not.
            seed: of what is drawn.

        Raises:
            UserError: motion is to be drawn, and it is not known how much it varies.
            ValueError: it is another kind of simulation.
        """
        if not moves_by_table(simulation):
            raise ValueError("the simulation is not a table of displacements alone")
        check_can_be_sampled(simulation, sampled)
        self.robot = simulation.robot
        self.is_sampled = bool(sampled)
        assert isinstance(simulation.dynamics, DisplacementTable)
        table = simulation.dynamics.table.cpu().numpy()
        self._table, self._points = np.ascontiguousarray(table.reshape(-1, 3)), table.shape[0]
        low, high = self.robot.command_low, self.robot.command_high
        self._low, self._per_unit = tuple(_float32(low)), tuple(_float32((self._points - 1) / (high - low)))
        noise = simulation.motion_noise
        self._spread = _float32([noise.at_rest, noise.with_motion]) if noise else np.zeros((2, 3), np.float32)
        self._usual = _float32([noise.usual_mm, noise.usual_rad]) if noise else np.ones(2, np.float32)
        self._camera = np.sqrt(noise.camera) if noise else np.zeros(3)
        self._rng = np.random.default_rng(seed)
        self._pose = np.zeros((worlds, vehicles, 3))

    def place(self, worlds: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Put vehicles down, at rest and with no past."""
        self._pose[worlds] = pose
        return self._photographed(np.array(pose, dtype=float))

    def move(self, command: np.ndarray) -> np.ndarray:
        """Step all vehicles at once."""
        shape = self._pose.shape
        drawn = self._rng.standard_normal(shape, np.float32).reshape(-1, 3) if self.is_sampled else _NOTHING
        moved = np.empty(shape)
        _move(
            *(self._table, self._points, self._low, self._per_unit, self._spread, self._usual),
            *(command.reshape(-1, command.shape[-1]), drawn, self._pose.reshape(-1, 3), moved.reshape(-1, 3)),
        )
        self._pose = moved
        return self._photographed(moved.copy())

    def reseed(self, seed: int) -> None:
        """Draw everything from now on with another seed."""
        self._rng = np.random.default_rng(seed)

    def state(self) -> dict[str, np.ndarray]:
        """Return all that the next motion depends on, for a checkpoint."""
        return {"pose": self._pose.copy(), "rng": np.array(json.dumps(self._rng.bit_generator.state))}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Continue from a `state` of the same worlds and vehicles.

        Raises:
            ValueError: it is of other ones.
        """
        if state["pose"].shape != self._pose.shape:
            raise ValueError(f"a state of poses {state['pose'].shape} does not fit {self._pose.shape}")
        self._pose = state["pose"].copy()
        self._rng.bit_generator.state = json.loads(str(state["rng"]))

    def _photographed(self, pose: np.ndarray) -> np.ndarray:
        """Add the camera's random part to poses (..., 3), in place."""
        if self.is_sampled:
            pose += self._camera * self._rng.standard_normal(pose.shape, np.float32)
            pose[..., 2] = np.arctan2(np.sin(pose[..., 2]), np.cos(pose[..., 2]))
        return pose


_NOTHING = np.empty((0, 3), np.float32)


def moves_by_table(simulation: Simulation) -> bool:
    """Say whether a simulation is a table of displacements, and nothing extends it."""
    return isinstance(simulation.dynamics, DisplacementTable) and not simulation.is_extended


def _float32(values: object) -> np.ndarray:
    return np.asarray(values, dtype=np.float32)


@compiled
def _move(table, points, low, per_unit, spread, usual, command, drawn, pose, moved, width=64):  # type: ignore[no-untyped-def]
    """Write where N vehicles at poses (N, 3) get by commands (N, m), `width` at a time; at random if there is `drawn`.

    The table holds displacements of commands on a grid, (points^m, 3), linear between; `low` and `per_unit` are tuples
    of m, whose length the compiler knows. `drawn` is (N, 3) of normal numbers, or empty; `spread` (2, 3) the variance
    of a twist at rest and its growth with the motion: `MotionNoise`.
    """
    forward, left, turn = np.zeros(width, np.float32), np.zeros(width, np.float32), np.zeros(width, np.float32)
    below, share = np.empty((len(low), width), np.int32), np.empty((len(low), width), np.float32)
    cos, sin, after_rad = np.empty(width, np.float32), np.empty(width, np.float32), np.zeros(width)
    for first in range(0, len(command), width):
        count = min(width, len(command) - first)
        for column in range(len(low)):
            for lane in range(count):
                place = (np.float32(command[first + lane, column]) - low[column]) * per_unit[column]
                place = min(max(place, np.float32(0.0)), np.float32(points - 1))
                below[column, lane] = min(np.int32(place), np.int32(points - 2))
                share[column, lane] = place - np.float32(below[column, lane])
        for lane in range(count):
            forward[lane], left[lane], turn[lane] = _between(table, points, low, below, share, lane)
        if len(drawn):
            for lane in range(count):
                varied = _varied(forward[lane], left[lane], turn[lane], spread, usual, drawn[first + lane])
                forward[lane], left[lane], turn[lane] = varied
        for lane in range(count):
            after_rad[lane] = pose[first + lane, 2]
        for lane in range(width):
            cos[lane], sin[lane] = cos_and_sin(after_rad[lane])
            after_rad[lane] += turn[lane]
            after_rad[lane] -= 2 * math.pi * math.floor((after_rad[lane] + math.pi) / (2 * math.pi))
        for lane in range(count):
            vehicle = first + lane
            moved[vehicle, 0] = pose[vehicle, 0] + cos[lane] * forward[lane] - sin[lane] * left[lane]
            moved[vehicle, 1] = pose[vehicle, 1] + sin[lane] * forward[lane] + cos[lane] * left[lane]
            moved[vehicle, 2] = after_rad[lane]


@compiled
def _between(table, points, low, below, share, lane):  # type: ignore[no-untyped-def]
    """Return the displacement of a lane's command, between those of the corners of its cell of the grid."""
    forward, left, turn = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for corner in range(1 << len(low)):
        cell, weight = np.int32(0), np.float32(1.0)
        for column in range(len(low)):
            above = np.int32((corner >> column) & 1)
            weight *= share[column, lane] if above else np.float32(1.0) - share[column, lane]
            cell = cell * np.int32(points) + below[column, lane] + above
        forward += weight * table[cell, 0]
        left += weight * table[cell, 1]
        turn += weight * table[cell, 2]
    return forward, left, turn


@compiled
def _varied(forward, left, turn, spread, usual, drawn):  # type: ignore[no-untyped-def]
    """Return a displacement with a random part added to its twist: `MotionNoise.sample`."""
    half = np.float32(0.5) * turn
    along = half / math.tan(half) if abs(half) > np.float32(1e-4) else np.float32(1.0)
    twist_forward, twist_left = along * forward + half * left, along * left - half * forward
    size2 = (twist_forward**2 + twist_left**2) / usual[0] ** 2 + (turn / usual[1]) ** 2
    twist_forward += math.sqrt(spread[0, 0] + spread[1, 0] * size2) * drawn[0]
    twist_left += math.sqrt(spread[0, 1] + spread[1, 1] * size2) * drawn[1]
    turn += math.sqrt(spread[0, 2] + spread[1, 2] * size2) * drawn[2]
    if abs(turn) > np.float32(1e-4):
        straight, aside = math.sin(turn) / turn, (np.float32(1.0) - math.cos(turn)) / turn
    else:
        straight, aside = np.float32(1.0), np.float32(0.5) * turn
    return straight * twist_forward - aside * twist_left, aside * twist_forward + straight * twist_left, turn
