"""What places do to the drive: the part that mechanisms of the ground have in common."""

from abc import ABC
from typing import ClassVar

from swarmtwin.robot import Robot, SituationPart
from swarmtwin.simulation.mechanism import Mechanism, Slowed, Stage


class LocalTraction(Mechanism, ABC):
    """A factor on how far actuators bring a vehicle, by the place.

    Attributes:
        slows: the vehicle, where its place is; each wheel, where that is; or the vehicle's thrust, of which it goes,
            slides and turns less far by different shares.
    """

    stage: ClassVar[Stage] = "ground"
    inputs: ClassVar[tuple[SituationPart, ...]] = ("pose",)

    slows: Slowed = "vehicle"

    @classmethod
    def forms(cls, robot: Robot) -> tuple[type[Mechanism], ...]:
        """Return that which slows the vehicle as a whole, and for wheels that which slows each, or that of thrust."""
        kind = {"thrust": "thrust", "wheel": "wheels"}.get(robot.actuation.kind)
        return (cls, cls.with_default("slows", kind)) if kind else (cls,)

    def what_traction_slows(self) -> Slowed:
        """Say what it slows."""
        return self.slows

    def breakpoints(self, robot: Robot) -> tuple[float, ...]:
        """Look at the path in fifths of a period."""
        return (0.2, 0.4, 0.6, 0.8)
