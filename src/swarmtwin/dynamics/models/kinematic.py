"""The robot's kinematic model: a few physical, named parameters, fitted to the training data like any network."""

from abc import abstractmethod
from collections.abc import Callable
from typing import ClassVar, Literal, NamedTuple

import torch
from torch import Tensor, nn

from swarmtwin.dynamics.model_config import ModelConfig, Steps
from swarmtwin.dynamics.scaling import ScalingMethod
from swarmtwin.dynamics.twist import integrate_twist
from swarmtwin.errors import UserError
from swarmtwin.robot import Kinematics, Positive, Robot


class Quantity(NamedTuple):
    """A physical parameter: positive ones start at `size` and stay positive, signed ones start at 0, in steps of it."""

    size: float
    signed: bool = False


class KinematicModel(nn.Module):
    """Commands in the robot's units (N, m) → displacements (N, 3), by velocities that are constant over the period."""

    commands: ClassVar[int]

    def __init__(self, robot: Robot, quantities: dict[str, Quantity]) -> None:
        super().__init__()
        if len(robot.command) != self.commands:
            raise UserError(
                f"robot {robot.name!r}: kinematics {robot.kinematics!r} wants {self.commands} command columns, "
                f"got {len(robot.command)}: {', '.join(robot.command)}; correct conf/robot/{robot.name}.yaml"
            )
        self.period_s = robot.period_s
        self.quantities = quantities
        self.free = nn.ParameterDict({name: nn.Parameter(torch.zeros(())) for name in quantities})

    def value(self, name: str) -> Tensor:
        """Return a parameter in its unit, a scalar."""
        quantity = self.quantities[name]
        free: Tensor = self.free[name]
        return quantity.size * (free if quantity.signed else free.exp())

    def physical_parameters(self) -> dict[str, float]:
        """Return all parameters by name; the unit is in the name."""
        return {name: self.value(name).item() for name in self.quantities}

    @abstractmethod
    def velocities(self, command: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return forward_mm_s, left_mm_s, turn_rad_s, each (N,), for commands (N, m)."""

    def forward(self, command: Tensor) -> Tensor:
        """Predict displacements (N, 3)."""
        return integrate_twist(*self.velocities(command), self.period_s)


class DifferentialDrive(KinematicModel):
    """Two wheels; each one's speed is gain · effort · (1 + curvature · effort / limit), effort beyond a dead band."""

    commands = 2

    def __init__(self, robot: Robot) -> None:
        self.limit = float(robot.command_high.max())
        gain = Quantity(robot.largest_displacement.forward_mm / robot.period_s / self.limit)
        quantities = {"track_mm": Quantity(robot.vehicle_size_mm[1])}
        for wheel in ("left", "right"):
            quantities[f"{wheel}_gain_mm_s_per_unit"] = gain
            quantities[f"{wheel}_dead_band"] = Quantity(0.1 * self.limit)
            quantities[f"{wheel}_curvature"] = Quantity(0.5, signed=True)
        super().__init__(robot, quantities)

    def velocities(self, command: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Turn wheel speeds into forward speed and turn rate."""
        left, right = (self._wheel_mm_s(wheel, command[:, column]) for column, wheel in enumerate(("left", "right")))
        return (left + right) / 2, torch.zeros_like(left), (right - left) / self.value("track_mm")

    def _wheel_mm_s(self, wheel: str, command: Tensor) -> Tensor:
        effort = (command.abs() - self.value(f"{wheel}_dead_band")).relu()
        bend = 1 + self.value(f"{wheel}_curvature") * effort / self.limit
        return self.value(f"{wheel}_gain_mm_s_per_unit") * command.sign() * effort * bend


class Unicycle(KinematicModel):
    """Forward speed and turn rate as commanded, up to a gain each, and a veer: a turn with every millimetre driven."""

    commands = 2

    def __init__(self, robot: Robot) -> None:
        veer = Quantity(1e-3, signed=True)
        super().__init__(robot, {"speed_gain": Quantity(1), "turn_gain": Quantity(1), "veer_rad_per_mm": veer})

    def velocities(self, command: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Scale the command."""
        forward_mm_s = self.value("speed_gain") * command[:, 0]
        turn_rad_s = self.value("turn_gain") * command[:, 1] + self.value("veer_rad_per_mm") * forward_mm_s
        return forward_mm_s, torch.zeros_like(forward_mm_s), turn_rad_s


class TailFin(KinematicModel):
    """A fin beating about a mean angle (deg) with amplitude (deg) and frequency (rad/s) pushes along that angle.

    Push, side force and turn each go with a power of amplitude · frequency, taken as 1 at both limits; without a beat
    the vehicle coasts.
    """

    commands = 3

    def __init__(self, robot: Robot) -> None:
        largest = robot.largest_displacement
        self.strongest_beat = float(robot.command_high[1] * robot.command_high[2])
        quantities = {
            "push_mm_s": Quantity(0.5 * largest.forward_mm / robot.period_s),
            "push_exponent": Quantity(1.5),
            "coasting_mm_s": Quantity(0.1 * largest.forward_mm / robot.period_s),
            "side_mm_s": Quantity(0.3 * largest.left_mm / robot.period_s, signed=True),
            "turn_rad_s": Quantity(0.3 * largest.turn_rad / robot.period_s, signed=True),
            "turn_exponent": Quantity(1),
            "side_exponent": Quantity(1),
            "angle_gain": Quantity(1),
            "trim_deg": Quantity(5, signed=True),
        }
        super().__init__(robot, quantities)

    def velocities(self, command: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Split the push by the angle at which it acts: trimmed, and larger than the fin's where the body gives way."""
        angle_rad = self.value("angle_gain") * torch.deg2rad(command[:, 0] + self.value("trim_deg"))
        beat = (command[:, 1] * command[:, 2] / self.strongest_beat).clamp(min=1e-6)
        push, side, turn = (beat ** self.value(f"{name}_exponent") for name in ("push", "side", "turn"))
        forward_mm_s = self.value("coasting_mm_s") + self.value("push_mm_s") * push * angle_rad.cos()
        left_mm_s = self.value("side_mm_s") * side * angle_rad.sin()
        return forward_mm_s, left_mm_s, self.value("turn_rad_s") * turn * angle_rad.sin()


KINEMATICS: dict[Kinematics, Callable[[Robot], KinematicModel]] = {
    "differential_drive": DifferentialDrive,
    "unicycle": Unicycle,
    "tail_fin": TailFin,
}


class Config(ModelConfig):
    """`conf/model/kinematic.yaml`."""

    scaling: ClassVar[ScalingMethod] = "physical"

    name: Literal["kinematic"] = "kinematic"
    learning_rate: Positive = 0.03
    steps: Steps = 500
    situation: tuple[Literal["command"]] = ("command",)

    def build(self, robot: Robot, inputs: int) -> nn.Module:
        """Build the kinematic model that the robot's file names."""
        return KINEMATICS[robot.kinematics](robot)
