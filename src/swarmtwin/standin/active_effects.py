"""All effects that are switched on, combined: the shared machine that runs them."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from swarmtwin.geometry import rotate
from swarmtwin.robot import Robot
from swarmtwin.standin.character import Character
from swarmtwin.standin.effect import Effect, Placement, Rng, Stroke


class ActiveEffects:
    """What the physics asks for at each of its places. Without effects every answer is neutral.

    Attributes:
        delay_s: how late each command arrives.
        loss_probability: how probably a command never arrives.
        lost_in_a_row: how many are lost one after the other, on average; 0 where each is lost by itself.
        lag_s: what is added to the actuators' time constant.
        backlash: travel lost at each reversal, mm or rad.
        trim_rad: angle of the fin when it is told to be straight.
        noise_factor: factor on the random part of the motion.
        ages: whether anything changes as the session goes on.
    """

    def __init__(self, robot: Robot, effects: Sequence[Effect] = (), character: Character | None = None) -> None:
        self.robot = robot
        self.effects = tuple(effects)
        self.character = character or Character()
        self.delay_s = self.character.delay_s + sum(effect.command_delay_s() for effect in effects)
        arriving = [1.0 - self.character.loss_probability, *(1.0 - effect.loss_probability() for effect in effects)]
        self.loss_probability = 1.0 - float(np.prod(arriving))
        self.lost_in_a_row = max((effect.lost_in_a_row() for effect in effects), default=0.0)
        self.lag_s = sum(effect.lag_s() for effect in effects)
        self.backlash = sum(effect.backlash() for effect in effects)
        self.trim_rad = sum(effect.trim_rad() for effect in effects)
        self.noise_factor = float(np.prod([self.character.noise_factor, *(one.noise_factor() for one in effects)]))
        self.ages = any(effect.ages for effect in effects)
        self._strength = self._overriding("strength")
        self._grip = self._overriding("traction")
        self._carried = self._overriding("drift_velocity_mm_s")
        self._aimed = self._overriding("aimed_speed")
        self._rolling = self._overriding("roll")
        self._magnification = self._overriding("magnification")
        self._pictures = self._overriding("picture")
        self._clocks = self._overriding("clock_rate")
        self._marker = np.sum([effect.marker() for effect in effects] or [(0.0, 0.0, 0.0)], axis=0)

    def _overriding(self, hook: str) -> tuple[Effect, ...]:
        return tuple(effect for effect in self.effects if getattr(type(effect), hook) is not getattr(Effect, hook))

    @property
    def are_local(self) -> bool:
        """Whether the motion depends on where the vehicle is or goes, or on its neighbours."""
        return bool(self._grip or self._carried)

    @property
    def rolls(self) -> bool:
        """Whether an effect changes how far wheels come, or remembers how far they came."""
        return bool(self._rolling)

    def lost(self, chance: np.ndarray, before: np.ndarray | None) -> np.ndarray:
        """Say which commands (...) never arrive in a period.

        Args:
            chance: (...) drawn evenly from 0 to 1.
            before: (...) which were lost in the period before; None where nothing was sent before.
        """
        if before is None or not self.lost_in_a_row:
            return chance < self.loss_probability
        goes_on = 1.0 - 1.0 / self.lost_in_a_row
        begins = self.loss_probability * (1.0 - goes_on) / (1.0 - self.loss_probability)
        return chance < np.where(before, goes_on, begins)

    def transform_command(self, command: np.ndarray) -> np.ndarray:
        """Return what the electronics make of commands (m, ...)."""
        for effect in self.effects:
            command = effect.transform_command(command, self.robot)
        return command

    def strength(self, placement: Placement) -> Any:
        """Return the factor on the actuators' speed, broadcasting to (actuators, ...)."""
        factor: Any = 1.0
        for effect in self._strength:
            factor = factor * effect.strength(placement)
        return factor

    def initial_memory(self, pose: np.ndarray) -> np.ndarray:
        """Return what all effects remember (memory, ...) of vehicles that are switched on at poses (3, ...)."""
        none = np.empty((0, *pose.shape[1:]), pose.dtype)
        return np.concatenate([none, *(effect.initial_memory(pose) for effect in self._rolling)])

    def aimed_speed(self, target: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Return the speed (actuators, ...) that wheels tend to."""
        for effect in self._aimed:
            target = effect.aimed_speed(target, speed)
        return target

    def roll(self, stroke: Stroke, memory: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return how far the wheels (actuators, ...) come, and what all effects (memory, ...) remember next."""
        travel, after, first = stroke.travel, memory.copy(), 0
        for effect in self._rolling:
            own = slice(first, first + effect.memory)
            factor, after[own] = effect.roll(stroke, memory[own])
            travel, first = travel * factor, own.stop
        return travel, after

    def traction(self, placement: Placement) -> Any:
        """Return the factor on how far the actuators bring the vehicle, broadcasting to (...)."""
        factor: Any = 1.0
        for effect in self._grip:
            factor = factor * effect.traction(placement, self.robot.arena_mm)
        return factor

    def drift_velocity_mm_s(self, placement: Placement) -> tuple[Any, Any]:
        """Return the velocity along x and y of the arena that is added to the vehicle's own."""
        x_mm_s: Any = 0.0
        y_mm_s: Any = 0.0
        for effect in self._carried:
            more_x, more_y = effect.drift_velocity_mm_s(placement)
            x_mm_s, y_mm_s = x_mm_s + more_x, y_mm_s + more_y
        return x_mm_s, y_mm_s

    def durations(self, nominal: np.ndarray, rng: Rng) -> np.ndarray:
        """Return the lengths of periods, as the recording's clock shows them."""
        for effect in self.effects:
            nominal = effect.durations(nominal, rng)
        if self.character.jitter:
            nominal = nominal * (1.0 + self.character.jitter * np.clip(rng.standard_normal(nominal.shape), -3.0, 3.0))
        return nominal

    def clock_rate(self, progress: Any) -> Any:
        """Return how fast the recording's clock goes."""
        rate: Any = 1.0
        for effect in self._clocks:
            rate = rate * effect.clock_rate(progress)
        return rate

    def seen(self, pose: np.ndarray, progress: Any = 0.0) -> np.ndarray:
        """Return true poses (..., 3) as a camera without noise would measure them; `progress` broadcasts to (...)."""
        if self._magnification or self._marker.any():
            forward_mm, left_mm, turn_rad = self._marker.tolist()
            offset = np.broadcast_to(np.array([forward_mm, left_mm], pose.dtype), pose[..., :2].shape)
            position = pose[..., :2] + rotate(offset, pose[..., 2])
            if self._magnification:
                position = self._through_lens(position)
            pose = np.concatenate([position, pose[..., 2:] + turn_rad], axis=-1)
        for effect in self._pictures:
            pose = effect.picture(pose, progress)
        return pose

    def _through_lens(self, position_mm: np.ndarray) -> np.ndarray:
        arena = self.robot.arena_mm
        centre = ((arena.low_mm + arena.high_mm) / 2).astype(position_mm.dtype)
        corner_mm = float(np.linalg.norm(arena.high_mm - arena.low_mm)) / 2
        from_centre = position_mm - centre
        radius = np.sqrt(np.sum(from_centre**2, axis=-1, keepdims=True)) / corner_mm
        for effect in self._magnification:
            from_centre = from_centre * effect.magnification(radius)
        return centre + from_centre
