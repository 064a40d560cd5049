"""A simulation, extended or not, as MLflow loads and serves it: measured situations go in, displacements come out.

The loader module of what is registered as `<robot>-dynamics`. It answers what `predict` does, the most likely one-step
displacement; whoever wants vehicles with state steps a `Simulation`.
"""

from pathlib import Path

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from swarmtwin.learning.served_model import unchanged_folder
from swarmtwin.learning.situation import Situation
from swarmtwin.robot import DISPLACEMENT_COLUMNS, SituationPart
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.simulation.simulation_folder import load_simulation
from swarmtwin.transitions.storage import situation_columns


class ServedSimulation:
    """A simulation that answers tables whose columns are those of `transitions.parquet`.

    Attributes:
        simulation: the simulation.
        columns: of every part of a situation, with room for `most_neighbours` other vehicles.
        required: the columns of what it looks at.
        optional: those of earlier commands and of velocities, which nobody knows at the start of a run, and of other
            vehicles.
        example: three situations: the commands' lower limits, the command nearest to zero, the upper limits.
    """

    def __init__(self, simulation: Simulation, most_neighbours: int = 9) -> None:
        self.simulation = simulation
        self.columns = situation_columns(simulation.robot, most_neighbours)
        can_be_unknown: set[SituationPart] = {"previous_command", "earlier_command", "velocity", "neighbours"}
        unknown = [part for part in simulation.inputs if part in can_be_unknown]
        known = [part for part in simulation.inputs if part not in can_be_unknown]
        self.required, self.optional = (
            tuple(name for part in parts for name in self.columns[part]) for parts in (known, unknown)
        )
        self.example = self._example()

    def predict(self, table: pd.DataFrame) -> pd.DataFrame:
        """Return the most likely measured displacements, forward_mm, left_mm, turn_rad, of the period that follows."""
        situation = Situation(**{part: self._part(table, part) for part in self.simulation.inputs})
        displacement = self.simulation.predict(situation).numpy().astype(float)
        return pd.DataFrame(displacement, table.index, list(DISPLACEMENT_COLUMNS))

    def _part(self, table: pd.DataFrame, part: SituationPart) -> Tensor:
        """Return a part of the situations; NaN where the table does not have it."""
        values = torch.tensor(table.reindex(columns=list(self.columns[part])).to_numpy(float), dtype=torch.float32)
        if part == "neighbours":
            return values.reshape(len(table), -1, len(DISPLACEMENT_COLUMNS))
        return values.squeeze(dim=1) if part in ("elapsed_s", "duration_s") else values

    def _example(self) -> pd.DataFrame:
        robot = self.simulation.robot
        at_rest = self.simulation.command_at_rest.numpy()
        commands = np.array([robot.command_low, at_rest, robot.command_high])
        middle_mm = (robot.arena_mm.low_mm + robot.arena_mm.high_mm) / 2
        values: dict[SituationPart, np.ndarray] = {
            "command": commands,
            "previous_command": np.roll(commands, 1, axis=0),
            "earlier_command": np.roll(commands, 2, axis=0),
            "pose": np.tile([*middle_mm, 0.0], (3, 1)),
            "velocity": np.array([-1, 0, 1])[:, None] * robot.displacement_limit / (2 * robot.period_s),
            "elapsed_s": robot.period_s * np.arange(3)[:, None],
            "duration_s": np.full((3, 1), robot.period_s),
            "neighbours": np.tile([2 * max(robot.vehicle_size_mm), 0.0, 0.0], (3, 1)),  # one, ahead
        }
        inputs = self.simulation.inputs
        return pd.concat(
            [pd.DataFrame(values[part], columns=list(self.columns[part][: values[part].shape[1]])) for part in inputs],
            axis="columns",
        )


def serve(folder: Path) -> ServedSimulation:
    """Load the simulation in a folder, as it is there."""
    return ServedSimulation(load_simulation(folder))


def _load_pyfunc(path: str) -> ServedSimulation:
    """Load the simulation in the folder that MLflow names, if it is what was registered."""
    return serve(unchanged_folder(path))
