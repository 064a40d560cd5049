"""What a stand-in's physics provides, and how it is advanced over one control period."""

import zlib
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np

from swarmtwin.geometry import rotate
from swarmtwin.plugins import PluginRegistry
from swarmtwin.standin import robots
from swarmtwin.standin.active_effects import ActiveEffects
from swarmtwin.standin.character import Character
from swarmtwin.standin.effect import Placement


class Surroundings(NamedTuple):
    """What ground, water and neighbours do to the vehicles in one time step; each broadcasts to (...)."""

    traction: Any = 1.0
    carried_x_mm_s: Any = 0.0
    carried_y_mm_s: Any = 0.0


class Unit(ABC):
    """What differs from one unit of a robot to the next, by fabrication: arrays that broadcast to V vehicles."""

    @classmethod
    @abstractmethod
    def of(cls, vehicles: Sequence[str], dtype: Any = np.float64) -> Self:
        """Return the units with these V ids; the same id always gives the same unit."""


class Physics(ABC):
    """A robot's motion. A state is (states, ...), its first three the true pose: x_mm, y_mm, heading_rad (not wrapped).

    Attributes:
        unit: the vehicles' own properties.
        conditions: the effects that are switched on.
        unit_class: what its units are.
        command_columns: of the commands that it takes, in order.
        states: names of the states.
        substeps: time steps in a control period.
        noises: independent random numbers that a time step needs.
        position_noise_mm: standard deviation of the camera's positions, along each axis.
        heading_noise_rad: standard deviation of the camera's headings.
        resting_command: the command of a vehicle that was just switched on.
        memory_of_place: whether the hidden states depend on the pose.
        latent_draws: hidden states to average over for an expectation, a power of two.
        noise_draws: motions to average over where the state is known, even.
        bank_rows: hidden states, at least, to draw from for an expectation.
        unruly: what is always there where the session's character is `unruly`.
        published: (low, high) of each command column, and how many levels it has there (None: any), as the paper's
            authors drove the robot; None: over its limits.
        glued_mm: (V, 2) how far ahead of each vehicle's centre and to its left its marker always sits.
    """

    unit: Unit
    unit_class: ClassVar[type[Unit]]
    command_columns: ClassVar[tuple[str, ...]]
    states: ClassVar[tuple[str, ...]]
    substeps: ClassVar[int]
    noises: ClassVar[int]
    position_noise_mm: ClassVar[float]
    heading_noise_rad: ClassVar[float]
    resting_command: ClassVar[tuple[float, ...]]
    memory_of_place: ClassVar[bool]
    latent_draws: ClassVar[int]
    noise_draws: ClassVar[int] = 32
    bank_rows: ClassVar[int] = 131_072
    unruly: ClassVar[Character] = Character()
    published: ClassVar[tuple[tuple[float, float, int | None], ...] | None] = None

    def __init__(self, unit: Unit, conditions: ActiveEffects) -> None:
        self.unit = unit
        self.conditions = conditions
        self.glued_mm = np.zeros((1, 2))

    @classmethod
    def of(cls, vehicles: Sequence[str], conditions: ActiveEffects, dtype: type = np.float64) -> Self:
        """Return the physics of the units with these ids, under conditions; properties are of a floating `dtype`."""
        physics = cls(cls.unit_class.of(vehicles, dtype), conditions)
        physics.glued_mm = _glued_mm(conditions, vehicles).astype(dtype)
        return physics

    def seen(self, pose: np.ndarray, progress: Any = 0.0) -> np.ndarray:
        """Return true poses (..., V, 3) as a camera without noise would measure them; `progress` is (..., V)."""
        if self.glued_mm.any():
            offset = np.broadcast_to(self.glued_mm, pose[..., :2].shape)
            pose = np.concatenate([pose[..., :2] + rotate(offset, pose[..., 2]), pose[..., 2:]], axis=-1)
        return self.conditions.seen(pose, progress)

    def at_rest(self, pose: np.ndarray) -> np.ndarray:
        """Return the states (states, ...) of vehicles standing at poses (3, ...), and at their end effects' memory."""
        still = np.zeros((len(self.states) - 3, *pose.shape[1:]), pose.dtype)
        return np.concatenate([pose, still, self.conditions.initial_memory(pose)])

    @abstractmethod
    def target(self, command: np.ndarray, strength: Any) -> np.ndarray:
        """Return what a command (m, ...), as the electronics take it, asks of the actuators; it may be blended."""

    @abstractmethod
    def step(
        self,
        state: np.ndarray,
        target: np.ndarray,
        dt_s: Any,
        surroundings: Surroundings,
        noise: np.ndarray | None,
    ) -> np.ndarray:
        """Return the states after one time step; `noise` is (noises, ...) standard normal, or None for the mean."""

    @abstractmethod
    def guess(self, command: np.ndarray) -> np.ndarray:
        """Return the displacement (..., 3) that the operator expects of commands (..., m), from experience."""


@dataclass(frozen=True)
class Period:
    """One control period of vehicles (...), or of many imagined ones.

    Attributes:
        command: (m, ...) that holds in it.
        previous_command: (m, ...) that held before; it goes on while the new one is late.
        duration_s: true length, broadcasting to (...).
        progress: share of the session that has passed, broadcasting to (...).
        others: (2, 2, others, ...) x and y of the neighbours at its start and at its end, or None to derive them from
            the vehicles themselves, which then are (runs, vehicles).
    """

    command: np.ndarray
    previous_command: np.ndarray
    duration_s: Any
    progress: Any
    others: np.ndarray | None = None

    def placement(self, state: np.ndarray, elapsed: float) -> Placement:
        """Return where and when the vehicles are when a share `elapsed` of the period has passed."""
        if self.others is None:
            x_mm, y_mm = others_in_run(state[0]), others_in_run(state[1])
        else:
            x_mm, y_mm = self.others[0] + elapsed * (self.others[1] - self.others[0])
        sent = self.command, self.previous_command
        return Placement(self.progress, state[0], state[1], state[2], x_mm, y_mm, *sent)


def others_in_run(values: np.ndarray) -> np.ndarray:
    """Return for each of V vehicles (..., V) the values of the other ones, (V − 1, ..., V)."""
    others = [np.roll(values, -shift, axis=-1) for shift in range(1, values.shape[-1])]
    return np.stack(others) if others else np.empty((0, *values.shape), values.dtype)


def advance(physics: Physics, state: np.ndarray, period: Period, noise: np.ndarray | None = None) -> np.ndarray:
    """Return the states (states, ...) at the end of a period.

    Args:
        physics: the robot.
        state: (states, ...) at its start.
        period: the commands and the clock.
        noise: (substeps, noises, ...) standard normal, or None for the motion without noise.
    """
    conditions = physics.conditions
    dt_s = period.duration_s / physics.substeps
    strength = conditions.strength(period.placement(state, 0.0))
    target = new_target = physics.target(conditions.transform_command(period.command), strength)
    if conditions.delay_s:
        old_target = physics.target(conditions.transform_command(period.previous_command), strength)
    surroundings = Surroundings()
    for index in range(physics.substeps):
        if conditions.delay_s:
            late_share = np.clip(conditions.delay_s / dt_s - index, 0.0, 1.0)
            target = new_target + late_share * (old_target - new_target)
        if conditions.are_local:
            placement = period.placement(state, index / physics.substeps)
            surroundings = Surroundings(conditions.traction(placement), *conditions.drift_velocity_mm_s(placement))
        state = physics.step(state, target, dt_s, surroundings, None if noise is None else noise[index])
    return state


def take_up(slack: np.ndarray, travel: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the slack left in a gear of backlash `width`, and the part of `travel` that comes through."""
    taken = np.clip(slack + travel, 0.0, width)
    return taken, travel - (taken - slack)


def _glued_mm(conditions: ActiveEffects, vehicles: Sequence[str]) -> np.ndarray:
    """Return where the markers of vehicles (V, 2) sit by the robot's character and the hand that glued them."""
    character = conditions.character
    offset_mm = np.tile(np.array(character.marker_mm, float), (len(vehicles), 1))
    for index, vehicle in enumerate(vehicles):
        rng = np.random.default_rng(zlib.crc32(f"{conditions.robot.name}/{vehicle}/marker".encode()))
        offset_mm[index] += character.marker_spread_mm * rng.standard_normal(2)
    return offset_mm


def fabricate(
    robot: str, vehicles: Sequence[str], spreads: Mapping[str, float], largest_deviation: float = 2.0
) -> dict[str, np.ndarray]:
    """Draw each property's relative factor for each vehicle.

    Args:
        robot: name of the robot.
        vehicles: V ids.
        spreads: relative standard deviation of each property.
        largest_deviation: in standard deviations; what lies beyond is not delivered.

    Returns:
        for each property its factors (V,), 1 where the unit is as drawn.
    """
    factors = np.ones((len(spreads), len(vehicles)))
    for index, vehicle in enumerate(vehicles):
        rng = np.random.default_rng(zlib.crc32(f"{robot}/{vehicle}".encode()))
        deviation = np.clip(rng.standard_normal(len(spreads)), -largest_deviation, largest_deviation)
        factors[:, index] += deviation * np.fromiter(spreads.values(), float)
    return dict(zip(spreads, factors, strict=True))


STAND_INS: PluginRegistry[Physics] = PluginRegistry(robots, "stand-in", group="robot", ends_in="StandIn")
