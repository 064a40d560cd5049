"""Effects of wheels, fins, supplies and cables that no cause of the catalogue describes."""

import math
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from swarmtwin.robot import Robot
from swarmtwin.standin.effect import Effect, Placement, Stroke, change_thrust

Share = Annotated[float, Field(gt=0, lt=1)]
Positive = Annotated[float, Field(gt=0)]


class OutOfRoundWheel(Effect):
    """The left wheel is egg-shaped: it brings the vehicle more or less far, by the angle that it stands at.

    The angle is carried along with the wheel's travel. At first it is what the digits of the vehicle's place make of
    it, so nobody who sees the recording can know it.
    """

    memory: ClassVar[int] = 1

    eccentricity: Share
    radius_mm: Positive

    def initial_memory(self, pose: np.ndarray) -> np.ndarray:
        """Let the wheel stand at an angle that is as good as drawn."""
        turned_rad: np.ndarray = np.mod(pose[:1] * 997.0, 2 * math.pi)
        return turned_rad

    def roll(self, stroke: Stroke, memory: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Modulate the left wheel's travel by its angle, and turn it on."""
        left = 1.0 + self.eccentricity * np.cos(memory[0])
        turned_rad = memory + stroke.travel[:1] / self.radius_mm
        return np.stack([left, np.ones_like(left)]), np.mod(turned_rad, 2 * math.pi)


class SlippingWheel(Effect):
    """The left wheel loses its grip when it speeds up or brakes, the more the harder, and finds it again gradually."""

    memory: ClassVar[int] = 1

    loss: Share
    at_mm_s2: Positive
    grips_after_s: Positive

    def roll(self, stroke: Stroke, memory: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Shorten the left wheel's travel by its acceleration; at `at_mm_s2` and more by the whole loss."""
        hard = np.abs(stroke.speed_after[0] - stroke.speed_before[0]) / (stroke.dt_s * self.at_mm_s2)
        slipping = np.maximum(np.minimum(hard, 1.0), memory[0] * np.exp(-stroke.dt_s / self.grips_after_s))
        left = 1.0 - self.loss * slipping
        return np.stack([left, np.ones_like(left)]), slipping[None]


class StickyMotors(Effect):
    """Static friction: a motor that stands needs more to start than one that runs needs to go on."""

    breakaway_mm_s: Positive
    standing_mm_s: Positive = 2.0

    def aimed_speed(self, target: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Let a wheel stand that stands, or reverses, where what is asked of it would not break it away."""
        runs = (np.abs(speed) > self.standing_mm_s) & (speed * target > 0)
        return np.where(runs | (np.abs(target) > self.breakaway_mm_s), target, 0.0)


class SharedSupply(Effect):
    """One regulator feeds all: an actuator is the weaker the harder the other one works, or the fin the faster."""

    loss: Share

    def transform_command(self, command: np.ndarray, robot: Robot) -> np.ndarray:
        """Weaken each wheel by the other one's effort, or the fin's amplitude by its frequency."""
        if robot.actuation.kind == "thrust":
            low, high = robot.command_low[2], robot.command_high[2]
            busy = (command[2] - low) / (high - low)
            return change_thrust(command, robot, lambda thrust: thrust * (1.0 - self.loss * busy))
        limit = float(np.abs(robot.command_high).max())
        return command * (1.0 - self.loss * np.abs(command[::-1]) / limit)


class CrossCoupling(Effect):
    """What one actuator is told leaks into the other: into the left wheel, or from a fin's frequency into its angle."""

    share: float

    def transform_command(self, command: np.ndarray, robot: Robot) -> np.ndarray:
        """Add a share of the right wheel's effort to the left one, or shift the fin's angle by how fast it beats."""
        coupled = command.copy()
        if robot.actuation.kind == "thrust":
            low, high = robot.command_low[2], robot.command_high[2]
            middle, half = (low + high) / 2, (high - low) / 2
            coupled[0] = command[0] + self.share * robot.command_high[0] * (command[2] - middle) / half
        else:
            coupled[0] = command[0] + self.share * command[1]
        return coupled


class DraggingCable(Effect):
    """A cable pulls towards the point where it hangs, once it is taut, the more the farther away the vehicle is."""

    rate_s: Positive
    x_mm: float
    y_mm: float
    slack_mm: Positive

    def drift_velocity_mm_s(self, placement: Placement) -> tuple[Any, Any]:
        """Pull towards the point."""
        to_x, to_y = self.x_mm - placement.x_mm, self.y_mm - placement.y_mm
        distance_mm = np.hypot(to_x, to_y) + 1e-3
        speed_mm_s = self.rate_s * np.maximum(distance_mm - self.slack_mm, 0.0)
        return speed_mm_s * to_x / distance_mm, speed_mm_s * to_y / distance_mm


class Temperature(Effect):
    """Grease is stiff while it is cold: from the session's start friction falls exponentially."""

    ages: ClassVar[bool] = True

    loss: Share
    warm_after: Share

    def strength(self, placement: Placement) -> np.ndarray:
        """Weaken the session's beginning; `warm_after` is the share of it in which two thirds of that go away."""
        return 1.0 - self.loss * np.exp(placement.progress * (-1.0 / self.warm_after))


MECHANICS: dict[str, type[Effect]] = {
    "out_of_round_wheel": OutOfRoundWheel,
    "slipping_wheel": SlippingWheel,
    "sticky_motors": StickyMotors,
    "shared_supply": SharedSupply,
    "cross_coupling": CrossCoupling,
    "dragging_cable": DraggingCable,
    "temperature": Temperature,
}
"""By the names that the study draws them by."""
