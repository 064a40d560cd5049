"""What dynamics models are given: a batch of situations, each part a tensor, the parts nobody asks for left out."""

from collections.abc import Callable, Collection
from dataclasses import dataclass, fields
from typing import Self, get_args

import torch
from torch import Tensor

from swarmtwin.robot import SituationPart
from swarmtwin.transitions import Transitions
from swarmtwin.transitions.transitions import Fields

ALL_PARTS: tuple[SituationPart, ...] = get_args(SituationPart)


def field_of(part: SituationPart) -> str:
    """Return the array of `Transitions` that a part of a situation is taken from."""
    return "time_s" if part == "elapsed_s" else part


@dataclass(frozen=True)
class Situation:
    """N situations at the start of a control period.

    Attributes:
        command: (N, m) held over the period, in the robot's units.
        previous_command: (N, m) held over the period before; a row of NaN where there was none.
        earlier_command: (N, m) held over the period before that; a row of NaN where there was none or no previous one.
        pose: (N, 3) x_mm, y_mm, heading_rad in the arena's frame.
        velocity: (N, 3) forward_mm_s, left_mm_s, turn_rad_s, the mean of the period before, in the vehicle's own frame;
            a row of NaN where it is not known.
        elapsed_s: (N,) time since the session began.
        duration_s: (N,) length of the period.
        neighbours: (N, K, 3) forward_mm, left_mm, turn_rad to the other vehicles in the vehicle's own frame, in any
            order; a row of NaN where there are fewer than K or a pose is unknown.
    """

    command: Tensor
    previous_command: Tensor | None = None
    earlier_command: Tensor | None = None
    pose: Tensor | None = None
    velocity: Tensor | None = None
    elapsed_s: Tensor | None = None
    duration_s: Tensor | None = None
    neighbours: Tensor | None = None

    @classmethod
    def from_transitions(
        cls,
        transitions: Transitions,
        parts: Collection[SituationPart] = ALL_PARTS,
        dtype: torch.dtype = torch.float32,
    ) -> Self:
        """Take `parts` of measured situations, in the order of the transitions."""
        return cls.from_fields({field_of(part): getattr(transitions, field_of(part)) for part in parts}, parts, dtype)

    @classmethod
    def from_fields(
        cls, measured: Fields, parts: Collection[SituationPart], dtype: torch.dtype = torch.float32
    ) -> Self:
        """Take `parts` of situations from arrays of `Transitions`, which hold those that `field_of` names."""
        return cls(**{part: torch.as_tensor(measured[field_of(part)], dtype=dtype) for part in parts})

    def __len__(self) -> int:
        return len(self.command)

    def __getitem__(self, rows: Tensor | slice) -> "Situation":
        return self._each(lambda part: part[rows])

    def only(self, parts: Collection[SituationPart]) -> "Situation":
        """Leave out everything but `parts`.

        Raises:
            ValueError: a part asked for is not there.
        """
        if absent := [part for part in parts if getattr(self, part) is None]:
            raise ValueError(f"the situation has no {absent[0]}: give it one")
        return Situation(**{part: getattr(self, part) for part in parts})

    def to(self, dtype_or_device: torch.dtype | torch.device) -> "Situation":
        """Convert every part to a dtype, or move it to a device."""
        return self._each(lambda part: part.to(dtype_or_device))

    def _each(self, change: Callable[[Tensor], Tensor]) -> "Situation":
        present = {field.name: getattr(self, field.name) for field in fields(self)}
        return Situation(**{name: change(part) for name, part in present.items() if part is not None})
