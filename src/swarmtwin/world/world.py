"""W worlds of K vehicles each, vectorised: a task gives observation and reward, a motion says where commands lead."""

import json
from dataclasses import dataclass

import numpy as np

from swarmtwin.errors import UserError
from swarmtwin.robot import Robot
from swarmtwin.world.motion import Motion, RandomMotion
from swarmtwin.world.scenario import Scenario
from swarmtwin.world.task import Events, Task


@dataclass(frozen=True)
class Step:
    """What one control period brought, in W worlds of K vehicles.

    Attributes:
        observation: (W, K, o) float32 at its end; where a roll-out ended, that of its last moment.
        reward: (W, K); 0 where the roll-out had ended before.
        command: (W, K, m) as sent: within the robot's limits; the resting command where the roll-out had ended before.
        counted: (W,) whether the roll-out was still going on when the period began.
        events: what happened to each vehicle; nothing where not counted.
        reached: (W,) whether all vehicles have held all targets by now, ever since the start.
        terminated: (W,) whether the task ended early, in this period.
        truncated: (W,) whether the time ran out or a vehicle was lost, in this period.
    """

    observation: np.ndarray
    reward: np.ndarray
    command: np.ndarray
    counted: np.ndarray
    events: Events
    reached: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray

    @property
    def collided(self) -> np.ndarray:
        """Whether any vehicle of a world collided in this period, (W,)."""
        return np.any(self.events.collided, axis=1)

    @property
    def left_arena(self) -> np.ndarray:
        """Whether any vehicle of a world is outside the arena, (W,)."""
        return np.any(self.events.left_arena, axis=1)

    @property
    def ended(self) -> np.ndarray:
        """Whether the roll-out of a world ended in this period, (W,)."""
        return self.terminated | self.truncated


class World:
    """Many roll-outs of a task side by side.

    A roll-out that has ended stands still until `restart`: so the last observation of each is seen before the first of
    the next. Training is `step`, then `restart(step.ended)`.

    Attributes:
        task: what is asked of the vehicles.
        robot: whose vehicles they are.
        motion: what moves them.
        worlds: how many there are side by side, W.
        scenario: what is asked now, with the targets that are sought now.
        pose: (W, K, 3) as measured last.
        step_count: (W,) periods since the start.
        ended: (W,) whether the roll-out is over.
        reached: (W,) whether all targets have been reached.
    """

    def __init__(self, task: Task, motion: Motion, worlds: int, seed: int) -> None:
        """Join a task and a motion of `worlds` · K vehicles, and start.

        Raises:
            UserError: they are of different robots.
        """
        _check_same_robot(task.robot, motion.robot)
        self.task = task
        self.robot = task.robot
        self.motion = motion
        self.worlds = worlds
        self._rng = np.random.default_rng(seed)
        self._resting_command = self.robot.command_at_rest
        self.reset()

    @property
    def shape(self) -> tuple[int, int, int]:
        """W, K and the number of columns of a command, m."""
        return self.worlds, self.task.vehicles, len(self.robot.command)

    def reseed(self, seed: int) -> None:
        """Draw all scenarios from now on with another seed, and the motion's chances where it has any."""
        self._rng = np.random.default_rng(seed)
        if isinstance(self.motion, RandomMotion):
            self.motion.reseed(seed)

    def reset(self) -> np.ndarray:
        """Start every world in a new scenario; return the observation (W, K, o)."""
        return self.start(self.task.draw(self._rng, self.worlds))

    def start(self, scenario: Scenario) -> np.ndarray:
        """Start every world in the given scenario, at its first target; return the observation (W, K, o).

        Raises:
            ValueError: the scenario has another number of worlds or vehicles.
        """
        if scenario.start.shape != (self.worlds, self.task.vehicles, 3):
            raise ValueError(
                f"a scenario of starts {scenario.start.shape} for {self.worlds} × {self.task.vehicles} vehicles"
            )
        self.scenario = scenario.from_first_leg()
        self.pose = self.motion.place(np.arange(self.worlds), scenario.start)
        self.step_count = np.zeros(self.worlds, dtype=int)
        self.ended = np.zeros(self.worlds, dtype=bool)
        self.reached = np.zeros(self.worlds, dtype=bool)
        self._held_steps = np.zeros(self.worlds, dtype=int)
        return self.observe()

    def restart(self, worlds: np.ndarray) -> np.ndarray:
        """Start the worlds of a mask (W,) in new scenarios, leave the others; return the observation (W, K, o)."""
        rows = np.flatnonzero(worlds)
        if len(rows):
            drawn = self.task.draw(self._rng, len(rows))
            self.scenario = self.scenario.replaced(rows, drawn)
            self.pose = self.pose.copy()
            self.pose[rows] = self.motion.place(rows, drawn.start)
            for counter in (self.step_count, self.ended, self.reached, self._held_steps):
                counter[rows] = 0
        return self.observe()

    def observe(self) -> np.ndarray:
        """Return what each vehicle observes now, (W, K, o) float32."""
        return self.task.observe(self.scenario, self.pose)

    def step(self, command: np.ndarray) -> Step:
        """Hold commands (W, K, m), in the robot's units, for one period; those beyond the limits are cut to them.

        Raises:
            UserError: a command or a pose is not finite.
            ValueError: the commands have another shape.
        """
        counted = ~self.ended
        command = self._bounded(command)
        command[self.ended] = self._resting_command
        pose = self.motion.move(command)
        self._check_finite(pose, "pose", "mm, mm, rad", "nothing was measured there")
        self.pose = np.where(counted[:, None, None], pose, self.pose)
        self.step_count += counted
        reward = np.where(counted[:, None], self.task.reward(self.scenario, self.pose), 0.0)
        events = self._events(counted)
        self._follow_targets(events)
        terminated = counted & self.task.ends_early & (events.collided.any(axis=1) | self.reached)
        over = (self.step_count >= self.task.steps) | self.task.lost(self.pose)
        truncated = counted & ~terminated & over
        self.ended = self.ended | terminated | truncated
        return Step(self.observe(), reward, command, counted, events, self.reached.copy(), terminated, truncated)

    def state(self) -> dict[str, np.ndarray]:
        """Return all that the next step depends on beside the motion, for a checkpoint."""
        return {
            "start": self.scenario.start,
            "targets": self.scenario.targets,
            "obstacles": self.scenario.obstacles,
            "leg": self.scenario.leg,
            "pose": self.pose.copy(),
            "step_count": self.step_count.copy(),
            "ended": self.ended.copy(),
            "reached": self.reached.copy(),
            "held_steps": self._held_steps.copy(),
            "random": np.array(json.dumps(self._rng.bit_generator.state)),
        }

    def restore(self, state: dict[str, np.ndarray]) -> np.ndarray:
        """Continue from a `state`, once the motion has been restored; return the observation (W, K, o).

        Raises:
            ValueError: it is of another number of worlds or vehicles.
        """
        if state["pose"].shape != self.pose.shape:
            raise ValueError(f"a state of poses {state['pose'].shape} does not fit {self.pose.shape}")
        self.scenario = Scenario(state["start"], state["targets"], state["obstacles"], state["leg"])
        self.pose = state["pose"].copy()
        self.step_count = state["step_count"].copy()
        self.ended, self.reached = state["ended"].copy(), state["reached"].copy()
        self._held_steps = state["held_steps"].copy()
        self._rng.bit_generator.state = json.loads(str(state["random"]))
        return self.observe()

    def _bounded(self, command: np.ndarray) -> np.ndarray:
        command = np.asarray(command, dtype=float)
        if command.shape != self.shape:
            raise ValueError(f"commands of shape {command.shape} for worlds, vehicles, columns {self.shape}")
        columns = ", ".join(self.robot.command_columns)
        self._check_finite(command, "command", columns, "the policy is broken, train it anew")
        return np.clip(command, self.robot.command_low, self.robot.command_high)

    def _check_finite(self, values: np.ndarray, what: str, columns: str, remedy: str) -> None:
        """Check what W · K vehicles were told or measured at, (W, K, ...), where the roll-out goes on."""
        broken = ~np.isfinite(values).all(axis=2) & ~self.ended[:, None]
        if not broken.any():
            return
        world, vehicle = np.argwhere(broken)[0]
        given = ", ".join(f"{value:g}" for value in values[world, vehicle])
        raise UserError(
            f"world {world}, vehicle {vehicle}, step {self.step_count[world]}: the {what} ({columns}) is not finite: "
            f"{given}; {remedy}"
        )

    def _events(self, counted: np.ndarray) -> Events:
        events = self.task.events(self.scenario, self.pose)
        here = counted[:, None]
        return Events(events.collided & here, events.left_arena & here, events.at_target & here)

    def _follow_targets(self, events: Events) -> None:
        """Count the steps in a row in which all vehicles are at the target; pass on to the next one once held."""
        self._held_steps = np.where(events.at_target.all(axis=1), self._held_steps + 1, 0)
        held = self._held_steps >= self.task.hold_steps
        self.reached = self.reached | (held & self.scenario.on_last_leg)
        self._held_steps[held & ~self.scenario.on_last_leg] = 0
        self.scenario = self.scenario.advanced(held)


def _check_same_robot(wanted: Robot, moved: Robot) -> None:
    """Check that what moves the vehicles is of the robot that the task is for: name, commands and period.

    Raises:
        UserError: it is not.
    """
    if wanted.name != moved.name:
        raise UserError(
            f"the task is for robot {wanted.name!r} and its motion is that of {moved.name!r}: give the dynamics "
            f"model of {wanted.name!r}, or choose robot={moved.name}"
        )
    if (wanted.command, wanted.period_s) != (moved.command, moved.period_s):
        raise UserError(
            f"robot {wanted.name!r} has other commands or another period here than in its dynamics model: train the "
            f"model anew, or undo the change of conf/robot/{wanted.name}.yaml"
        )
