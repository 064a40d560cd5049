"""Left and right differ, or the trim of what steers is off."""

import math
from collections.abc import Mapping
from typing import ClassVar, Literal

import torch
from torch import Tensor

from swarmtwin.robot import Robot
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.mechanism import Mechanism, Moment, Parameter


class Config(Mechanism):
    """One wheel is weaker or stronger than it was, or left and right differ; or what steers is askew.

    Attributes:
        ratio: of a wheel's speed to what it was; where `side` is both, of the left one to the right one, with their
            geometric mean unchanged.
        side: whose speed it is.
        angle_rad: of what is steered by an angle: a fin, or wheels.
    """

    stage: ClassVar = "actuators"
    words: ClassVar = (
        "{side:left and right differ:/the left wheel runs at/the right wheel runs at} {ratio}{angle_rad}"
        "{side:/ times its speed/ times its speed}"
    )
    remedy: ClassVar = "compare both sides: wheels, motors, gears; or trim what steers"
    parameters: ClassVar = {
        "ratio": Parameter(0.3, 3.0, 1.0, "", (1.0,)),
        "angle_rad": Parameter(-0.7, 0.7, 0.0, "rad", (0.0,), 0.01),
    }

    name: Literal["actuator_asymmetry"] = "actuator_asymmetry"
    ratio: float | None = None
    side: Literal["both", "left", "right"] = "both"
    angle_rad: float | None = None

    @classmethod
    def forms(cls, robot: Robot) -> tuple[type[Mechanism], ...]:
        """Return for wheels that of each side and that of both."""
        if robot.actuation.steering or robot.actuation.kind != "wheel":
            return (Config,)
        return Config, Config.with_default("side", "left"), Config.with_default("side", "right")

    @classmethod
    def suits(cls, robot: Robot, conditions: SessionConditions) -> bool:
        """Take any steering angle, and wheels without one if their track is known."""
        return bool(robot.actuation.steering) or (robot.actuation.kind == "wheel" and bool(conditions.track_mm))

    @classmethod
    def parameters_of(cls, robot: Robot, conditions: SessionConditions) -> Mapping[str, Parameter]:
        """Ask what is steered for an angle, other wheels for a ratio."""
        if robot.actuation.steering:
            return {"angle_rad": cls.parameters["angle_rad"]}
        return {"ratio": cls.parameters["ratio"]} if robot.actuation.kind == "wheel" else {}

    def transform_command(self, command: Tensor, moment: Moment) -> Tensor:
        """Turn what steers."""
        steering = moment.robot.actuation.steering
        if self.angle_rad is None or steering is None:
            return command
        changed = command.clone()
        changed[:, moment.robot.command_columns.index(steering)] += math.degrees(self.angle_rad)
        return changed

    def supply_gain(self, moment: Moment) -> Tensor | None:
        """Make one wheel faster or slower, or one faster and the other slower."""
        if self.ratio is None:
            return None
        of_left = {"both": 0.5, "left": 1.0, "right": 0.0}[self.side]
        of_right = {"both": -0.5, "left": 0.0, "right": 1.0}[self.side]
        return torch.tensor([[self.ratio**of_left, self.ratio**of_right]], dtype=torch.float64)
