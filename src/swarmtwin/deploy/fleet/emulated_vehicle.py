"""One stand-in vehicle that moves in real time, among others and within walls."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from swarmtwin.robot import Robot
from swarmtwin.standin.effect import Effect
from swarmtwin.standin.physics import Period, advance
from swarmtwin.standin.session import StandInSession
from swarmtwin.standin.streams import Streams


class EmulatedVehicle:
    """The physics that `record` drives, one time step at a time.

    Attributes:
        step_s: length of a time step, that of the stand-in.
        conditions: the effects that are switched on.
        contact_mm: two vehicles' centres cannot be nearer: they push each other, each by half of what is missing.
        wall_mm: so far outside of the arena a wall stops the vehicle's centre.
        obstacles: (O, 3) x_mm, y_mm, radius_mm of what pushes it out, taken as round, wherever it drives in.
    """

    def __init__(
        self,
        robot: Robot,
        vehicle: str,
        effects: Sequence[Effect],
        seed: int,
        pose: Sequence[float],
        session_s: float,
        wall_mm: float,
        obstacles: Sequence[Sequence[float]] = (),
    ) -> None:
        session = StandInSession(robot, (vehicle,), 1, 1, seed, effects)
        self.conditions = session.conditions
        self._physics = session.physics((vehicle,))
        self.step_s = robot.period_s / self._physics.substeps
        self._physics.substeps = 1  # type: ignore[misc]  # of this object alone: a period of one step
        self.contact_mm = max(robot.vehicle_size_mm)
        self.wall_mm = wall_mm
        self.obstacles = np.array(obstacles, float).reshape(-1, 3)
        self._session_s = session_s
        self._arena = robot.arena_mm
        self._rng = Streams(seed, f"fleet/{vehicle}").of("motion")
        self.place(pose)

    @property
    def pose(self) -> np.ndarray:
        """The true pose (3,), its heading not wrapped."""
        return self._state[:3, 0, 0]

    def place(self, pose: Sequence[float]) -> None:
        """Put it somewhere, where it stands."""
        self._state = self._physics.at_rest(np.array(pose, float).reshape(3, 1, 1))

    def step(self, command: np.ndarray, elapsed_s: float, others_mm: np.ndarray) -> None:
        """Let one time step pass.

        Args:
            command: (m,) that the actuators are told.
            elapsed_s: since the session began.
            others_mm: (n, 2) where the other vehicles are.
        """
        given = command.reshape(-1, 1, 1)
        progress = np.full((1, 1), min(elapsed_s / self._session_s, 1.0))
        others = np.broadcast_to(others_mm.T.reshape(2, -1, 1, 1), (2, 2, len(others_mm), 1, 1))
        period = Period(given, given, self.step_s, progress, others)
        noise = self._rng.standard_normal((1, self._physics.noises, 1, 1), np.float32)
        self._last_step = self._state, period, noise, others_mm
        self._move(self._state, period, noise, others_mm)

    def cut(self, duration_s: float, shortest_s: float = 5e-4) -> None:
        """Let the last time step have been shorter, since a command has come within it.

        Its noise is shortened in proportion, so that the vehicle is where it was on its way.
        """
        state, period, noise, others_mm = self._last_step
        duration_s = max(duration_s, shortest_s)
        scaled = noise * np.float32(np.sqrt(duration_s / self.step_s))
        self._move(state, replace(period, duration_s=duration_s), scaled, others_mm)

    def _move(self, state: np.ndarray, period: Period, noise: np.ndarray, others_mm: np.ndarray) -> None:
        self._state = advance(self._physics, state, period, noise)
        if len(others_mm):
            self._push(others_mm)
        for x_mm, y_mm, radius_mm in self.obstacles:
            away_mm = self._state[:2, 0, 0] - (x_mm, y_mm)
            distance_mm = max(float(np.hypot(*away_mm)), 1e-6)
            missing_mm = max(radius_mm + self.contact_mm / 2 - distance_mm, 0.0)
            self._state[:2, 0, 0] += away_mm * (missing_mm / distance_mm)
        np.clip(self._state[0], self._arena.x[0] - self.wall_mm, self._arena.x[1] + self.wall_mm, self._state[0])
        np.clip(self._state[1], self._arena.y[0] - self.wall_mm, self._arena.y[1] + self.wall_mm, self._state[1])

    def _push(self, others_mm: np.ndarray) -> None:
        away_mm = self._state[:2, 0, 0] - others_mm
        distance_mm = np.maximum(np.hypot(away_mm[:, 0], away_mm[:, 1]), 1e-6)
        missing_mm = np.maximum(self.contact_mm - distance_mm, 0.0)
        if missing_mm.any():
            self._state[:2, 0, 0] += (away_mm * (0.5 * missing_mm / distance_mm)[:, None]).sum(axis=0)
