"""Everything weakens as the session goes on: the battery runs down."""

from typing import ClassVar, Literal

from torch import Tensor

from swarmtwin.robot import Robot, SituationPart
from swarmtwin.simulation.efforts import change_effort
from swarmtwin.simulation.mechanism import Mechanism, Moment, Parameter


class Config(Mechanism):
    """Actuators lose speed over the session, by 1 − loss · progress^shape; or their effort loses as much.

    Attributes:
        loss: share that is lost at the session's end.
        shape: 1 falls steadily, more than 1 late, less than 1 early.
        acts_on: what weakens: the speed, or the effort before what the robot makes of it (see `gain_change`).
    """

    stage: ClassVar = "supply"
    words: ClassVar = "the actuators lose {loss} of their {acts_on} by the session's end"
    remedy: ClassVar = "charge or exchange the battery, or make sessions shorter"
    parameters: ClassVar = {
        "loss": Parameter(0.0, 0.95, 0.0, "", (0.1,), doubted_ends="none"),  # a flat battery: nothing is beyond
        "shape": Parameter(0.2, 5.0, None, "", (0.5, 1.0, 2.5)),
    }
    inputs: ClassVar[tuple[SituationPart, ...]] = ("elapsed_s",)

    name: Literal["battery_sag"] = "battery_sag"
    loss: float
    shape: float
    acts_on: Literal["speed", "effort"] = "speed"

    @classmethod
    def forms(cls, robot: Robot) -> tuple[type[Mechanism], ...]:
        """Return that of the speed and that of the effort."""
        return Config, Config.with_default("acts_on", "effort")

    def transform_command(self, command: Tensor, moment: Moment) -> Tensor:
        """Weaken the efforts, if it acts on them."""
        if self.acts_on == "speed":
            return command
        return change_effort(command, moment, lambda effort: effort * self._left(moment))

    def supply_gain(self, moment: Moment) -> Tensor | None:
        """Weaken with the session's progress, if it acts on the speed."""
        return self._left(moment) if self.acts_on == "speed" else None

    def _left(self, moment: Moment) -> Tensor:
        left: Tensor = 1.0 - self.loss * moment.progress**self.shape
        return left[:, None]
