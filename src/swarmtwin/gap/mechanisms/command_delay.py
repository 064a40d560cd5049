"""The command acts late: a slow network or controller."""

from collections.abc import Mapping
from typing import ClassVar, Literal

from swarmtwin.dynamics.twist import displacement_of, twist_of
from swarmtwin.gap.mechanism import Drive, Mechanism, Quantity, Responses
from swarmtwin.geometry import compose
from swarmtwin.robot import Robot, SituationPart


class Config(Mechanism):
    """The command before goes on for `delay_s` after each new one is sent.

    First the motion under the old command, then that under the new one without its last part, for which no time is
    left: before^(δ/T) ∘ now ∘ settled^(−δ/T). Exact where the actuators settle within a period.
    """

    words: ClassVar = "commands act {delay_s} late"
    remedy: ClassVar = "check network, broker and camera for latency"
    quantities: ClassVar = {"delay_s": Quantity(0.0, 1.0, 0.0, "s", (0.1,))}
    needs: ClassVar[tuple[SituationPart, ...]] = ("previous_command",)
    uses_history: ClassVar = True
    leaves: ClassVar = 0.3

    name: Literal["command_delay"] = "command_delay"
    delay_s: float

    @classmethod
    def quantities_of(cls, robot: Robot) -> Mapping[str, Quantity]:
        """Allow a period at most."""
        period_s = robot.period_s
        return {"delay_s": Quantity(0.0, period_s, 0.0, "s", (0.1 * period_s, 0.4 * period_s), 0.01 * period_s)}

    def delivered(self, responses: Responses, drive: Drive) -> Responses:
        """Go on as before for a while."""
        share = self.delay_s / drive.robot.period_s
        first = compose(displacement_of(responses.before * share), displacement_of(responses.now))
        return responses._replace(now=twist_of(compose(first, displacement_of(responses.settled * -share))))
