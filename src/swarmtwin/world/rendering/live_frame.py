"""What a picture shows of a world that is being played: its path so far, and how it stands."""

from typing import Any

import numpy as np

from swarmtwin.errors import UserError, near_miss
from swarmtwin.world.rendering.frame import Frame, Status
from swarmtwin.world.world import Step, World


class LiveFrame:
    """Follows the first world of those played, from its start, for an environment that may be asked to render it.

    Attributes:
        render_mode: `rgb_array`, or None: no pictures.
        metadata: what gymnasium and PettingZoo want to know of it.
    """

    def __init__(self, world: World, render_mode: str | None) -> None:
        """Follow a world that has just been started.

        Raises:
            UserError: there is no such render mode.
        """
        self.metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 1.0 / world.robot.period_s}
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            known = near_miss(render_mode, self.metadata["render_modes"])
            raise UserError(f"no such render mode: {render_mode!r}: {known}")
        self.render_mode = render_mode
        self._world = world
        self.restart()

    def restart(self) -> None:
        """Begin anew: the world has just been started."""
        self._path = [self._world.pose[0]]
        self._colliding = np.zeros(self._world.task.vehicles, dtype=bool)
        self._collided = self._left_arena = False

    def follow(self, step: Step) -> None:
        """Take in what one period has brought."""
        self._path.append(self._world.pose[0])
        self._colliding = step.events.collided[0]
        self._collided |= bool(step.collided[0])
        self._left_arena |= bool(step.left_arena[0])

    def frame(self) -> Frame:
        """Return what a picture shows now."""
        world, scenario = self._world, self._world.scenario
        return Frame(
            title=world.task.config.name,
            robot=world.robot,
            arena=world.task.arena,
            task=world.task.config,
            path=np.stack(self._path),
            targets=scenario.targets[0],
            leg=int(scenario.leg[0]),
            obstacles=scenario.obstacles[0],
            time_s=float(world.step_count[0] * world.robot.period_s),
            colliding=self._colliding,
            status=Status.of(self._collided, self._left_arena, bool(world.reached[0])),
        )

    def picture(self) -> np.ndarray | None:
        """Return a picture (height, width, 3) uint8 of the world now, where the render mode asks for one."""
        if self.render_mode is None:
            return None
        from swarmtwin.world.rendering.drawing import draw  # OpenCV, only for those who want pictures

        return draw(self.frame())
