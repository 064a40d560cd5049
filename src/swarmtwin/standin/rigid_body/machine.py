"""What a robot provides to be moved by the rigid-body engine, MuJoCo, and how it is advanced over a control period."""

import copy
import importlib
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np

from swarmtwin.errors import UserError
from swarmtwin.geometry import rotate, wrap_angle
from swarmtwin.standin.active_effects import ActiveEffects
from swarmtwin.standin.effect import Effect
from swarmtwin.standin.effects.steady_drift import SteadyDrift
from swarmtwin.standin.physics import Period


def load_engine() -> Any:
    """Return MuJoCo, which is needed nowhere else.

    Raises:
        UserError: it is not installed.
    """
    try:
        return importlib.import_module("mujoco")
    except ImportError:
        raise UserError(
            "engine=rigid_body needs MuJoCo, which is not installed: pip install 'mujoco>=4.0.0,<5', "
            "or drive the stand-in by its formulas, engine=formulas"
        ) from None


class Moment(NamedTuple):
    """Where the vehicles are in the engine at the beginning of a piece of a period.

    Attributes:
        period: which control period.
        pose: (3, R, V) x_mm, y_mm, heading_rad.
        position: (R, V, positions) the joints' positions, SI units.
        velocity: (R, V, velocities) the joints' velocities, SI units.
        noise: (noises, R, V) standard normal.
        piece_s: length of the piece, broadcasting to (R, V).
    """

    period: Period
    pose: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    noise: np.ndarray
    piece_s: Any


class Machine(ABC):
    """V units of a robot, each described to the engine, in R runs side by side; vehicles of a run do not touch.

    The engine's state is carried on from period to period. Commands reach its actuators step by step; what depends on
    the place, and chance, piece by piece of a period.

    Attributes:
        command_columns: of the commands that it takes, in order.
        resting_command: the command of a vehicle that was just switched on.
        steps: time steps in a control period.
        pieces: pieces in a control period, which divide the steps.
        noises: independent random numbers that a piece needs.
        camera_noise: standard deviation of the camera's poses, mm, mm and rad.
        outlier_share: share of poses that the camera measures worse.
        outlier_factor: by how much worse.
        supply: the effects that change what the actuators are supplied with.
        factor: of each property that differs by fabrication, over what is on the drawing, (V,).
        settling_steps: time steps until what is put on the floor has come to rest.
    """

    supply: ActiveEffects
    factor: dict[str, np.ndarray]
    command_columns: ClassVar[tuple[str, ...]]
    resting_command: ClassVar[tuple[float, ...]]
    steps: ClassVar[int]
    pieces: ClassVar[int]
    noises: ClassVar[int]
    camera_noise: ClassVar[tuple[float, float, float]]
    outlier_share: ClassVar[float] = 0.05
    outlier_factor: ClassVar[float] = 3.0
    settling_steps: ClassVar[int] = 100

    def __init__(self, vehicles: Sequence[str], conditions: ActiveEffects, period_s: float) -> None:
        """Describe the units with these ids.

        Raises:
            UserError: an effect means nothing to such a body, or the engine is not installed.
        """
        self.vehicles = tuple(vehicles)
        self.conditions = conditions
        self.supply = conditions
        self.time_step_s = period_s / self.steps
        for effect in conditions.effects:
            self.require_meaning(effect)
        self._engine = load_engine()

    def require_meaning(self, effect: Effect) -> None:
        """Refuse an effect that cannot be had from forces on this body.

        Raises:
            UserError: what carries the vehicles is neither a floor nor a stream of one velocity.
        """
        carries = type(effect).drift_velocity_mm_s is not Effect.drift_velocity_mm_s
        if carries and not isinstance(effect, SteadyDrift):
            raise UserError(
                f"effect {type(effect).__name__!r} gives vehicles a velocity, whatever wheels or water make of it: "
                "that is no force on a rigid body; use engine=formulas for it"
            )

    @property
    def carrying_mm_s(self) -> tuple[float, float]:
        """Velocity along x and y of the arena of the floor, or of the water."""
        drifts = [effect for effect in self.conditions.effects if isinstance(effect, SteadyDrift)]
        velocity = np.array([(each.speed_mm_s, each.direction_rad) for each in drifts]).reshape(-1, 2)
        x_mm_s, y_mm_s = velocity[:, 0] * np.cos(velocity[:, 1]), velocity[:, 0] * np.sin(velocity[:, 1])
        return float(x_mm_s.sum()), float(y_mm_s.sum())

    @abstractmethod
    def describe(self, vehicle: int) -> str:
        """Return the MJCF description of one of the V units, in SI units, time step `time_step_s`."""

    def resting_control(self, control: np.ndarray) -> np.ndarray:
        """Return the engine's controls (V, controls) of units that stand; `control` are those of nothing."""
        return control

    @abstractmethod
    def at_pose(self, pose: np.ndarray, position: np.ndarray) -> np.ndarray:
        """Return joint positions (R, V, positions), at rest at `position`, brought to poses (R, V, 3)."""

    @abstractmethod
    def pose(self, position: np.ndarray) -> np.ndarray:
        """Return poses (3, R, V), headings wrapped, of joint positions (R, V, positions)."""

    @abstractmethod
    def target(self, command: np.ndarray, strength: Any) -> np.ndarray:
        """Return what a command (m, R, V), as the electronics take it, asks of the actuators; it may be blended."""

    @abstractmethod
    def controls(self, target: np.ndarray, moment: Moment) -> np.ndarray:
        """Return the engine's controls (R, V, steps, controls) for targets (targets, steps, R, V) of a piece."""

    def altered(self, factors: Mapping[str, float], effects: Sequence[Effect] = ()) -> Self:
        """Return the same units with properties multiplied: of fabrication, or any number that describes the body.

        Raises:
            UserError: an effect means nothing to such a body.
        """
        conditions = ActiveEffects(self.conditions.robot, effects, self.conditions.character)
        other = type(self)(self.vehicles, conditions, self.time_step_s * self.steps)
        for name, factor in factors.items():
            if name in self.factor:
                other.factor[name] = self.factor[name] * factor
            else:
                setattr(other, name, getattr(self, name) * factor)
        return other

    def put(self, pose: np.ndarray) -> np.ndarray:
        """Put the vehicles down at poses (R, V, 3) and return their states.

        Returns:
            (states, R, V): x_mm, y_mm, heading_rad, then positions and velocities of all joints in SI units.
        """
        runs, units = pose.shape[:2]
        models = [self._engine.MjModel.from_xml_string(self.describe(vehicle)) for vehicle in range(units)]
        settled, arena = self._batch(models), self.conditions.robot.arena_mm
        settled.bind("qpos")[:, :2] = (arena.low_mm + arena.high_mm) / 2000  # away from walls, which would push it
        settled.bind("qvel")[:, :2] = np.array(self.carrying_mm_s) / 1000
        control = settled.bind("ctrl")
        control[:] = self.resting_control(control)
        settled.rollout(self.settling_steps)
        self._settled = settled.bind("qpos").copy(), settled.bind("qvel").copy()
        self._models = models * runs
        self._vehicles = self._batch(self._models)
        self._shape = (runs, units)
        return self.put_back(np.arange(runs), pose)

    def put_back(self, runs: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Put the vehicles of the runs at indices (n,) down anew, at poses (n, V, 3); the others go on.

        Returns:
            (states, n, V) as of `put`.
        """
        position, velocity = self._joints()
        settled, moving = self._settled
        position[runs] = self.at_pose(pose, np.broadcast_to(settled, (len(runs), *settled.shape)))
        velocity[runs] = moving
        return self._state_of(position[runs], velocity[runs], np.moveaxis(pose, -1, 0))

    def _batch(self, models: Sequence[Any]) -> Any:
        batch = importlib.import_module("mujoco.batch").Batch(models[0], len(models), 1)
        batch.set_models(models)
        return batch

    def advance(self, state: np.ndarray, period: Period, noise: np.ndarray) -> np.ndarray:
        """Return the states (states, R, V) after a control period that begins where the last one ended.

        Args:
            state: (states, R, V) that `put` or the last `advance` returned.
            period: the commands and the clock.
            noise: (pieces, noises, R, V) standard normal.
        """
        placement = period.placement(state, 0.0)
        strength = self.supply.strength(placement)
        new = self.target(self.conditions.transform_command(period.command), strength)
        old = self.target(self.conditions.transform_command(period.previous_command), strength)
        step_s = period.duration_s / self.steps
        self._keep_time(step_s)
        per_piece = self.steps // self.pieces
        for piece in range(self.pieces):
            step = np.arange(piece * per_piece, (piece + 1) * per_piece)[:, None, None]
            late_share = np.clip(self.conditions.delay_s / step_s - step, 0.0, 1.0)
            target = new[:, None] + late_share * (old - new)[:, None]
            moment = Moment(period, state[:3], *self._joints(), noise[piece], step_s * per_piece)
            control = self.controls(np.broadcast_to(target, (len(new), per_piece, *self._shape)), moment)
            self._vehicles.rollout(per_piece, control.reshape(-1, *control.shape[2:]))
            state = self._state(state[:3])
        return state

    def carried_to(self, pose: np.ndarray, state: np.ndarray) -> np.ndarray:
        """Return the states (states, R, V) after vehicles were carried to poses (R, V, 3), moving on as they did.

        `state` is what `put` or `advance` returned last; velocities stay as they are, seen from the vehicle.
        """
        heading_rad = state[2]
        position, velocity = (joints.copy() for joints in self._joints())
        back = np.stack([np.zeros(self._shape), np.zeros(self._shape), -heading_rad], axis=-1)
        position = self.at_pose(pose, self.at_pose(back, position))
        velocity[..., :2] = rotate(velocity[..., :2], pose[..., 2] - heading_rad)
        self._vehicles.bind("qpos")[:] = position.reshape(-1, position.shape[-1])
        self._vehicles.bind("qvel")[:] = velocity.reshape(-1, velocity.shape[-1])
        return self._state(np.moveaxis(pose, -1, 0))

    def _keep_time(self, step_s: np.ndarray) -> None:
        """Give each run the time step (R, 1) that fits its period."""
        wanted = np.repeat(step_s[:, 0], self._shape[1])
        if np.allclose(wanted, [model.opt.timestep for model in self._models], rtol=1e-12, atol=0.0):
            return
        if len({id(model) for model in self._models}) < len(self._models):
            self._models = [copy.copy(model) for model in self._models]
        for model, time_step_s in zip(self._models, wanted, strict=True):
            model.opt.timestep = time_step_s
        self._vehicles.set_models(self._models)

    def _joints(self) -> tuple[np.ndarray, np.ndarray]:
        position, velocity = self._vehicles.bind("qpos"), self._vehicles.bind("qvel")
        return position.reshape(*self._shape, -1), velocity.reshape(*self._shape, -1)

    def _state(self, pose_before: np.ndarray) -> np.ndarray:
        """Return the states (states, R, V), headings going on from poses (3, R, V) before.

        Raises:
            ArithmeticError: the engine warns that it lost a vehicle, and no longer moves it.
        """
        if self._vehicles.warning.any():
            raise ArithmeticError("the rigid-body engine became unstable: its time step is too long for this body")
        return self._state_of(*self._joints(), pose_before)

    def _state_of(self, position: np.ndarray, velocity: np.ndarray, pose_before: np.ndarray) -> np.ndarray:
        """Return the states (states, n, V) of joints (n, V, positions) and (n, V, velocities)."""
        pose = self.pose(position)
        pose[2] = pose_before[2] + wrap_angle(pose[2] - pose_before[2])
        return np.concatenate([pose, np.moveaxis(position, -1, 0), np.moveaxis(velocity, -1, 0)])
