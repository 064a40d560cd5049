"""Where `swarmtwin tune` searches one option: a range of numbers, or choices."""

import math
from collections.abc import Callable
from typing import Annotated, Any, Self

import optuna
from pydantic import Field, model_validator

from swarmtwin.errors import UserError
from swarmtwin.robot import StrictModel

# An option may refuse the bound itself, as a rate must be above 0: it is never drawn. What lies so far inside counts.
INSIDE = 1e-9


class Range(StrictModel):
    """Where to search one option: between two numbers, or among choices."""

    low: float | None = None
    high: float | None = None
    log: bool = False
    choices: Annotated[tuple[bool | int | float | str, ...], Field(min_length=1)] | None = None

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        if (self.low is None) != (self.high is None) or (self.choices is None) == (self.low is None):
            raise ValueError("give low and high, or choices")
        if self.low is not None and self.high is not None:
            if not self.low < self.high:
                raise ValueError(f"low {self.low:g} must be below high {self.high:g}")
            if self.log and self.low <= 0:
                raise ValueError(f"log needs a low above 0, got {self.low:g}")
        return self

    def suggest(self, trial: optuna.Trial, name: str, whole: bool) -> Any:
        """Let Optuna choose a value; a `whole` number where the option takes no other."""
        if self.choices is not None:
            return trial.suggest_categorical(name, self.choices)
        assert self.low is not None
        assert self.high is not None
        if whole:
            return trial.suggest_int(name, int(self.low), int(self.high), log=self.log)
        return trial.suggest_float(name, self.low, self.high, log=self.log)

    def takes_whole_numbers(self, name: str, check: Callable[[Any], Any]) -> bool:
        """Return whether option `name` takes whole numbers alone; `check` raises UserError for values that it refuses.

        Raises:
            UserError: the option refuses a choice, or what lies within the range.
        """
        if self.choices is not None:
            for choice in self.choices:
                check(choice)
            return False
        assert self.low is not None
        assert self.high is not None
        if _accepts(check, _between_whole_numbers(self.low, self.high)):
            for share in (INSIDE, 1 - INSIDE):
                check(self.low + share * (self.high - self.low))
            return False
        if not (self.low.is_integer() and self.high.is_integer()):
            check(math.ceil(self.low))
            raise UserError(f"{name} takes whole numbers: give such as low and high")
        check(int(self.low))
        check(int(self.high))
        return True


def _accepts(check: Callable[[Any], Any], value: Any) -> bool:
    try:
        check(value)
    except UserError:
        return False
    return True


def _between_whole_numbers(low: float, high: float) -> float:
    """Return a number from `low` to `high` that is not whole."""
    return low + (min(high, math.floor(low) + 1) - low) / 2
