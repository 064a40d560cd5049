"""The command acts late: a slow network or controller."""

from collections.abc import Mapping
from typing import ClassVar, Literal

from swarmtwin.robot import Robot, SituationPart
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.mechanism import Mechanism, Parameter


class Config(Mechanism):
    """The command before goes on for `delay_s` after each new one is sent."""

    stage: ClassVar = "link"
    words: ClassVar = "commands act {delay_s} late"
    remedy: ClassVar = "check network, broker and camera for latency"
    parameters: ClassVar = {"delay_s": Parameter(0.0, 1.0, 0.0, "s", (0.1,))}
    inputs: ClassVar[tuple[SituationPart, ...]] = ("previous_command",)
    says_when: ClassVar = True

    name: Literal["command_delay"] = "command_delay"
    delay_s: float

    @classmethod
    def parameters_of(cls, robot: Robot, conditions: SessionConditions) -> Mapping[str, Parameter]:
        """Allow a period at most."""
        period_s = robot.period_s
        return {"delay_s": Parameter(0.0, period_s, 0.0, "s", (0.1 * period_s, 0.4 * period_s), 0.01 * period_s)}

    def latency_s(self) -> float:
        """Return the delay."""
        return self.delay_s
