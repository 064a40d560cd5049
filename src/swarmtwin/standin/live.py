"""Stand-ins driven live: told one command at a time, as a policy or a controller tells it, and measured after each."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from swarmtwin.errors import UserError
from swarmtwin.robot import Robot
from swarmtwin.standin.effect import Effect
from swarmtwin.standin.physics import Period, advance
from swarmtwin.standin.session import StandInSession, measured_poses, require_stand_in
from swarmtwin.standin.streams import Streams


class LiveStandIns(ABC):
    """W groups of the same V vehicles, moved as those are that are recorded, and seen by the camera, every marker.

    Each group has its own chances and its own session, which begins when its vehicles are placed.

    Attributes:
        robot: whose vehicles they are.
        purpose: of the random numbers, as a session that is recorded tells them apart.
        resting_command: of a vehicle that was just switched on, (m,).
    """

    purpose: ClassVar[str]
    resting_command: tuple[float, ...]

    def __init__(
        self,
        robot: Robot,
        vehicles: Sequence[str],
        groups: int,
        seed: int,
        effects: Sequence[Effect] = (),
        planned_steps: int = 1,
    ) -> None:
        """Switch on the vehicles with these ids, which stand at the arena's origin until they are placed.

        Args:
            robot: one that has a stand-in.
            vehicles: ids of the V vehicles of each group; fabrication depends on them alone.
            groups: how many drive side by side, W.
            seed: of the motion's noise, the link's and the camera's.
            effects: what the stand-ins are told to do.
            planned_steps: control periods in a session, for what ages; after them all have aged to the end.

        Raises:
            UserError: the robot has no stand-in, or a vehicle is named twice.
        """
        require_stand_in(robot)
        if twice := sorted({vehicle for vehicle in vehicles if list(vehicles).count(vehicle) > 1}):
            raise UserError(f"vehicle {twice[0]!r} is named twice: give each id once")
        self.robot = robot
        self._planned_s = planned_steps * robot.period_s
        self._session = StandInSession(robot, tuple(vehicles), groups, planned_steps, seed, effects)
        self._streams = Streams(seed, self.purpose)
        self._state = self._switched_on(np.zeros((groups, len(vehicles), 3)))
        self._active = np.empty((len(robot.command), groups, len(vehicles)))
        self._active[:] = np.reshape(self.resting_command, (-1, 1, 1))
        self._lost = np.zeros((groups, len(vehicles)), bool)
        self._elapsed_s = np.zeros(groups)

    def place(self, worlds: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Put the vehicles of the groups at indices (n,) to true poses (n, V, 3), just switched on.

        Returns:
            (n, V, 3) their poses as the camera measures them.
        """
        self._state[:, worlds] = self._put_back(worlds, pose.astype(float))
        self._active[:, worlds] = np.reshape(self.resting_command, (-1, 1, 1))
        self._lost[worlds] = False
        self._elapsed_s[worlds] = 0.0
        return self._measured(worlds)

    def move(self, command: np.ndarray) -> np.ndarray:
        """Send commands (W, V, m), in the robot's units, and let one period pass.

        Returns:
            (W, V, 3) the poses at its end, as the camera measures them.
        """
        conditions = self._session.conditions
        groups, vehicles = self._state.shape[1:]
        self._lost = conditions.lost(self._streams.of("link").random((groups, vehicles)), self._lost)
        arriving = np.where(self._lost, self._active, np.moveaxis(command, -1, 0))
        nominal_s = np.full((groups, 1), self.robot.period_s)
        duration_s = conditions.durations(nominal_s, self._streams.of("clock"))
        progress = np.minimum(self._elapsed_s / self._planned_s, 1.0)[:, None]
        self._state = self._advanced(Period(arriving, self._active, duration_s, progress))
        self._active = arriving
        self._elapsed_s = self._elapsed_s + duration_s[:, 0]
        return self._measured(np.arange(groups))

    def _measured(self, worlds: np.ndarray) -> np.ndarray:
        return self._photographed(np.moveaxis(self._state[:3, worlds], 0, -1))

    @abstractmethod
    def _switched_on(self, pose: np.ndarray) -> np.ndarray:
        """Make all vehicles at true poses (W, V, 3); return their states (states, W, V), true poses first."""

    @abstractmethod
    def _put_back(self, worlds: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Put those of the groups at indices (n,) to true poses (n, V, 3) anew; return their states (states, n, V)."""

    @abstractmethod
    def _advanced(self, period: Period) -> np.ndarray:
        """Return the states (states, W, V) after a period."""

    @abstractmethod
    def _photographed(self, pose: np.ndarray) -> np.ndarray:
        """Return true poses (n, V, 3) as the camera measures them."""


class LiveVehicles(LiveStandIns):
    """Vehicles that are moved by formulas, the physics that `record` drives."""

    purpose = "session"

    def _switched_on(self, pose: np.ndarray) -> np.ndarray:
        self._physics = self._session.physics(self._session.vehicles)
        self.resting_command = self._physics.resting_command
        return self._put_back(np.arange(len(pose)), pose)

    def _put_back(self, worlds: np.ndarray, pose: np.ndarray) -> np.ndarray:
        return self._physics.at_rest(np.moveaxis(pose, -1, 0))

    def _advanced(self, period: Period) -> np.ndarray:
        groups, vehicles = self._state.shape[1:]
        shape = (groups, self._physics.substeps, self._physics.noises, vehicles)
        noise = self._streams.of("motion").standard_normal(shape, np.float32)
        return advance(self._physics, self._state, period, noise.transpose(1, 2, 0, 3))

    def _photographed(self, pose: np.ndarray) -> np.ndarray:
        return measured_poses(self._session, self._physics, pose, self._streams)
