"""What all tasks of a group have in common: vehicles that start apart, see each other and must not touch."""

from abc import abstractmethod
from functools import cached_property
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from swarmtwin.robot import Arena, Positive, Robot
from swarmtwin.world import observations
from swarmtwin.world.neighbours import others_nearer_than
from swarmtwin.world.scenario import Scenario, draw_apart, room_for
from swarmtwin.world.task import Events, Measured, NotNegative, Task, TaskConfig


class Group(Task):
    """K vehicles that share one policy; each sees the others, or the nearest of them, and perhaps the walls."""

    ends_early = False

    def __init__(self, robot: Robot, config: "GroupConfig", arena: Arena | None = None) -> None:
        super().__init__(robot, config, arena)
        self.config: GroupConfig = config
        names = observations.target_names() + observations.neighbour_names(self.shown_others)
        self.surrounding_names = names + (observations.wall_names() if config.sees_walls else ())
        self._check_distances()

    @property
    def shown_others(self) -> int:
        """How many others a vehicle is shown."""
        nearest: int | None = self.config.sees_nearest
        return self.vehicles - 1 if nearest is None else nearest

    def shown_place(self, scenario: Scenario, pose: np.ndarray) -> np.ndarray:
        """Return the place that each vehicle is shown, (W, K, 2), or (W, 1, 2) where it is the same for all."""
        return scenario.target_of_each

    @abstractmethod
    def reward_among(self, pose: np.ndarray, near_others: np.ndarray, target_mm: np.ndarray) -> np.ndarray:
        """Return what each vehicle earns, (W, K).

        Args:
            pose: (W, K, 3).
            near_others: (W, K) how many others are near each.
            target_mm: (W, K) how far each is from the target it seeks; any number where there is none.
        """

    def is_at_target(self, pose: np.ndarray, target_mm: np.ndarray) -> np.ndarray:
        """Return whether each vehicle, so far from the target it seeks (W, K), is where it should be, (W, K)."""
        return np.asarray(target_mm <= self.config.reach_mm)

    def reward(self, scenario: Scenario, pose: np.ndarray) -> np.ndarray:
        """Return what each vehicle earns for being where it is among the others, (W, K)."""
        return self.reward_among(pose, self.near_others(pose), self.target_distance_mm(scenario, pose))

    def at_target(self, scenario: Scenario, pose: np.ndarray) -> np.ndarray:
        """Return whether each vehicle is where it should be, (W, K)."""
        return self.is_at_target(pose, self.target_distance_mm(scenario, pose))

    def observe(self, scenario: Scenario, pose: np.ndarray) -> np.ndarray:
        """Show each vehicle its place, the others, nearest first, and the walls where they count."""
        config = self.config
        scaling = config.observation
        parts = [
            observations.observe_place(self.shown_place(scenario, pose), pose, scaling),
            observations.observe_neighbours(
                pose, config.collision_mm, scaling, config.sees_nearest, config.sees_within_mm
            ),
        ]
        if config.sees_walls:
            parts.append(observations.observe_walls(pose, self.arena, scaling))
        return np.concatenate(parts, axis=-1, dtype=np.float32, casting="same_kind")

    def measure_compiled(self, scenario: Scenario, pose: np.ndarray) -> Measured:
        """Return the same as `measure`, by compiled code."""
        from swarmtwin.world.compiled import group  # numba takes a second to load

        seen = group.look(
            pose, self.shown_place(scenario, pose), self._numbers, self.shown_others, self.config.sees_walls
        )
        reward = self.reward_among(pose, seen.near_others, seen.place_mm).astype(float)
        events = Events(seen.collided, seen.outside, self.is_at_target(pose, seen.place_mm))
        return Measured(seen.observation, reward, events, seen.lost)

    @cached_property
    def _numbers(self) -> Any:
        """The numbers of the configuration, as compiled code wants them."""
        from swarmtwin.world.compiled import group

        config, arena, scaling = self.config, self.arena, self.config.observation
        return group.Numbers.of(
            (*arena.low_mm, *arena.high_mm),
            config.sees_within_mm,
            target=scaling.target_mm,
            range=scaling.range_mm,
            neighbour=scaling.neighbour_mm,
            closeness=scaling.closeness_mm,
            wall_closeness=scaling.wall_closeness_mm,
            neighbour_near=config.neighbour_near_mm,
            collision=config.collision_mm,
            outside=config.outside_mm,
            lost=self.lost_mm,
        )

    def collided(self, scenario: Scenario, pose: np.ndarray) -> np.ndarray:
        """Two vehicles collide when their centres are nearer than `collision_mm` (the authors' code: 100 mm)."""
        return others_nearer_than(pose, self.config.collision_mm) > 0

    def near_others(self, pose: np.ndarray) -> np.ndarray:
        """Return how many others are nearer than `neighbour_near_mm` to each vehicle, (W, K)."""
        return others_nearer_than(pose, self.config.neighbour_near_mm)

    def draw_starts(self, rng: np.random.Generator, taken: np.ndarray) -> np.ndarray:
        """Draw starts (W, K, 3) apart from each other and beside circles (W, n, 3), with any heading."""
        position = draw_apart(rng, self.vehicles, self.start_room_mm, self.config.separation_mm, taken)
        heading_rad = rng.uniform(-np.pi, np.pi, (len(taken), self.vehicles, 1))
        return np.concatenate([position, heading_rad], axis=-1)

    def check_room(self, taken: np.ndarray) -> None:
        """Check that the starts can be drawn beside circles (n, 3).

        Raises:
            UserError: they cannot.
        """
        fitting = room_for(self.vehicles, self.start_room_mm, self.config.separation_mm, taken)
        if fitting < self.vehicles:
            raise self.refusal(
                f"{self.vehicles} vehicles do not fit into the arena of {self.robot.name!r} with "
                f"{self.config.separation_mm:g} mm between them: about {fitting} do",
                "lower vehicles, separation_mm or margin_mm",
            )

    def _check_distances(self) -> None:
        width_mm = min(self.robot.vehicle_size_mm)
        if self.config.collision_mm < width_mm:
            raise self.refusal(
                f"collision_mm {self.config.collision_mm:g} is less than the width of {self.robot.name!r}, "
                f"{width_mm:g} mm: vehicles would pass through each other",
                "raise collision_mm, or choose another task for this robot",
            )
        if self.config.separation_mm < self.config.collision_mm:
            raise self.refusal(
                f"separation_mm {self.config.separation_mm:g} is less than collision_mm "
                f"{self.config.collision_mm:g}: vehicles would start in a collision",
                "raise separation_mm",
            )


class GroupConfig(TaskConfig):
    """What the configurations of all tasks of a group have in common.

    Attributes:
        neighbour_near_mm: nearer to another vehicle costs.
        collision_mm: two centres nearer than this are a collision.
        separation_mm: starts are at least this far apart.
        sees_walls: whether vehicles see the arena's border.
        sees_nearest: how many others a vehicle sees, the nearest ones, however many there are: so one policy drives any
            number of vehicles. None: all.
        sees_within_mm: who is further away than this is not seen; None: everybody is.
    """

    neighbour_near_mm: NotNegative
    collision_mm: Positive
    separation_mm: Positive
    sees_walls: bool
    sees_nearest: Annotated[int, Field(ge=0)] | None = None
    sees_within_mm: Positive | None = None
