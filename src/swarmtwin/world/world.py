"""W worlds of K vehicles each, vectorised: a task gives observation and reward, a motion says where commands lead."""

from dataclasses import dataclass

import numpy as np

from swarmtwin.errors import UserError
from swarmtwin.robot import Robot
from swarmtwin.world.motion import Motion, RandomMotion
from swarmtwin.world.past_commands import PastCommands
from swarmtwin.world.scenario import Scenario, ScenarioSupply
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
        scenario: what is asked now, with the targets that are sought now; `restart` writes into its arrays.
        pose: (W, K, 3) as measured last; `restart` writes into it.
        step_count: (W,) periods since the start.
        ended: (W,) whether the roll-out is over.
        reached: (W,) whether all targets have been reached.
        past_commands: what was sent last, as far as vehicles see it.
    """

    def __init__(self, task: Task, motion: Motion, worlds: int, seed: int, compiled: bool = False) -> None:
        """Join a task and a motion of `worlds` · K vehicles, and start.

        Args:
            task: what is asked of the vehicles.
            motion: what moves them.
            worlds: how many there are side by side, W.
            seed: of the scenarios.
            compiled: measure the task by compiled code where there is some for its kind: the same to rounding, for far
                less time, once numba has been loaded.

        Raises:
            UserError: they are of different robots.
        """
        _check_same_robot(task.robot, motion.robot)
        self.task = task
        self.robot = task.robot
        self.motion = motion
        self.worlds = worlds
        self._measure = task.measure_compiled if compiled else task.measure
        self._supply = ScenarioSupply(task.draw, at_a_time=max(16, worlds), seed=seed)
        self._resting_command = self.robot.command_at_rest
        self._lowest, self._highest = (  # of the full shape: numpy is slow to repeat two numbers
            np.broadcast_to(limit, self.shape).copy() for limit in (self.robot.command_low, self.robot.command_high)
        )
        self.reset()

    @property
    def shape(self) -> tuple[int, int, int]:
        """W, K and the number of columns of a command, m."""
        return self.worlds, self.task.vehicles, len(self.robot.command)

    def reseed(self, seed: int) -> None:
        """Draw all scenarios from now on with another seed, and the motion's chances where it has any."""
        self._supply.reseed(seed)
        if isinstance(self.motion, RandomMotion):
            self.motion.reseed(seed)

    def reset(self) -> np.ndarray:
        """Start every world in a new scenario; return the observation (W, K, o)."""
        return self.start(self._supply.take(self.worlds))

    def start(self, scenario: Scenario) -> np.ndarray:
        """Start every world in the given scenario, at its first target; return the observation (W, K, o).

        Raises:
            ValueError: the scenario has another number of worlds or vehicles.
        """
        if scenario.start.shape != (self.worlds, self.task.vehicles, 3):
            raise ValueError(
                f"a scenario of starts {scenario.start.shape} for {self.worlds} × {self.task.vehicles} vehicles"
            )
        self.scenario = scenario.from_first_leg().copy()
        self.pose = self.motion.place(np.arange(self.worlds), scenario.start)
        self.past_commands = PastCommands(self.robot, self.task.config.sees_commands, self.worlds, self.task.vehicles)
        self.step_count = np.zeros(self.worlds, dtype=int)
        self.ended = np.zeros(self.worlds, dtype=bool)
        self.reached = np.zeros(self.worlds, dtype=bool)
        self._held_steps = np.zeros(self.worlds, dtype=int)
        return self.observe()

    def restart(self, worlds: np.ndarray, observation: np.ndarray | None = None) -> np.ndarray:
        """Start the worlds of a mask (W,) in new scenarios, leave the others; return the observation (W, K, o).

        Where the last step's observation is given, only what those worlds observe is written anew, into that array.
        """
        rows = np.flatnonzero(worlds)
        if len(rows):
            drawn = self._supply.take(len(rows))
            self.scenario.put(rows, drawn)
            self.pose[rows] = self.motion.place(rows, drawn.start)
            self.past_commands.forget(rows)
            for counter in (self.step_count, self.ended, self.reached, self._held_steps):
                counter[rows] = 0
        if observation is None:
            return self.observe()
        self._observe_anew(rows, observation)
        return observation

    def observe(self) -> np.ndarray:
        """Return what each vehicle observes now, (W, K, o) float32."""
        return self.observe_from(self.pose)

    def observe_from(self, pose: np.ndarray) -> np.ndarray:
        """Return what each vehicle would observe now if it were at (W, K, 3), (W, K, o) float32."""
        return self.past_commands.beside(self.task.observe(self.scenario, pose))

    def step(self, command: np.ndarray) -> Step:
        """Hold commands (W, K, m), in the robot's units, for one period; those beyond the limits are cut to them.

        Raises:
            UserError: a command or a pose is not finite.
            ValueError: the commands have another shape.
        """
        counted = ~self.ended
        command = self._bounded(command)
        pose = self.motion.move(command)
        self._check_finite(pose, "pose", "mm, mm, rad", "nothing was measured there")
        self.pose = pose if counted.all() else np.where(counted[:, None, None], pose, self.pose)
        self.step_count += counted
        self.past_commands.remember(command, counted)
        measured = self._measure(self.scenario, self.pose)
        observation = self.past_commands.beside(measured.observation)
        reward, events = measured.reward, measured.events
        if not counted.all():
            reward, events = np.where(counted[:, None], reward, 0.0), events.where(counted)
        self._observe_anew(self._follow_targets(events), observation)
        terminated = np.zeros_like(counted)
        if self.task.ends_early:
            terminated = counted & (events.collided.any(axis=1) | self.reached)
        truncated = counted & ~terminated & ((self.step_count >= self.task.steps) | measured.lost)
        self.ended = self.ended | terminated | truncated
        return Step(observation, reward, command, counted, events, self.reached.copy(), terminated, truncated)

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
            "past_commands": self.past_commands.shares.copy(),
            "random": np.array(self._supply.state()),
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
        self.past_commands.shares = state["past_commands"].copy()
        self._supply.restore(str(state["random"]))
        return self.observe()

    def _bounded(self, command: np.ndarray) -> np.ndarray:
        command = np.asarray(command, dtype=float)
        if command.shape != self.shape:
            raise ValueError(f"commands of shape {command.shape} for worlds, vehicles, columns {self.shape}")
        columns = ", ".join(self.robot.command_columns)
        self._check_finite(command, "command", columns, "the policy is broken, train it anew")
        command = np.clip(command, self._lowest, self._highest)
        command[self.ended] = self._resting_command
        return command

    def _check_finite(self, values: np.ndarray, what: str, columns: str, remedy: str) -> None:
        """Check what W · K vehicles were told or measured at, (W, K, ...), where the roll-out goes on."""
        if np.isfinite(values).all():
            return
        broken = ~np.isfinite(values).all(axis=2) & ~self.ended[:, None]
        if not broken.any():
            return
        world, vehicle = np.argwhere(broken)[0]
        given = ", ".join(f"{value:g}" for value in values[world, vehicle])
        raise UserError(
            f"world {world}, vehicle {vehicle}, step {self.step_count[world]}: the {what} ({columns}) is not finite: "
            f"{given}; {remedy}"
        )

    def _observe_anew(self, rows: np.ndarray, observation: np.ndarray) -> None:
        """Write what is observed now in the worlds at indices (n,) into the observation (W, K, o)."""
        if len(rows):
            measured = self._measure(self.scenario.where(rows), self.pose[rows])
            observation[rows] = self.past_commands.beside(measured.observation, rows)

    def _follow_targets(self, events: Events) -> np.ndarray:
        """Count the steps in a row in which all vehicles are at the target; pass on to the next one once held.

        Returns:
            (n,) indices of the worlds that pass on.
        """
        self._held_steps = np.where(events.at_target.all(axis=1), self._held_steps + 1, 0)
        held = self._held_steps >= self.task.hold_steps
        self.reached = self.reached | (held & self.scenario.on_last_leg)
        advanced = held & ~self.scenario.on_last_leg
        rows = np.flatnonzero(advanced)
        if len(rows):
            self._held_steps[rows] = 0
            self.scenario = self.scenario.advanced(advanced)
        return rows


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
