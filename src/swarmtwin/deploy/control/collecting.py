"""Drives that record a vehicle: random, gentle or planned commands, led back where they come near the fence."""

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import torch

from swarmtwin.robot import Arena, Robot
from swarmtwin.simulation.simulation import Simulation

CollectMode = Literal["uniform", "gentle", "held"]


class CollectingDriver:
    """Commands over the limits for one run; near the fence the one of some random ones that leads back best."""

    def __init__(
        self,
        robot: Robot,
        arena: Arena,
        simulation: Simulation,
        vehicles: int,
        mode: CollectMode,
        rng: np.random.Generator,
        drive: np.ndarray | None = None,
        choices: int = 12,
        held_periods: int = 4,
        edge_share: float = 0.2,
        apart_mm: float = 250.0,
    ) -> None:
        """Prepare.

        Args:
            robot: what is driven.
            arena: whose border is the fence.
            simulation: says where a command leads.
            vehicles: how many, V.
            mode: uniform over the limits; gentle, over their inner half; held for a while each.
            rng: draws them.
            drive: (N, m) planned commands instead, the same for all vehicles.
            choices: random commands to choose from where a vehicle is led back.
            held_periods: in mode held.
            edge_share: of the arena's shorter side: nearer to the border than this a vehicle is led back.
            apart_mm: and so are vehicles nearer to each other than this, away from each other.
        """
        self._robot, self._arena, self._simulation, self._rng = robot, arena, simulation, rng
        self._vehicles, self._mode, self._drive = vehicles, mode, drive
        self._choices, self._held_periods, self._apart_mm = choices, held_periods, apart_mm
        self._margin_mm = edge_share * float(np.min(arena.high_mm - arena.low_mm))
        self._period = 0
        self._held = np.zeros((vehicles, len(robot.command)))
        self.led_back = 0

    def start(self, pose: np.ndarray) -> None:
        """Begin with vehicles at (V, 3)."""
        self._period = 0

    def decide(self, pose: np.ndarray) -> np.ndarray:
        """Return the commands (V, m) wanted."""
        wanted = self._wanted()
        goal_mm, needs = self._where_to(pose)
        if needs.any():
            led = self._leading_to(pose, goal_mm)
            wanted = np.where(needs[:, None], led, wanted)
            self.led_back += int(needs.sum())
        self._period += 1
        return wanted

    def moved(self, command: np.ndarray, pose: np.ndarray) -> str | None:
        """Return why all is done: a planned drive ends."""
        if self._drive is not None and self._period >= len(self._drive):
            return "the planned drive is over"
        return None

    def shown(self) -> Mapping[str, Any]:
        """Return how often vehicles were led back."""
        return {"led_back": self.led_back}

    def _wanted(self) -> np.ndarray:
        if self._drive is not None:
            return np.tile(self._drive[min(self._period, len(self._drive) - 1)], (self._vehicles, 1))
        if self._mode != "held" or self._period % self._held_periods == 0:
            self._held = self._drawn((self._vehicles,))
        return self._held

    def _drawn(self, shape: tuple[int, ...]) -> np.ndarray:
        low, high = self._robot.command_low, self._robot.command_high
        if self._mode == "gentle":
            low, high = low + (high - low) / 4, high - (high - low) / 4
        drawn: np.ndarray = self._rng.uniform(low, high, (*shape, len(low)))
        return drawn

    def _where_to(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return where each vehicle would be led (V, 2), and whether it has to be, (V,)."""
        position = pose[:, :2]
        low, high = self._arena.low_mm + self._margin_mm, self._arena.high_mm - self._margin_mm
        goal = np.tile((low + high) / 2, (self._vehicles, 1))
        needs: np.ndarray = np.any((position < low) | (position > high), axis=1)
        away = position[:, None] - position[None]
        apart = np.hypot(away[..., 0], away[..., 1]) + np.where(np.eye(self._vehicles, dtype=bool), np.inf, 0.0)
        if self._vehicles > 1:
            nearest = apart.argmin(axis=1)
            crowded = apart.min(axis=1) < self._apart_mm
            aside = position + away[np.arange(self._vehicles), nearest]
            goal = np.where((crowded & ~needs)[:, None], np.clip(aside, low, high), goal)
            needs = np.logical_or(needs, crowded)
        return goal, needs

    def _leading_to(self, pose: np.ndarray, goal_mm: np.ndarray) -> np.ndarray:
        """Return of some random commands those (V, m) that lead nearest to places (V, 2) when held for a while."""
        choices = self._drawn((self._choices, self._vehicles))
        with torch.inference_mode():
            state = self._simulation.start(torch.as_tensor(np.broadcast_to(pose, (self._choices, *pose.shape)).copy()))
            for _ in range(3):
                state = self._simulation.step(state, torch.as_tensor(choices))
        left_mm = np.linalg.norm(state.pose[..., :2].numpy() - goal_mm, axis=-1)
        return choices[left_mm.argmin(axis=0), np.arange(self._vehicles)]
