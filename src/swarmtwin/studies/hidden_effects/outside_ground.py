"""Effects of ground, water, commands and supply that no cause of the catalogue describes: they must get no name."""

import math
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from swarmtwin.robot import Arena, Robot
from swarmtwin.standin.effect import Effect, Placement, change_thrust

Share = Annotated[float, Field(gt=0, lt=1)]
Positive = Annotated[float, Field(gt=0)]


def _full_thrust(robot: Robot) -> float:
    """Return the largest command of a wheel, or the largest amplitude of a fin."""
    if robot.actuation.kind == "thrust":
        return robot.command["amplitude_deg"].high
    return float(max(np.abs(robot.command_high).max(), 1.0))


class BrushedFloor(Effect):
    """The ground grips along one direction better than across it, as brushed metal or a carpet's pile does."""

    loss: Share
    direction_rad: float

    def traction(self, placement: Placement, arena: Arena) -> np.ndarray:
        """Weaken what goes across."""
        return 1.0 - self.loss * np.sin(placement.heading_rad - self.direction_rad) ** 2


class StripedFloor(Effect):
    """Slippery stripes across the whole arena."""

    loss: Share
    width_mm: Positive

    def traction(self, placement: Placement, arena: Arena) -> np.ndarray:
        """Weaken the drive on every second stripe."""
        return 1.0 - self.loss * (np.sin(placement.x_mm * (math.pi / self.width_mm)) > 0).astype(placement.x_mm.dtype)


class OscillatingGain(Effect):
    """The supply swings: the actuators' speed goes up and down with the time."""

    ages: ClassVar[bool] = True

    amplitude: Share
    period_s: Positive
    session_s: Positive

    def strength(self, placement: Placement) -> np.ndarray:
        """Swing about the usual speed."""
        return 1.0 + self.amplitude * np.sin(placement.progress * (2 * math.pi * self.session_s / self.period_s))


class WarmUp(Effect):
    """The actuators are weak when each run begins, and warm up."""

    ages: ClassVar[bool] = True

    loss: Share
    warm_after_s: Positive
    run_s: Positive
    session_s: Positive

    def strength(self, placement: Placement) -> np.ndarray:
        """Weaken the beginning of each run."""
        since_start_s = np.mod(placement.progress * self.session_s + 1e-3, self.run_s)
        return 1.0 - self.loss * np.exp(since_start_s * (-1.0 / self.warm_after_s))


class SuddenLoss(Effect):
    """A part breaks in the middle of the session: from then on the actuators are weaker."""

    ages: ClassVar[bool] = True

    loss: Share
    after: Share

    def strength(self, placement: Placement) -> np.ndarray:
        """Weaken what comes after."""
        return 1.0 - self.loss * (placement.progress > self.after).astype(np.float64)


class WeakLeftTurn(Effect):
    """Turning left, and only then, the actuator that turns the vehicle is weaker."""

    loss: Share

    def transform_command(self, command: np.ndarray, robot: Robot) -> np.ndarray:
        """Weaken the right wheel, or the fin's beat."""
        if robot.actuation.kind == "thrust":
            return change_thrust(command, robot, lambda thrust: np.where(command[0] > 0, self._less(thrust), thrust))
        left, right = command
        return np.stack([left, np.where(right > left, self._less(right), right)])

    def _less(self, thrust: np.ndarray) -> np.ndarray:
        return thrust * (1.0 - self.loss)


class CoarseCommands(Effect):
    """The driver knows few levels: efforts are rounded to multiples of a step."""

    step: Positive

    def transform_command(self, command: np.ndarray, robot: Robot) -> np.ndarray:
        """Round."""
        most = math.floor(_full_thrust(robot) / self.step) * self.step
        return change_thrust(
            command, robot, lambda thrust: np.clip(np.round(thrust / self.step) * self.step, -most, most)
        )


class BentResponse(Effect):
    """The driver's curve is bent: middling efforts do too little or too much, full ones what they should."""

    bend: Annotated[float, Field(gt=-0.9, lt=0.9)]

    def transform_command(self, command: np.ndarray, robot: Robot) -> np.ndarray:
        """Bend by a parabola that leaves nothing and everything as they are."""
        limit = _full_thrust(robot)

        def bent(thrust: np.ndarray) -> np.ndarray:
            share = np.abs(thrust) / limit
            return thrust * (1.0 - self.bend * (1.0 - share))

        return change_thrust(command, robot, bent)


class SwappedWheels(Effect):
    """Now and then a command arrives with left and right swapped: those whose digits happen to fall so."""

    probability: Share

    def transform_command(self, command: np.ndarray, robot: Robot) -> np.ndarray:
        """Swap by a hash of the command, so that the same command always fares alike."""
        sum_of_digits = command[0] * 12.9898 + command[1] * 78.233
        share = np.mod(np.abs(np.sin(sum_of_digits.astype(np.float64).round(2)) * 104_729.0), 1.0)
        return np.where(share < self.probability, command[::-1], command)


class RotatingCurrent(Effect):
    """A current whose direction goes round as the session goes on."""

    ages: ClassVar[bool] = True

    speed_mm_s: Positive
    turns: Positive
    direction_rad: float

    def drift_velocity_mm_s(self, placement: Placement) -> tuple[Any, Any]:
        """Carry to where it flows now."""
        direction_rad = self.direction_rad + placement.progress * (2 * math.pi * self.turns)
        return self.speed_mm_s * np.cos(direction_rad), self.speed_mm_s * np.sin(direction_rad)


class AroundMiddle(Effect):
    """Something about the arena's middle, the faster the farther out; the speed is that at the radius."""

    speed_mm_s: float
    x_mm: float
    y_mm: float
    radius_mm: Positive


class Whirl(AroundMiddle):
    """Water or a tilted turntable carries vehicles round the arena's middle, faster the farther out they are."""

    def drift_velocity_mm_s(self, placement: Placement) -> tuple[Any, Any]:
        """Carry round the middle."""
        rate_s = self.speed_mm_s / self.radius_mm
        return (placement.y_mm - self.y_mm) * -rate_s, (placement.x_mm - self.x_mm) * rate_s


class Bowl(AroundMiddle):
    """The ground sags: vehicles roll towards the middle, faster the farther out they are."""

    def drift_velocity_mm_s(self, placement: Placement) -> tuple[Any, Any]:
        """Carry inwards."""
        rate_s = self.speed_mm_s / self.radius_mm
        return (placement.x_mm - self.x_mm) * -rate_s, (placement.y_mm - self.y_mm) * -rate_s


GROUND_AND_SUPPLY: dict[str, type[Effect]] = {
    "brushed_floor": BrushedFloor,
    "striped_floor": StripedFloor,
    "oscillating_gain": OscillatingGain,
    "warm_up": WarmUp,
    "sudden_loss": SuddenLoss,
    "weak_left_turn": WeakLeftTurn,
    "coarse_commands": CoarseCommands,
    "bent_response": BentResponse,
    "swapped_wheels": SwappedWheels,
    "rotating_current": RotatingCurrent,
    "whirl": Whirl,
    "bowl": Bowl,
}
"""By the names that the study draws them by."""
