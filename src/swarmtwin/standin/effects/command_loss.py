"""Some commands never arrive, and the one before goes on: a weak radio link."""

from typing import Annotated

from pydantic import Field

from swarmtwin.standin.effect import Effect


class CommandLoss(Effect):
    """Each command is lost with the same probability, whatever happened to those before.

    Attributes:
        probability: of a command never arriving.
    """

    probability: Annotated[float, Field(gt=0, lt=1)] = 0.1

    def loss_probability(self) -> float:
        """Lose commands."""
        return self.probability
