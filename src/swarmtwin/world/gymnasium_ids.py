"""Importing this registers every task with gymnasium, as `swarmtwin/<task>-v0`, those of the user's plug-ins too.

`gymnasium.make` and `make_vec` import it by themselves where the id begins with its name:
`gymnasium.make("swarmtwin.world.gymnasium_ids:swarmtwin/obstacle-v0", motion=FOLDER)`.
"""

from pathlib import Path

import gymnasium

from swarmtwin.configuration import config_files
from swarmtwin.errors import UserError
from swarmtwin.simulation.simulation_folder import load_simulation
from swarmtwin.world.interface import Moved, open_world
from swarmtwin.world.vector_env import SwarmVectorEnv, vector_env


def vehicles_env(num_envs: int, task: str, motion: Moved, seed: int = 0) -> SwarmVectorEnv:
    """Return the vector environment of so many vehicles, as `gymnasium.make_vec` asks for it.

    Raises:
        UserError: they do not make whole worlds; or see `vector_env`.
    """
    if isinstance(motion, Path | str):
        motion = load_simulation(Path(motion))
    vehicles = open_world(task, motion).task.vehicles
    if num_envs < 1 or num_envs % vehicles:
        raise UserError(
            f"num_envs={num_envs}: each world of task {task!r} has {vehicles} vehicles, all of them sub-environments: "
            f"ask for a multiple of {vehicles}"
        )
    return vector_env(task, motion, num_envs // vehicles, seed)


for name in config_files("task"):
    gymnasium.register(
        id=f"swarmtwin/{name}-v0",
        entry_point="swarmtwin.world.single_env:single_env",
        vector_entry_point="swarmtwin.world.gymnasium_ids:vehicles_env",
        kwargs={"task": name},
    )
