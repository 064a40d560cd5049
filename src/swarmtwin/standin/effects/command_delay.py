"""The command acts late: a slow network or controller."""

from typing import Annotated

from pydantic import Field

from swarmtwin.standin.effect import Effect


class CommandDelay(Effect):
    """The command before goes on for a while after each new one is sent.

    Attributes:
        delay_s: how long; at most one period, all delays together.
    """

    delay_s: Annotated[float, Field(gt=0)] = 0.15

    def command_delay_s(self) -> float:
        """Let each command arrive late."""
        return self.delay_s
