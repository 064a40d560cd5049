"""Everything weakens as the session goes on: the battery runs down."""

from typing import ClassVar, Literal

from torch import Tensor

from swarmtwin.gap.mechanism import Drive, Mechanism, Quantity
from swarmtwin.robot import SituationPart


class Config(Mechanism):
    """Actuators lose speed over the session: 1 − loss · progress^shape.

    Attributes:
        loss: share that is lost at the session's end.
        shape: 1 falls steadily, more than 1 late, less than 1 early.
    """

    words: ClassVar = "the actuators lose {loss} of their speed by the session's end"
    remedy: ClassVar = "charge or exchange the battery, or make sessions shorter"
    quantities: ClassVar = {
        "loss": Quantity(0.0, 0.95, 0.0, "", (0.1,)),
        "shape": Quantity(0.2, 5.0, None, "", (0.5, 1.0, 2.5)),
    }
    needs: ClassVar[tuple[SituationPart, ...]] = ("elapsed_s",)

    name: Literal["battery_sag"] = "battery_sag"
    loss: float
    shape: float

    def strength(self, drive: Drive) -> Tensor:
        """Weaken with the session's progress."""
        weakened: Tensor = 1.0 - self.loss * drive.progress**self.shape
        return weakened[:, None]
