"""What moves the vehicles: a simulation here, a stand-in or the robots themselves elsewhere."""

from typing import Protocol

import numpy as np
import torch

from swarmtwin.dynamics.base import Dynamics
from swarmtwin.dynamics.situation import Situation
from swarmtwin.errors import UserError
from swarmtwin.geometry import compose, wrap_angle
from swarmtwin.robot import Robot
from swarmtwin.transitions.neighbours import relative_poses

CHUNK = 16_384


class Motion(Protocol):
    """W worlds of K vehicles of one robot; poses are x_mm, y_mm, heading_rad in the arena's frame, as measured."""

    robot: Robot

    def place(self, worlds: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Put the vehicles of the worlds at indices (n,) to poses (n, K, 3), at rest, with no past.

        Returns:
            (n, K, 3) their poses.
        """

    def move(self, command: np.ndarray) -> np.ndarray:
        """Hold commands (W, K, m), in the robot's units, for one period.

        Returns:
            (W, K, 3) the poses at its end.
        """


class SimulatedMotion(Motion):
    """Every vehicle moves as one dynamics model predicts, equation (1) of the paper; poses are measured exactly.

    A model that looks at neighbours is told of the other vehicles of the same world.
    """

    def __init__(self, dynamics: Dynamics, worlds: int, vehicles: int) -> None:
        """Put `worlds` · `vehicles` at the arena's origin; `place` puts them elsewhere."""
        self.robot = dynamics.robot
        self._dynamics = dynamics.eval()
        self._pose = np.zeros((worlds, vehicles, 3))
        self._previous_command = np.full((worlds, vehicles, len(self.robot.command)), np.nan)
        self._earlier_command = self._previous_command.copy()
        self._elapsed_s = np.zeros(worlds)

    def place(self, worlds: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Put vehicles down: their commands before are unknown and their time begins anew."""
        self._pose[worlds] = pose
        self._pose[worlds, :, 2] = wrap_angle(self._pose[worlds, :, 2])
        self._previous_command[worlds] = np.nan
        self._earlier_command[worlds] = np.nan
        self._elapsed_s[worlds] = 0.0
        placed: np.ndarray = self._pose[worlds]
        return placed

    def move(self, command: np.ndarray) -> np.ndarray:
        """Predict all displacements in one batch and compose them with the poses.

        Raises:
            UserError: the model predicts something that is not finite.
        """
        displacement = self._displacement(command)
        if not np.isfinite(displacement).all():
            raise UserError(
                f"the dynamics model {self._dynamics.config.name!r} of {self.robot.name!r} predicts a displacement "
                "that is not finite: train it anew"
            )
        self._pose = compose(self._pose, displacement)
        self._earlier_command = self._previous_command
        self._previous_command = command.copy()
        self._elapsed_s = self._elapsed_s + self.robot.period_s
        return self._pose.copy()

    def state(self) -> dict[str, np.ndarray]:
        """Return all that the next motion depends on, for a checkpoint."""
        return {
            "pose": self._pose.copy(),
            "previous_command": self._previous_command.copy(),
            "earlier_command": self._earlier_command.copy(),
            "elapsed_s": self._elapsed_s.copy(),
        }

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Continue from a `state` of the same worlds and vehicles; one of an old version may have no earlier commands.

        Raises:
            ValueError: it is of other ones.
        """
        if state["pose"].shape != self._pose.shape:
            raise ValueError(f"a state of poses {state['pose'].shape} does not fit {self._pose.shape}")
        self._pose = state["pose"].copy()
        self._previous_command = state["previous_command"].copy()
        unknown = np.full_like(self._previous_command, np.nan)
        self._earlier_command = state.get("earlier_command", unknown).copy()
        self._elapsed_s = state["elapsed_s"].copy()

    def _displacement(self, command: np.ndarray) -> np.ndarray:
        """Return the displacements (W, K, 3) that follow commands (W, K, m)."""
        worlds, vehicles, columns = command.shape
        count = worlds * vehicles
        parts = {
            "command": command.reshape(count, columns),
            "previous_command": self._previous_command.reshape(count, columns),
            "earlier_command": self._earlier_command.reshape(count, columns),
            "pose": self._pose.reshape(count, 3),
            "elapsed_s": np.repeat(self._elapsed_s, vehicles),
            "duration_s": np.full(count, self.robot.period_s),
        }
        if "neighbours" in self._dynamics.parts:
            parts["neighbours"] = relative_poses(self._pose).reshape(count, vehicles - 1, 3)
        asked = {part: torch.as_tensor(parts[part], dtype=torch.float32) for part in self._dynamics.parts}
        situation = Situation(**asked)
        with torch.inference_mode():
            chunks = [self._dynamics(situation[start : start + CHUNK]) for start in range(0, count, CHUNK)]
        displacement: np.ndarray = torch.cat(chunks).numpy().astype(float).reshape(worlds, vehicles, 3)
        return displacement
