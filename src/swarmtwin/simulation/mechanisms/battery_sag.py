"""Everything weakens as the session goes on: the battery runs down."""

from typing import ClassVar, Literal

from torch import Tensor

from swarmtwin.robot import SituationPart
from swarmtwin.simulation.mechanism import Mechanism, Moment, Parameter


class Config(Mechanism):
    """Actuators lose speed over the session: 1 − loss · progress^shape.

    Attributes:
        loss: share that is lost at the session's end.
        shape: 1 falls steadily, more than 1 late, less than 1 early.
    """

    stage: ClassVar = "supply"
    words: ClassVar = "the actuators lose {loss} of their speed by the session's end"
    remedy: ClassVar = "charge or exchange the battery, or make sessions shorter"
    parameters: ClassVar = {
        "loss": Parameter(0.0, 0.95, 0.0, "", (0.1,)),
        "shape": Parameter(0.2, 5.0, None, "", (0.5, 1.0, 2.5)),
    }
    inputs: ClassVar[tuple[SituationPart, ...]] = ("elapsed_s",)

    name: Literal["battery_sag"] = "battery_sag"
    loss: float
    shape: float

    def supply_gain(self, moment: Moment) -> Tensor:
        """Weaken with the session's progress."""
        weakened: Tensor = 1.0 - self.loss * moment.progress**self.shape
        return weakened[:, None]
