"""Where commands lead in the registered simulation, and how uncertain that is."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from swarmtwin.geometry import displacement_between, log_map
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.simulation.state import State


@dataclass(frozen=True)
class Ahead:
    """Where C candidates lead V vehicles, at M moments; the first is now.

    Attributes:
        position_mm: (C, M, V, 2) expected, in the arena's frame.
        spread_mm: (C, M, V) standard deviation along any direction.
    """

    position_mm: np.ndarray
    spread_mm: np.ndarray

    def clearance_mm(self, low_mm: np.ndarray, high_mm: np.ndarray) -> np.ndarray:
        """Return how far the vehicles are expected within a rectangle, (C, M, V), negative outside."""
        inside = np.minimum(self.position_mm - low_mm, high_mm - self.position_mm)
        clearance: np.ndarray = inside.min(axis=-1)
        return clearance

    def gap_mm(self, obstacles: np.ndarray) -> np.ndarray:
        """Return how far centres are from the nearest edge of round obstacles, (C, M − 1, V): between two moments.

        Between two moments they move straight; negative within an obstacle.

        Args:
            obstacles: (O, 3) x_mm, y_mm, radius_mm; at least one.
        """
        away = self.position_mm[..., None, :] - obstacles[:, :2]  # (C, M, V, O, 2)
        gap: np.ndarray = (_nearest_mm(away[:, :-1], np.diff(away, axis=1)) - obstacles[:, 2]).min(axis=-1)
        return gap

    def nearest_mm(self) -> tuple[np.ndarray, np.ndarray]:
        """Return how near two vehicles come between moments, (C, C, M − 1, V, V), and the spread of that.

        The first of the candidates is that of the first vehicle. Between two moments they move straight.
        """
        position, spread = self.position_mm, self.spread_mm
        apart = position[:, None, :, :, None] - position[None, :, :, None, :]  # (C, C, M, V, V, 2)
        variance = spread[:, None, 1:, :, None] ** 2 + spread[None, :, 1:, None, :] ** 2
        return _nearest_mm(apart[:, :, :-1], np.diff(apart, axis=2)), np.sqrt(variance)


def _nearest_mm(start: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Return the least distance (...) from the origin on straight ways from places (..., 2) that change by (..., 2)."""
    share = -(start * change).sum(axis=-1) / np.maximum((change**2).sum(axis=-1), 1e-12)
    nearest = start + np.clip(share, 0.0, 1.0)[..., None] * change
    distance: np.ndarray = np.sqrt((nearest**2).sum(axis=-1))
    return distance


class LookAhead:
    """Steps the simulation for many candidates at once, each a world of its own.

    Attributes:
        simulation: that is stepped, without chance.
        periods: how many; in the second one the vehicles are told to stand.
        unknown_spread: see `SafetySettings`.
    """

    def __init__(self, simulation: Simulation, periods: int, unknown_spread: float) -> None:
        self.simulation = simulation
        self.periods = periods
        self.unknown_spread = unknown_spread

    def __call__(self, state: State, commands: np.ndarray) -> Ahead:
        """Return where commands (C, V, m) lead from the state of one world."""
        with torch.inference_mode():
            worlds = state[torch.zeros(len(commands), dtype=torch.long)]
            told = torch.as_tensor(commands, dtype=torch.float64)
            positions, variances = [worlds.pose[..., :2]], [self._seen_variance(worlds.pose)]
            for period in range(self.periods):
                command = told if period == 0 else self.simulation.command_at_rest.expand_as(told)
                after = self.simulation.step(worlds, command)
                variances.append(variances[-1] + self._variance(worlds, after))
                worlds = after
                positions.append(worlds.pose[..., :2])
        return Ahead(torch.stack(positions, dim=1).numpy(), torch.stack(variances, dim=1).sqrt().numpy())

    def _seen_variance(self, pose: Tensor) -> Tensor:
        noise = self.simulation.motion_noise
        camera = 0.0 if noise is None else max(noise.camera[:2])
        return torch.full(pose.shape[:2], camera, dtype=torch.float64)

    def _variance(self, before: State, after: State) -> Tensor:
        """Return the variance (C, V) of positions in mm² that one period adds, along the worse of both axes.

        A vehicle that stands does not move by chance: what the noise has at rest counts in full from a quarter of the
        usual motion on.
        """
        shape = before.pose.shape[:2]
        twist = log_map(displacement_between(before.pose, after.pose)).flatten(0, 1)
        path2 = (twist[:, :2] ** 2).sum(dim=1)
        noise = self.simulation.motion_noise
        if noise is None:
            return (self.unknown_spread**2 * path2).reshape(shape)
        size2 = path2 / noise.usual_mm**2 + twist[:, 2] ** 2 / noise.usual_rad**2
        moving = (8.0 * size2).clamp(max=1.0)[:, None]
        at_rest, with_motion = twist.new_tensor(noise.at_rest), twist.new_tensor(noise.with_motion)
        variance = self.simulation.noise_factor**2 * (moving * at_rest + with_motion * size2[:, None])
        sideways = variance[:, 2] * path2 / 4  # by a turn that is not the one expected
        return (variance[:, :2].amax(dim=1) + sideways).reshape(shape)
