"""Travel is lost when an actuator reverses: worn gears."""

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal

import torch
from torch import Tensor

from swarmtwin.robot import Robot, SituationPart
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.efforts import change_effort, twist_of_wheels, wheel_travel
from swarmtwin.simulation.mechanism import Mechanism, Moment, Parameter


class Config(Mechanism):
    """A gear has play, which is taken up anew after each reversal.

    A wheel carries on which side the play lies. While that sets it free it rolls on, ever slower, as friction lets it:
    into the play as well, when its motor stops. A fin that beats to and fro takes it up in each stroke: it is by half
    of it less wide, and stands at its ends until the servo has come as far, but is as fast as ever in between. Another
    angle is steered to when the servo has taken it up.

    Attributes:
        travel_mm: of wheels, at the rim.
        coasting_mm: how far a free wheel rolls on from the robot's largest speed, from any other in proportion to its
            square; None: it stands at once.
        travel_rad: of a fin's joint.
        by_width: by what share a fin's push follows how wide its strokes are, and not how fast; None: all.
        servo_rad_s: speed at which a fin's servo takes it up, sold with 0.05 to 0.26 s for 60 degrees; None: at once.
    """

    stage: ClassVar = "actuators"
    words: ClassVar = "after each reversal {travel_mm}{travel_rad} of travel is lost"
    remedy: ClassVar = "check gears, couplings and set screws for play"
    parameters: ClassVar = {}
    inputs: ClassVar[tuple[SituationPart, ...]] = ("previous_command", "earlier_command")
    says_when: ClassVar = True

    name: Literal["backlash"] = "backlash"
    travel_mm: float | None = None
    coasting_mm: float | None = None
    travel_rad: float | None = None
    by_width: float | None = None
    servo_rad_s: float | None = None

    @classmethod
    def suits(cls, robot: Robot, conditions: SessionConditions) -> bool:
        """Wheels need a track; thrust must beat by an amplitude in degrees."""
        if robot.actuation.kind == "wheel":
            return bool(conditions.track_mm)
        return bool(cls.parameters_of(robot, conditions))

    @classmethod
    def parameters_of(cls, robot: Robot, conditions: SessionConditions) -> Mapping[str, Parameter]:
        """Give the play in the unit of what has it."""
        if robot.actuation.kind == "wheel":
            way = robot.largest_displacement.forward_mm
            return {
                "travel_mm": Parameter(0.0, 0.75 * way, 0.0, "mm", (0.025 * way, 0.1 * way), 0.005 * way),
                "coasting_mm": Parameter(0.0, 0.5 * way, None, "mm", (0.0, 0.15 * way), 0.01 * way, "none"),
            }
        efforts = [robot.command[name] for name in robot.actuation.effort]
        if not efforts or efforts[0].unit != "deg":
            return {}
        high = math.radians(efforts[0].high)
        return {
            "travel_rad": Parameter(0.0, high, 0.0, "rad", (0.05, 0.2), 0.01),
            "by_width": Parameter(0.0, 1.0, None, "", (0.25, 0.75), 0.02, doubted_ends="none"),
            "servo_rad_s": Parameter(4.0, 21.0, None, "rad/s", (7.0, 14.0), 0.2, doubted_ends="high"),
        }

    def transform_command(self, command: Tensor, moment: Moment) -> Tensor:
        """Give a fin the amplitude that pushes as much without play: a mean of squares, as thrust is."""
        if self.travel_rad is None:
            return command
        travel_deg, by_width = math.degrees(self.travel_rad), 1.0 if self.by_width is None else self.by_width

        def pushing_as_much(amplitude: Tensor) -> Tensor:
            lost = (travel_deg / amplitude.clamp(min=1e-6)).clamp(max=2.0)
            width2, speed2 = (1 - lost / 2) ** 2, _speed_squared(lost)
            return amplitude * (by_width * width2 + (1 - by_width) * speed2).clamp(min=0.0).sqrt()

        return change_effort(command, moment, pushing_as_much)

    def mean_command(self, command: Tensor, previous: Tensor, moment: Moment) -> Tensor:
        """Let a fin steer as before until the play is taken up."""
        robot = moment.robot
        if self.travel_rad is None or self.servo_rad_s is None or robot.actuation.steering is None:
            return command
        column = robot.command_columns.index(robot.actuation.steering)
        late = min(self.travel_rad / self.servo_rad_s / robot.period_s, 1.0)
        changed = command.clone()
        changed[:, column] += late * (previous[:, column] - command[:, column])
        return changed

    def initial_memory(self, twist: Tensor, moment: Moment) -> Tensor | None:
        """Return how much of its play each wheel has taken up ahead, mm, and how fast it rolls, mm a period, (N, 4).

        The play of one that stood is in the middle.
        """
        if self.travel_mm is None:
            return None
        rolled = wheel_travel(twist, moment.track_mm)
        return torch.cat([(rolled + self.travel_mm / 2).clamp(0.0, self.travel_mm), rolled], dim=-1)

    def actuator_response(self, twist: Tensor, memory: Tensor, share: float, moment: Moment) -> tuple[Tensor, Tensor]:
        """Let the motors of wheels take up their play first, in which the wheels roll on."""
        assert self.travel_mm is not None
        turned, (ahead, speed) = wheel_travel(twist, moment.track_mm), memory.split(2, dim=-1)
        rolls_on, at_last = self._rolling_on(speed, share, moment)
        faster = turned - rolls_on
        to_go = torch.where(faster > 0, self.travel_mm - ahead, ahead)
        in_play = (to_go / faster.abs().clamp(min=1e-9)).clamp(max=share)
        taken_up = (ahead + faster * in_play).clamp(0.0, self.travel_mm)
        rolled = turned - (taken_up - ahead) / share
        memory = torch.cat([taken_up, torch.where(in_play < share, turned, at_last)], dim=-1)
        return twist_of_wheels(rolled, twist, moment.track_mm), memory

    def _rolling_on(self, speed: Tensor, share: float, moment: Moment) -> tuple[Tensor, Tensor]:
        """Return how fast free wheels roll over a share of a period, mm a period: on average, and at last."""
        if not self.coasting_mm:
            return torch.zeros_like(speed), torch.zeros_like(speed)
        slower = moment.robot.largest_displacement.forward_mm**2 / (2 * self.coasting_mm) * share
        rolls_for = (speed.abs() / slower).clamp(max=1.0)  # of the share
        on_average = (speed.abs() - slower * rolls_for / 2) * rolls_for
        return speed.sign() * on_average, speed.sign() * (speed.abs() - slower).clamp(min=0.0)

    def plausible_alternatives(self) -> Sequence[Mechanism]:
        """Return a wider play of wheels: motors run faster while they take it up than with their wheels.

        By how much is not known; 15 % is assumed, since play of a rigid body's car was told 5 to 20 % too small.
        """
        if self.travel_mm is None:
            return ()
        return [self.model_copy(update={"travel_mm": 1.15 * self.travel_mm})]

    def breakpoints(self, robot: Robot) -> tuple[float, ...]:
        """Look at wheels in eighths of a period: travel is lost at its beginning."""
        return tuple(step / 8 for step in range(1, 8)) if self.travel_mm is not None else ()


def _speed_squared(lost: Tensor) -> Tensor:
    """Return the mean square of a beating fin's speed with play over that without, by the play over the amplitude.

    The servo goes by the cosine of its phase since it turned; the fin stands until that is 1 − lost.
    """
    stands = torch.arccos((1 - lost).clamp(-1.0, 1.0))
    return 1 - (stands - torch.sin(2 * stands) / 2) / math.pi
