"""Some commands never arrive, and the one before goes on: a weak radio link."""

from typing import ClassVar, Literal

from swarmtwin.robot import SituationPart
from swarmtwin.simulation.mechanism import Mechanism, Parameter


class Config(Mechanism):
    """With `probability` a command is lost and the one in force before goes on."""

    stage: ClassVar = "link"
    words: ClassVar = "{probability} of the commands never arrive"
    remedy: ClassVar = "check the radio link: range, interference, broker load"
    parameters: ClassVar = {"probability": Parameter(0.0, 0.9, 0.0, "", (0.02, 0.1, 0.3))}
    inputs: ClassVar[tuple[SituationPart, ...]] = ("previous_command", "earlier_command")
    is_arrival_alone: ClassVar = True

    name: Literal["command_loss"] = "command_loss"
    probability: float

    def arrival_probability(self) -> float:
        """Return the share of commands that arrive."""
        return 1.0 - self.probability
