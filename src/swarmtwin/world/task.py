"""What the vehicles are asked to do: where they start, what they observe, what they earn, what counts as a success."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from swarmtwin.errors import UserError
from swarmtwin.plugins import PluginRegistry
from swarmtwin.robot import Arena, Positive, Robot, StrictModel
from swarmtwin.world import tasks
from swarmtwin.world.observations import ObservationScaling
from swarmtwin.world.past_commands import past_command_names
from swarmtwin.world.scenario import Scenario

Count = Annotated[int, Field(ge=1)]
NotNegative = Annotated[float, Field(ge=0)]
Share = Annotated[float, Field(gt=0, le=1)]


class TaskConfig(StrictModel):
    """The configuration of a task, as in its `conf/task/<name>.yaml`; each task file ends in its own kind of it.

    Attributes:
        name: the task's name, that of its YAML.
        kind: the file in `tasks/` that plays it.
        vehicles: how many there are, K.
        steps: control periods in a roll-out.
        reach_mm: a vehicle is at its target within this distance of it.
        hold_s: the target is reached once all vehicles have been at it for this long, in a row.
        margin_mm: starts keep this distance from the arena's border.
        outside_mm: a vehicle whose centre is further outside the arena than this has left it.
        lost_share: a vehicle further outside than this share of the arena's shorter side is lost: its roll-out ends.
        observation: how lengths are scaled in observations.
        sees_commands: how many of its own last commands a vehicle observes.
    """

    name: str
    kind: str
    vehicles: Count
    steps: Count
    reach_mm: Positive
    hold_s: NotNegative
    margin_mm: NotNegative
    outside_mm: NotNegative
    lost_share: Share = 0.5
    observation: ObservationScaling = ObservationScaling()
    sees_commands: Annotated[int, Field(ge=0)] = 0

    @abstractmethod
    def build(self, robot: Robot, arena: Arena | None = None) -> "Task":
        """Return the task for a robot in an arena; None: the robot's usual one.

        Raises:
            UserError: it cannot be done by this robot in that arena.
        """


@dataclass(frozen=True)
class Events:
    """What has happened to W · K vehicles, each (W, K).

    Attributes:
        collided: it is too near another one, or touches an obstacle.
        left_arena: it is outside the arena.
        at_target: it is within reach of the target.
    """

    collided: np.ndarray
    left_arena: np.ndarray
    at_target: np.ndarray

    def where(self, worlds: np.ndarray) -> "Events":
        """Return what has happened in the worlds of a mask (W,), and nothing in the others."""
        here = worlds[:, None]
        return Events(self.collided & here, self.left_arena & here, self.at_target & here)


@dataclass(frozen=True)
class Measured:
    """All that a task has to say of W · K vehicles at one moment.

    Attributes:
        observation: (W, K, p) float32 of each vehicle: what its surroundings show.
        reward: (W, K) of each for being there.
        events: what has happened to each.
        lost: (W,) whether a vehicle is too far outside the arena to go on.
    """

    observation: np.ndarray
    reward: np.ndarray
    events: Events
    lost: np.ndarray


class Task(ABC):
    """One task of one robot: pure functions of a scenario and of poses (W, K, 3).

    Attributes:
        robot: whose vehicles it is for.
        arena: where they drive.
        config: its configuration.
        ends_early: whether a roll-out ends with the first collision, or with the target reached.
        surrounding_names: what the numbers are, in order, that `observe` shows of their surroundings.
        hold_steps: steps in a row at the target that count as having reached it, at least 1.
    """

    ends_early: ClassVar[bool]
    surrounding_names: tuple[str, ...]

    def __init__(self, robot: Robot, config: TaskConfig, arena: Arena | None = None) -> None:
        self.robot = robot
        self.arena = arena or robot.arena_mm
        self.config: Any = config
        self.hold_steps = max(1, math.ceil(config.hold_s / robot.period_s - 1e-9))  # for rounding
        self._check_margin()
        self._check_within_time()

    @property
    def vehicles(self) -> int:
        """How many vehicles there are, K."""
        return int(self.config.vehicles)

    @property
    def steps(self) -> int:
        """How many control periods a roll-out has, T."""
        return int(self.config.steps)

    @property
    def observation_names(self) -> tuple[str, ...]:
        """What the numbers of an observation are, in order: the surroundings, then its own last commands."""
        return self.surrounding_names + past_command_names(self.robot, self.config.sees_commands)

    @property
    def observation_size(self) -> int:
        """How many numbers a vehicle observes, o."""
        return len(self.observation_names)

    @property
    def legs(self) -> int:
        """How many targets are to be reached, one after the other, G."""
        return 1

    @property
    def near_enough_mm(self) -> float:
        """How near to the place that it is shown a vehicle need be."""
        return float(self.config.reach_mm)

    @abstractmethod
    def draw(self, rng: np.random.Generator, worlds: int) -> Scenario:
        """Draw the scenarios of some worlds."""

    def beginning(self, start: np.ndarray, targets: np.ndarray, obstacles: np.ndarray | None = None) -> Scenario:
        """Return the scenario of vehicles that stand at (W, K, 3) and are given targets, those of `draw` or others.

        Args:
            start: where the vehicles stand.
            targets: (W, G, 2), or (W, G, K, 2) where each vehicle has its own.
            obstacles: (W, O, 3) x_mm, y_mm, radius_mm; None: there are none.
        """
        return Scenario.beginning(start, targets, obstacles)

    @abstractmethod
    def observe(self, scenario: Scenario, pose: np.ndarray) -> np.ndarray:
        """Return what each vehicle observes of its surroundings, (W, K, p) float32."""

    @abstractmethod
    def reward(self, scenario: Scenario, pose: np.ndarray) -> np.ndarray:
        """Return what each vehicle earns for being where it is, (W, K)."""

    @abstractmethod
    def collided(self, scenario: Scenario, pose: np.ndarray) -> np.ndarray:
        """Return whether each vehicle collides with anything, (W, K)."""

    def events(self, scenario: Scenario, pose: np.ndarray) -> Events:
        """Return what has happened to each vehicle."""
        arena, tolerance_mm = self.arena, self.config.outside_mm
        position = pose[..., :2]
        outside = (position < arena.low_mm - tolerance_mm) | (position > arena.high_mm + tolerance_mm)
        return Events(self.collided(scenario, pose), outside.any(axis=-1), self.at_target(scenario, pose))

    def at_target(self, scenario: Scenario, pose: np.ndarray) -> np.ndarray:
        """Return whether each vehicle is where it should be, (W, K)."""
        return self.target_distance_mm(scenario, pose) <= self.config.reach_mm

    def lost(self, pose: np.ndarray) -> np.ndarray:
        """Return whether a vehicle of a world is so far outside the arena that no model knows what it does there, (W,).

        It has failed long before; its roll-out stops, so that nothing is learned from such places.
        """
        arena, far_mm = self.arena, self.lost_mm
        position = pose[..., :2]
        return np.any((position < arena.low_mm - far_mm) | (position > arena.high_mm + far_mm), axis=(1, 2))

    @property
    def lost_mm(self) -> float:
        """How far outside the arena a vehicle is lost."""
        return float(self.config.lost_share * min(self.arena.high_mm - self.arena.low_mm))

    def measure(self, scenario: Scenario, pose: np.ndarray) -> Measured:
        """Return what vehicles observe of their surroundings, reward, events and who is lost, at once."""
        return Measured(
            self.observe(scenario, pose), self.reward(scenario, pose), self.events(scenario, pose), self.lost(pose)
        )

    def measure_compiled(self, scenario: Scenario, pose: np.ndarray) -> Measured:
        """Return the same as `measure`, by compiled code where there is some: equal to rounding, for far less time."""
        return self.measure(scenario, pose)

    def target_distance_mm(self, scenario: Scenario, pose: np.ndarray) -> np.ndarray:
        """Return how far each vehicle is from the target it seeks, (W, K); NaN where there is none."""
        target = scenario.target_of_each
        away_x, away_y = pose[..., 0] - target[..., 0], pose[..., 1] - target[..., 1]
        return np.asarray(np.sqrt(away_x * away_x + away_y * away_y))

    def refusal(self, what: str, remedy: str) -> UserError:
        """Return the error that says why this robot cannot do this task, and what to change."""
        return UserError(f"task {self.config.name!r}: {what}; {remedy} (conf/task/{self.config.name}.yaml)")

    @property
    def start_room_mm(self) -> tuple[np.ndarray, np.ndarray]:
        """The corners (2,) and (2,) of the rectangle that starts are drawn from."""
        arena, margin_mm = self.arena, self.config.margin_mm
        return arena.low_mm + margin_mm, arena.high_mm - margin_mm

    def _check_margin(self) -> None:
        low, high = self.start_room_mm
        if not (low < high).all():
            raise self.refusal(
                f"a margin of {self.config.margin_mm:g} mm leaves no room in the arena of {self.robot.name!r}",
                "lower margin_mm",
            )

    def _check_within_time(self) -> None:
        size_mm = self.arena.high_mm - self.arena.low_mm
        step_mm = self.robot.largest_displacement.forward_mm
        across = max(0, math.ceil((float(np.hypot(*size_mm)) - self.config.reach_mm) / step_mm))
        needed = self.legs * (across + self.hold_steps)
        if self.steps < needed:
            raise self.refusal(
                f"{self.robot.name!r} moves at most {step_mm:g} mm a step, so in {self.steps} steps it cannot reach "
                "every target from everywhere in its arena and hold it",
                f"raise steps to {needed} or more",
            )


TASKS: PluginRegistry[TaskConfig] = PluginRegistry(tasks, "kind of task", group="task", field="kind")

task_kinds = TASKS.names
config_class = TASKS.plugin_class
task_config = TASKS.config
