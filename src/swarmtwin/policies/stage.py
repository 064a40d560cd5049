"""What an evaluation in the course of learning finds."""

from collections.abc import Callable
from typing import NamedTuple

from swarmtwin.world.rollout import NEVER, Rollout


class Stage(NamedTuple):
    """What an evaluation found, after so many control periods of training: shares of the roll-outs, mean reward."""

    step: int
    success: float
    reward: float
    collision: float
    left_arena: float

    @classmethod
    def of(cls, step: int, rollout: Rollout) -> "Stage":
        """Summarise roll-outs."""
        return cls(
            step,
            float(rollout.success.mean()),
            float(rollout.mean_reward.mean()),
            float((rollout.collided_step != NEVER).mean()),
            float((rollout.left_step != NEVER).mean()),
        )


StageReport = Callable[[int, int, Stage | None], None]
"""Called now and then with the seed, the control periods done, and the last evaluation."""
