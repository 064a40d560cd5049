"""The scenes that policies are judged in: the same for every policy, and for each purpose others."""

import zlib
from typing import Literal

import numpy as np

from swarmtwin.world.scene import Scene
from swarmtwin.world.task import Task

Purpose = Literal["evaluation", "rollout", "gate"]
EVALUATION_SEED = 0


def draw_scenes(task: Task, count: int, purpose: Purpose, seed: int) -> Scene:
    """Draw `count` scenes of a task; fewer are not the first of more. No training starts from any of them."""
    return task.draw(np.random.default_rng([zlib.crc32(purpose.encode()), seed]), count)


def evaluation_scenes(task: Task, count: int) -> Scene:
    """Draw the scenes by which the best policy of a training is chosen, whatever the training's seed."""
    return draw_scenes(task, count, "evaluation", EVALUATION_SEED)
