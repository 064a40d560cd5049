"""Some commands never arrive, and the one before goes on: a weak radio link."""

from typing import ClassVar, Literal

from swarmtwin.gap.mechanism import Drive, Mechanism, Quantity, Responses
from swarmtwin.robot import SituationPart


class Config(Mechanism):
    """With `probability` a command is lost and the previous one goes on, or the one before it if that was lost too."""

    words: ClassVar = "{probability} of the commands never arrive"
    remedy: ClassVar = "check the radio link: range, interference, broker load"
    quantities: ClassVar = {"probability": Quantity(0.0, 0.9, 0.0, "", (0.02, 0.1, 0.3))}
    needs: ClassVar[tuple[SituationPart, ...]] = ("previous_command", "earlier_command")
    uses_history: ClassVar = True

    name: Literal["command_loss"] = "command_loss"
    probability: float

    def arriving(self, responses: Responses, drive: Drive) -> list[tuple[float, Responses]]:
        """Let the command arrive or not."""
        lost = responses._replace(now=responses.before, settled=responses.before)
        twice = responses._replace(now=responses.earlier, settled=responses.earlier)
        probability = self.probability
        return [
            (1.0 - probability, responses),
            (probability * (1.0 - probability), lost),
            (probability**2, twice),
        ]
