"""What a world computes most, compiled: motion by a table, and what groups measure, each equal to its plain formula.

The plain formulas (`world/observations.py`, `world/group.py`, `simulation/`) say what is meant, and tests compare.
"""

from swarmtwin.simulation.simulation import Simulation
from swarmtwin.world.motion import CheckpointedMotion, SimulatedMotion


def fastest_motion(
    simulation: Simulation, worlds: int, vehicles: int, sampled: bool | None = None, seed: int = 0
) -> CheckpointedMotion:
    """Return what moves W · K vehicles as `SimulatedMotion` does, by compiled code where that can: a bare table.

    What is drawn is of the same distribution, and not the same numbers.

    Raises:
        UserError: motion is to be drawn, and the simulation does not know of anything random.
    """
    from swarmtwin.world.compiled.table_motion import TableMotion, moves_by_table

    kind = TableMotion if moves_by_table(simulation) else SimulatedMotion
    return kind(simulation, worlds, vehicles, sampled, seed)
