"""What a world computes most, compiled: motion by a table, and what tasks measure, each equal to its plain formula.

The plain formulas (`world/observations.py`, `world/tasks/`, `simulation/`) say what is meant, and tests compare. A task
whose kind has a file here, with a function `measure(task)`, is measured by what that returns, in worlds that are asked
to.
"""

import importlib
from collections.abc import Callable
from importlib.util import find_spec
from typing import cast

import numpy as np

from swarmtwin.world.scenario import Scenario
from swarmtwin.world.task import Measured, Task

Measure = Callable[[Scenario, np.ndarray], Measured]


def compiled_measure(task: Task) -> Measure:
    """Return a compiled counterpart of a task's `measure`; that itself where there is none."""
    name = f"{__name__}.{task.config.kind}"
    if find_spec(name) is None:
        return task.measure
    measure = cast(Measure | None, importlib.import_module(name).measure(task))
    return measure if measure is not None else task.measure
