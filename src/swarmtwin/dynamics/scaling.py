"""Situations become network inputs, network outputs become displacements; both scalings come from the training data."""

from collections.abc import Sequence
from typing import ClassVar, Literal

import torch
from torch import Tensor, nn

from swarmtwin.dynamics.situation import Situation
from swarmtwin.errors import UserError
from swarmtwin.robot import Robot, SituationPart

ScalingMethod = Literal["unit_range", "standard", "physical"]

# Pose before command, as the authors' code orders the inputs; the order matters to networks that read a sequence.
INPUT_ORDER: tuple[SituationPart, ...] = (
    "pose",
    "command",
    "previous_command",
    "earlier_command",
    "elapsed_s",
    "duration_s",
)


class Scaling(nn.Module):
    """An affine map per column, `(values − offset) / scale`, kept with the weights.

    `unit_range` maps the columns' observed range to 0…1 (the published networks), `standard` to mean 0 and standard
    deviation 1, `physical` leaves the units as they are. A column that does not vary keeps scale 1.
    """

    offset: Tensor
    scale: Tensor

    def __init__(self, columns: int, method: ScalingMethod) -> None:
        super().__init__()
        self.method = method
        self.register_buffer("offset", torch.zeros(columns))
        self.register_buffer("scale", torch.ones(columns))

    def learn(self, values: Tensor) -> None:
        """Take offset and scale from `values` (N, columns), without NaN."""
        if self.method == "physical":
            return
        if self.method == "unit_range":
            low, high = values.min(dim=0).values, values.max(dim=0).values
            offset, scale = low, high - low
        else:
            offset, scale = values.mean(dim=0), values.std(dim=0, correction=0)
        varies = scale > 1e-6 * offset.abs().clamp(min=1e-3)
        self.offset.copy_(offset)
        self.scale.copy_(torch.where(varies, scale, torch.ones_like(scale)))

    def forward(self, values: Tensor) -> Tensor:
        """Scale values (..., columns)."""
        return (values - self.offset) / self.scale

    def inverse(self, scaled: Tensor) -> Tensor:
        """Undo `forward`."""
        return scaled * self.scale + self.offset


class Encoding(nn.Module):
    """The input of a network: the parts of a situation side by side as columns, scaled.

    A heading is one column with `unit_range` (as in the paper; it jumps at ±π) and its cosine and sine otherwise. Where
    there was no previous or earlier command the mean one of the training data stands in.

    Attributes:
        order: the parts that it can take, in the order of their columns. Neighbours are not among them: they are a set
            of any size. A kind of encoding that takes them states an order of its own.

    Raises:
        UserError: it is asked for a part that it cannot take.
    """

    order: ClassVar[tuple[SituationPart, ...]] = INPUT_ORDER
    usual_previous_command: Tensor
    usual_earlier_command: Tensor

    def __init__(self, robot: Robot, parts: Sequence[SituationPart], method: ScalingMethod) -> None:
        super().__init__()
        if unknown := [part for part in parts if part not in self.order]:
            raise UserError(f"no network takes {unknown[0]} yet: take it out of model.situation")
        self.parts = tuple(part for part in self.order if part in parts)
        commands = len(robot.command)
        pose_columns = 3 if method == "unit_range" else 4
        columns = {"pose": pose_columns} | dict.fromkeys(("command", "previous_command", "earlier_command"), commands)
        self.width = sum(columns.get(part, 1) for part in self.parts)
        self.scaling = Scaling(self.width, method)
        self.register_buffer("usual_previous_command", torch.zeros(commands))
        if "earlier_command" in self.parts:  # weights saved before there was this part have no such buffer
            self.register_buffer("usual_earlier_command", torch.zeros(commands))

    def learn(self, situation: Situation) -> None:
        """Take the scaling from training situations."""
        if situation.previous_command is not None:
            self.usual_previous_command.copy_(situation.previous_command.nanmean(dim=0).nan_to_num())
        if "earlier_command" in self.parts and situation.earlier_command is not None:
            self.usual_earlier_command.copy_(situation.earlier_command.nanmean(dim=0).nan_to_num())
        self.scaling.learn(self._columns(situation))

    def forward(self, situation: Situation) -> Tensor:
        """Return the network's input, (N, width)."""
        scaled: Tensor = self.scaling(self._columns(situation))
        return scaled

    def _columns(self, situation: Situation) -> Tensor:
        situation = situation.only(self.parts)
        columns = [self._part_columns(part, getattr(situation, part)) for part in self.parts]
        return torch.cat(columns, dim=-1)

    def _part_columns(self, part: SituationPart, values: Tensor) -> Tensor:
        if part == "previous_command":
            return torch.where(values.isnan(), self.usual_previous_command, values)
        if part == "earlier_command":
            return torch.where(values.isnan(), self.usual_earlier_command, values)
        if part == "pose" and self.scaling.method != "unit_range":
            heading = values[:, 2:]
            return torch.cat([values[:, :2], heading.cos(), heading.sin()], dim=-1)
        return values if values.ndim == 2 else values[:, None]
