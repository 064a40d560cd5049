"""The command acts late: a slow network or controller."""

from collections.abc import Mapping
from typing import ClassVar, Literal

from swarmtwin.robot import Robot, SituationPart
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.mechanism import Mechanism, Parameter
from swarmtwin.simulation.transient import Transient


class Config(Mechanism):
    """The command before goes on for `delay_s` after each new one is sent.

    What a sudden change of thrust's setting brings about beyond steady motion, a recoil from the fin's throw, begins as
    late: what has not died away by the end of the period goes on in the next one.

    Attributes:
        delay_s: how late.
        transient_time_constant_s: with which that dies away in the reference; None: it is over at once.
    """

    stage: ClassVar = "link"
    words: ClassVar = "commands act {delay_s} late"
    remedy: ClassVar = "check network, broker and camera for latency"
    parameters: ClassVar = {"delay_s": Parameter(0.0, 1.0, 0.0, "s", (0.1,))}
    inputs: ClassVar[tuple[SituationPart, ...]] = ("previous_command", "earlier_command")
    says_when: ClassVar = True

    name: Literal["command_delay"] = "command_delay"
    delay_s: float
    transient_time_constant_s: float | None = None

    @classmethod
    def parameters_of(cls, robot: Robot, conditions: SessionConditions) -> Mapping[str, Parameter]:
        """Allow a period at most."""
        period_s = robot.period_s
        step_s = 0.01 * period_s
        delay = {"delay_s": Parameter(0.0, period_s, 0.0, "s", (0.1 * period_s, 0.4 * period_s), step_s)}
        if robot.actuation.kind != "thrust":
            return delay
        dies_away = Parameter(0.0, period_s, None, "s", (0.2 * period_s,), step_s, doubted_ends="none")
        return {**delay, "transient_time_constant_s": dies_away}

    def latency_s(self) -> float:
        """Return the delay."""
        return self.delay_s

    def transient(self) -> Transient:
        """Let what a change of setting brings about die away as slowly."""
        return Transient(lag_s=self.transient_time_constant_s or 0.0)
