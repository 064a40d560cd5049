"""What moves the vehicles of a world: a simulation here, stand-ins or the robots themselves elsewhere."""

from typing import Protocol, runtime_checkable

import numpy as np
import torch

from swarmtwin.errors import UserError
from swarmtwin.robot import Robot
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.simulation.state import State


class Motion(Protocol):
    """W worlds of K vehicles of one robot; poses are x_mm, y_mm, heading_rad in the arena's frame, as measured."""

    robot: Robot

    def place(self, worlds: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Put the vehicles of the worlds at indices (n,) to poses (n, K, 3), at rest and with no past.

        Returns:
            (n, K, 3) their measured poses.
        """

    def move(self, command: np.ndarray) -> np.ndarray:
        """Hold commands (W, K, m), in the robot's units, for one period.

        Returns:
            (W, K, 3) the measured poses at its end.
        """


@runtime_checkable
class RandomMotion(Protocol):
    """A motion some of which is drawn."""

    def reseed(self, seed: int) -> None:
        """Draw everything from now on with another seed."""


class SimulatedMotion(Motion):
    """A simulation that a world steps: it holds the state between two periods, and nothing else.

    Attributes:
        robot: whose vehicles they are.
        simulation: what moves them.
        is_sampled: whether motion is drawn, or the most likely one.
    """

    def __init__(
        self, simulation: Simulation, worlds: int, vehicles: int, sampled: bool | None = None, seed: int = 0
    ) -> None:
        """Put `worlds` · `vehicles` at the arena's origin; `place` puts them elsewhere.

        Args:
            simulation: what moves the vehicles.
            worlds: how many groups are side by side, W.
            vehicles: how many there are in each, K.
            sampled: whether motion is drawn from the simulation's distribution, with lost commands, irregular periods,
                random motion, camera noise and an age of the session for each roll-out, instead of the most likely one.
                None: drawn where mechanisms extend the simulation; the most likely one, as in the paper, for a bare
                dynamics model.
            seed: of what is drawn.

        Raises:
            UserError: motion is to be drawn, and the simulation does not know of anything random.
        """
        check_can_be_sampled(simulation, sampled)
        self.robot = simulation.robot
        self.simulation = simulation.eval()
        self.is_sampled = simulation.is_extended if sampled is None else sampled
        self._rng = torch.Generator().manual_seed(seed)
        self._state = simulation.start(torch.zeros(worlds, vehicles, 3))

    def place(self, worlds: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Put vehicles down: their commands before are unknown and their session begins anew.

        Raises:
            UserError: there are fewer worlds, or another number of vehicles in each.
        """
        own_worlds, own_vehicles = self._state.pose.shape[:2]
        if pose.shape[1] != own_vehicles or np.max(worlds, initial=0) >= own_worlds:
            raise UserError(
                f"this motion is of {own_worlds} × {own_vehicles} vehicles (worlds × vehicles in each), asked for are "
                f"{np.max(worlds, initial=0) + 1} × {pose.shape[1]}: make it with as many"
            )
        placed = self.simulation.start(torch.as_tensor(pose), rng=self._drawn_from)
        self._state = self._state.with_worlds(torch.as_tensor(worlds), placed)
        measured: np.ndarray = self.simulation.observe(placed, self._drawn_from).numpy()
        return measured

    def move(self, command: np.ndarray) -> np.ndarray:
        """Step all vehicles at once.

        Raises:
            UserError: the simulation predicts something that is not finite, or there are more worlds than commands.
        """
        if command.shape[:2] != self._state.pose.shape[:2]:
            raise UserError(
                f"this motion is of {len(self._state.pose)} worlds, commands are for {len(command)}: make it with as "
                "many"
            )
        with torch.inference_mode():
            self._state = self.simulation.step(self._state, torch.as_tensor(command), rng=self._drawn_from)
            measured: np.ndarray = self.simulation.observe(self._state, self._drawn_from).numpy()
        return measured.copy()

    def reseed(self, seed: int) -> None:
        """Draw everything from now on with another seed."""
        self._rng.manual_seed(seed)

    def state(self) -> dict[str, np.ndarray]:
        """Return all that the next motion depends on, for a checkpoint."""
        state = self._state
        arrays = {name: values.numpy().copy() for name, values in state.parts().items()}
        return {**arrays, "rng": self._rng.get_state().numpy().copy()}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Continue from a `state` of the same worlds and vehicles.

        Raises:
            ValueError: it is of other ones.
        """
        if state["pose"].shape != tuple(self._state.pose.shape):
            raise ValueError(f"a state of poses {state['pose'].shape} does not fit {tuple(self._state.pose.shape)}")
        self._rng.set_state(torch.as_tensor(state["rng"]))
        self._state = State.of_parts({name: torch.as_tensor(array) for name, array in state.items() if name != "rng"})

    @property
    def _drawn_from(self) -> torch.Generator | None:
        return self._rng if self.is_sampled else None


class CheckpointedMotion(Motion, Protocol):
    """A motion that can be continued from where it was."""

    def state(self) -> dict[str, np.ndarray]:
        """Return all that the next motion depends on."""

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Continue from a `state` of the same worlds and vehicles."""


def check_can_be_sampled(simulation: Simulation, sampled: bool | None) -> None:
    """Check that a simulation knows what is to be drawn.

    Raises:
        UserError: motion is to be drawn, and the simulation does not know of anything random.
    """
    if sampled and not simulation.is_extended and simulation.motion_noise is None:
        raise UserError(
            f"sampled=true: this simulation of {simulation.robot.name!r} does not know how much its motion varies: "
            "train its dynamics model anew, or leave it out"
        )
