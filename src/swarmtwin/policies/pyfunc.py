"""A policy as MLflow loads and serves it: what vehicles observe goes in, their commands come out.

The loader module of what is registered as `<robot>-policy`.
"""

from pathlib import Path

import numpy as np
import pandas as pd

from swarmtwin.learning.served_model import unchanged_folder
from swarmtwin.policies.policy_folder import StoredPolicy, load_policy
from swarmtwin.world.past_commands import PastCommands


class ServedPolicy:
    """A policy that answers tables of observations, a row for each vehicle.

    Attributes:
        policy: the policy.
        required: what the numbers of an observation are, in order.
        optional: nothing.
        example: what the vehicles of one world observe at the start.
    """

    optional: tuple[str, ...] = ()

    def __init__(self, stored: StoredPolicy) -> None:
        self.policy = stored.policy
        self.required = stored.policy.observation_names
        task = stored.build_task()
        scenario = task.draw(np.random.default_rng(0), 1)
        at_rest = PastCommands(task.robot, task.config.sees_commands, 1, task.vehicles)
        observed = at_rest.beside(task.observe(scenario, scenario.start))[0].astype(float)
        self.example = pd.DataFrame(observed, columns=list(self.required))

    def predict(self, table: pd.DataFrame) -> pd.DataFrame:
        """Return the commands, in the robot's units and within its limits."""
        command = self.policy.act(table[list(self.required)].to_numpy(float, copy=True)[None])[0]
        return pd.DataFrame(command, table.index, list(self.policy.robot.command_columns))


def serve(folder: Path) -> ServedPolicy:
    """Load the policy in a folder, as it is there."""
    return ServedPolicy(load_policy(folder))


def _load_pyfunc(path: str) -> ServedPolicy:
    """Load the policy in the folder that MLflow names, if it is what was registered."""
    return serve(unchanged_folder(path))
