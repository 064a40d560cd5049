"""What an effect is: a typed piece of configuration that changes the stand-in's physics at one physical place.

An effect overrides the hook of its place and leaves the others alone; `active_effects.py` combines the hooks of all
effects that are switched on. An effect outside the catalogue is any other subclass, handed to a `StandInSession` as an
object.

Arrays are laid out with their components first: a command is (m, ...), a scalar quantity (...), where ... is always
two axes: (runs, vehicles) while driving, (rows, draws) while averaging.
"""

from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np

from swarmtwin.errors import UserError
from swarmtwin.robot import Arena, Robot, StrictModel

Rng = np.random.Generator


@dataclass(frozen=True)
class Placement:
    """Where and when the vehicles are; every array broadcasts to (...).

    Attributes:
        progress: share of the session that has passed, 0 at its beginning, 1 at its end.
        x_mm: true positions in the arena's frame.
        y_mm: true positions in the arena's frame.
        heading_rad: true headings.
        neighbour_x_mm: (others, ...) true positions of the other vehicles of the run; others = 0 where it is alone.
        neighbour_y_mm: (others, ...) likewise.
        command: (m, ...) that holds, as it was sent; None where nobody has sent one.
        previous_command: (m, ...) that held in the period before; None likewise.
    """

    progress: np.ndarray
    x_mm: np.ndarray
    y_mm: np.ndarray
    heading_rad: np.ndarray
    neighbour_x_mm: np.ndarray
    neighbour_y_mm: np.ndarray
    command: np.ndarray | None = None
    previous_command: np.ndarray | None = None


@dataclass(frozen=True)
class Stroke:
    """What the actuators do in one time step; every array is (actuators, ...).

    Attributes:
        travel: of the wheels' rims, mm.
        speed_before: of the rims, mm/s, at its beginning.
        speed_after: at its end.
        dt_s: its length, broadcasting to (...).
    """

    travel: np.ndarray
    speed_before: np.ndarray
    speed_after: np.ndarray
    dt_s: Any


class Effect(StrictModel):
    """Something a stand-in can be told to do that the simulation does not know.

    Attributes:
        ages: true if what it does changes as the session goes on.
        memory: how many numbers `roll` remembers of each vehicle from one time step to the next.
    """

    ages: ClassVar[bool] = False
    memory: ClassVar[int] = 0

    def on(self, robot: Robot, vehicle_count: int) -> Self:
        """Return the effect with the defaults that depend on the robot filled in.

        Raises:
            UserError: it makes no sense for this robot, or for this number of vehicles in a run.
        """
        return self

    def command_delay_s(self) -> float:
        """Link: how late each command arrives."""
        return 0.0

    def loss_probability(self) -> float:
        """Link: how probably a command never arrives, so that the previous one goes on."""
        return 0.0

    def lost_in_a_row(self) -> float:
        """Link: how many commands are lost one after the other, on average; 0 where each is lost by itself."""
        return 0.0

    def transform_command(self, command: np.ndarray, robot: Robot) -> np.ndarray:
        """Actuator: what the electronics make of a command (m, ...)."""
        return command

    def strength(self, placement: Placement) -> Any:
        """Actuator: factor on the speed of wheel or fin, broadcasting to (actuators, ...)."""
        return 1.0

    def lag_s(self) -> float:
        """Actuator: what is added to its time constant."""
        return 0.0

    def backlash(self) -> float:
        """Actuator: travel lost at each reversal, mm of a wheel's rim or rad of the fin."""
        return 0.0

    def initial_memory(self, pose: np.ndarray) -> np.ndarray:
        """Return what it remembers (memory, ...) of vehicles that are switched on at poses (3, ...)."""
        return np.zeros((self.memory, *pose.shape[1:]), pose.dtype)

    def aimed_speed(self, target: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Actuator: the speed (actuators, ...) that wheels with `speed` now tend to where `target` is asked of them."""
        return target

    def roll(self, stroke: Stroke, memory: np.ndarray) -> tuple[Any, np.ndarray]:
        """Actuator: factor on the wheels' travel, broadcasting to (actuators, ...), and what is remembered next."""
        return 1.0, memory

    def trim_rad(self) -> float:
        """Actuator: angle of the fin when it is told to be straight."""
        return 0.0

    def traction(self, placement: Placement, arena: Arena) -> Any:
        """Ground or water: factor on how far the actuators bring the vehicle, broadcasting to (...)."""
        return 1.0

    def drift_velocity_mm_s(self, placement: Placement) -> tuple[Any, Any]:
        """Ground, water, neighbours: velocity along x and y of the arena that is added to the vehicle's own."""
        return 0.0, 0.0

    def noise_factor(self) -> float:
        """Ground or water: factor on the random part of the motion."""
        return 1.0

    def marker(self) -> tuple[float, float, float]:
        """Camera: where the marker sits on the vehicle: forward_mm, left_mm, turn_rad."""
        return 0.0, 0.0, 0.0

    def magnification(self, radius: np.ndarray) -> Any:
        """Camera: factor on a point's distance from the image's centre; `radius` is 1 at the arena's corners."""
        return 1.0

    def picture(self, pose: np.ndarray, progress: Any) -> np.ndarray:
        """Camera: what else it makes of the poses (..., 3) of markers; `progress` broadcasts to (...)."""
        return pose

    def durations(self, nominal: np.ndarray, rng: Rng) -> np.ndarray:
        """Clock: true lengths of the periods."""
        return nominal

    def clock_rate(self, progress: Any) -> Any:
        """Clock: how fast that of the recording goes; at more than 1 it shows more time than passes."""
        return 1.0


def wall_distance_mm(placement: Placement, arena: Arena) -> np.ndarray:
    """Return how far (...) vehicles are from the nearest wall; 0 at it and beyond."""
    from_x = np.minimum(placement.x_mm - arena.x[0], arena.x[1] - placement.x_mm)
    from_y = np.minimum(placement.y_mm - arena.y[0], arena.y[1] - placement.y_mm)
    return np.maximum(np.minimum(from_x, from_y), 0.0)


def thrust_columns(robot: Robot) -> tuple[str, ...]:
    """Return the command columns that say how hard the actuators work: of both wheels, or the fin's amplitude."""
    return robot.actuation.effort or robot.command_columns


def thrust_limit(robot: Robot) -> float:
    """Return the largest command of an actuator that thrusts: PWM of a wheel, amplitude in degrees of the fin."""
    return robot.command[thrust_columns(robot)[0]].high


def change_thrust(command: np.ndarray, robot: Robot, change: Any) -> np.ndarray:
    """Apply `change` to the thrusting part of commands (m, ...): both wheels, or the fin's amplitude alone."""
    changed = command.copy()
    rows = [robot.command_columns.index(column) for column in thrust_columns(robot)]
    changed[rows] = change(command[rows])
    return changed


def only_for(effect: str, robot: Robot, wheels: tuple[str, float | None], fin: tuple[str, float | None]) -> None:
    """Refuse the parameter (name, value) of the other kind of actuator than the robot's.

    Raises:
        UserError: the parameter that `robot` has no use for was given.
    """
    has_fin = robot.actuation.kind == "thrust"
    wanted, unwanted = (fin, wheels) if has_fin else (wheels, fin)
    if unwanted[1] is not None:
        actuator = "a tail fin" if has_fin else "wheels"
        raise UserError(
            f"effect {effect!r}: {unwanted[0]} means nothing to {robot.name!r}, which has {actuator}: give {wanted[0]}"
        )
