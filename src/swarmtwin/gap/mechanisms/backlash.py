"""Travel is lost when an actuator reverses: worn gears."""

import math
from collections.abc import Mapping
from typing import ClassVar, Literal

import torch
from torch import Tensor

from swarmtwin.gap.mechanism import (
    Drive,
    Mechanism,
    Quantity,
    Responses,
    change_effort,
    way_of_wheels,
    wheel_ways,
)
from swarmtwin.gap.surroundings import Surroundings
from swarmtwin.robot import Robot, SituationPart


class Config(Mechanism):
    """A gear has play, which is taken up anew after each reversal.

    Of a wheel, the two commands before say on which side the play lies; of a fin that beats to and fro, half of the
    play is missing from its amplitude.

    Attributes:
        travel_mm: of wheels, at the rim.
        travel_rad: of a fin's joint.
    """

    words: ClassVar = "after each reversal {travel_mm}{travel_rad} of travel is lost"
    remedy: ClassVar = "check gears, couplings and set screws for play"
    quantities: ClassVar = {}
    needs: ClassVar[tuple[SituationPart, ...]] = ("previous_command", "earlier_command")
    uses_history: ClassVar = True
    widening: ClassVar = 2.0
    leaves: ClassVar = 0.3

    name: Literal["backlash"] = "backlash"
    travel_mm: float | None = None
    travel_rad: float | None = None

    @classmethod
    def suits(cls, robot: Robot, surroundings: Surroundings) -> bool:
        """Wheels need a track; thrust must beat by an amplitude in degrees."""
        return bool(surroundings.track_mm) if robot.actuation.kind == "wheel" else bool(cls.quantities_of(robot))

    @classmethod
    def quantities_of(cls, robot: Robot) -> Mapping[str, Quantity]:
        """Give the play in the unit of what has it."""
        if robot.actuation.kind == "wheel":
            high = 0.5 * robot.largest_displacement.forward_mm
            return {"travel_mm": Quantity(0.0, high, 0.0, "mm", (0.05 * high, 0.2 * high), 0.01 * high)}
        efforts = [robot.command[name] for name in robot.actuation.effort]
        if not efforts or efforts[0].unit != "deg":
            return {}
        high = math.radians(efforts[0].high)
        return {"travel_rad": Quantity(0.0, high, 0.0, "rad", (0.05, 0.2), 0.01)}

    def received(self, command: Tensor, drive: Drive) -> Tensor:
        """Take half of the play from the amplitude of a fin."""
        if self.travel_rad is None:
            return command
        half_deg = math.degrees(self.travel_rad) / 2
        return change_effort(command, drive, lambda effort: (effort - half_deg).clamp(min=0.0))

    def delivered(self, responses: Responses, drive: Drive) -> Responses:
        """Let wheels take up their play first."""
        if self.travel_mm is None:
            return responses
        track_mm = drive.surroundings.track_mm or 1.0
        play = torch.tensor(self.travel_mm, dtype=torch.float64)
        now, before, earlier = (
            wheel_ways(way, track_mm) for way in (responses.now, responses.before, responses.earlier)
        )
        slack = (earlier + play / 2).clamp(min=0.0).minimum(play)
        slack = (slack + before).clamp(min=0.0).minimum(play)
        taken = (slack + now).clamp(min=0.0).minimum(play)
        return responses._replace(now=way_of_wheels(now - (taken - slack), responses.now, track_mm))
