"""A dynamics model that looks at the command alone, tabulated: the same motion for less computing."""

import itertools
from typing import Annotated, NamedTuple

import torch
from pydantic import Field
from torch import Tensor

from swarmtwin.dynamics.predictor import DynamicsModel, DynamicsModule, NetworkDynamics
from swarmtwin.errors import UserError
from swarmtwin.learning.situation import Situation
from swarmtwin.robot import Positive, StrictModel
from swarmtwin.simulation.simulation import Simulation


class TableSettings(StrictModel):
    """How finely displacements are tabulated, and how far they may be off: far less than the noise of motion.

    Attributes:
        points: in each column of the command, over its limits.
        position_mm: the most that 99 % of random commands may end beside where the model says.
        heading_deg: likewise, of the heading.
        largest: numbers in a table, at most.
    """

    points: Annotated[int, Field(ge=2)] = 129
    position_mm: Positive = 0.1
    heading_deg: Positive = 0.1
    largest: Annotated[int, Field(ge=1)] = 1_000_000


class TableError(NamedTuple):
    """How far a table is from its model at random commands within the limits: the 99th percentile, and the most."""

    position_mm: float
    heading_deg: float
    most_position_mm: float
    most_heading_deg: float


class DisplacementTable(DynamicsModule):
    """Displacements at a grid of commands, linear between them; commands beyond its ends count as these.

    Attributes:
        table: (points, …, points, 3) forward_mm, left_mm, turn_rad; an axis for each of the command's m columns.
        error: what that makes of its model.
    """

    table: Tensor
    _low: Tensor
    _step: Tensor

    def __init__(
        self,
        dynamics: DynamicsModel,
        settings: TableSettings,
        asked: int = 20_000,
        seed: int = 0,
        beyond: float = 0.0,
    ) -> None:
        """Ask a dynamics model at the grid, and at random commands to see how far the table is off.

        Args:
            dynamics: looks at commands alone.
            settings: how fine, and how far off it may be.
            asked: random commands.
            seed: of these.
            beyond: share of the limits' distance by which the table goes on beyond each; its points are over all of it.

        Raises:
            UserError: the model looks at more than the command or states a spread of its own, or the table would be too
                large or too far off.
        """
        super().__init__()
        self.robot, self.inputs = dynamics.robot, dynamics.inputs
        self.motion_noise = getattr(dynamics, "motion_noise", None)
        low, high = (torch.as_tensor(end) for end in (self.robot.command_low, self.robot.command_high))
        self._check_size(dynamics, len(low), settings)
        first, last = low - beyond * (high - low), high + beyond * (high - low)
        axes = [torch.linspace(float(a), float(b), settings.points) for a, b in zip(first, last, strict=True)]
        grid = torch.cartesian_prod(*axes).reshape(-1, len(low))
        answers = dynamics.predict(Situation(grid)).float()
        self.register_buffer("table", answers.reshape(*[settings.points] * len(low), 3))
        self.register_buffer("_low", first.float())
        self.register_buffer("_step", ((last - first) / (settings.points - 1)).float())
        drawn = torch.rand(asked, len(low), generator=torch.Generator().manual_seed(seed))
        self.error = self._compared(dynamics, low.float() + drawn * (high - low).float())
        self._check_error(settings)
        self.eval()

    def predict(self, situation: Situation) -> Tensor:
        """Return the expected displacements (N, 3), without gradients, on the situation's device."""
        command = situation.command.to(self._low)
        with torch.inference_mode():
            place = ((command - self._low) / self._step).clamp(min=0.0)
            cell = place.nan_to_num().long().clamp(max=len(self.table) - 2)
            share = (place - cell).clamp(max=1.0)
            total = torch.zeros(len(command), 3, device=command.device)
            for corner in itertools.product((0, 1), repeat=command.shape[1]):
                at = torch.tensor(corner, device=command.device)
                weight = torch.where(at.bool(), share, 1 - share).prod(dim=1, keepdim=True)
                total += weight * self.table[tuple((cell + at).unbind(dim=1))]
            return total.to(situation.command.device)

    def _compared(self, dynamics: DynamicsModel, command: Tensor) -> TableError:
        off = (self.predict(Situation(command)) - dynamics.predict(Situation(command))).double()
        position, heading = off[:, :2].norm(dim=1), off[:, 2].abs().rad2deg()
        usual, most = ([float(values.quantile(share)) for values in (position, heading)] for share in (0.99, 1.0))
        return TableError(*usual, *most)

    def _check_size(self, dynamics: DynamicsModel, columns: int, settings: TableSettings) -> None:
        if self.inputs != ("command",):
            raise UserError(
                f"this dynamics model of {self.robot.name!r} looks at {', '.join(self.inputs)}: only one that looks at "
                "the command alone can be tabulated; take tabulated=false"
            )
        if isinstance(dynamics, NetworkDynamics) and dynamics.drawn_members:
            raise UserError(
                f"this dynamics model of {self.robot.name!r} states a spread of its own, by which vehicles differ: a "
                "table would lose it; take tabulated=false"
            )
        numbers = 3 * settings.points**columns
        if numbers > settings.largest:
            raise UserError(
                f"a table of {settings.points} points in each of the {columns} columns of a command of "
                f"{self.robot.name!r} would hold {numbers:,} numbers: lower table.points, or take tabulated=false"
            )

    def _check_error(self, settings: TableSettings) -> None:
        error = self.error
        if not (error.position_mm <= settings.position_mm and error.heading_deg <= settings.heading_deg):
            raise UserError(
                f"a table of {settings.points} points a column is {error.position_mm:.3g} mm and "
                f"{error.heading_deg:.3g}° off its dynamics model of {self.robot.name!r} (99 % of random commands; "
                f"{settings.position_mm:g} mm and {settings.heading_deg:g}° are allowed): raise table.points, or take "
                "tabulated=false"
            )


def tabulated(simulation: Simulation, settings: TableSettings, wanted: bool | None = True) -> Simulation:
    """Return a simulation whose dynamics model is tabulated; what extends it is as it was.

    Args:
        simulation: to tabulate.
        settings: of the table.
        wanted: False: leave it as it is; None: also where it cannot be tabulated, or not well enough.

    Raises:
        UserError: it is wanted, and cannot be.
    """
    if wanted is False:
        return simulation
    try:
        table = DisplacementTable(simulation.dynamics, settings)
    except UserError:
        if wanted:
            raise
        return simulation
    return Simulation(table, simulation.mechanisms, simulation.conditions, simulation.residual, simulation.motion_noise)
