"""Where each vehicle will be when its next command takes effect.

A picture is old when its poses are known, and a command takes time to arrive. Meanwhile the vehicle goes on under the
commands before. The registered simulation carries its state along, command by command; what it says of the time between
the picture and the moment of effect is added to the pose that was measured.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from swarmtwin.geometry import compose, displacement_between, exp_map, log_map
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.simulation.state import State


@dataclass(frozen=True)
class HeldCommand:
    """A command that was in force.

    Attributes:
        from_s: when it took effect, on the monotonic clock.
        command: (V, m).
        twist: (V, 3) simulated, per nominal period: forward_mm, left_mm, turn_rad.
    """

    from_s: float
    command: np.ndarray
    twist: np.ndarray


class EffectTimePredictor:
    """Carries the simulation's state along with the vehicles, without chance.

    Attributes:
        simulation: that moves them.
        held: the commands in force lately, the newest last.
    """

    def __init__(self, simulation: Simulation, vehicles: int, remembered: int = 8) -> None:
        self.simulation = simulation
        self.held: deque[HeldCommand] = deque(maxlen=remembered)
        self._period_s = simulation.robot.period_s
        self._state: State | None = None
        self._started_s = 0.0
        self._at_rest = np.broadcast_to(simulation.command_at_rest.numpy(), (vehicles, len(simulation.robot.command)))

    def predict(self, pose: np.ndarray, captured_s: np.ndarray, effect_s: float) -> State:
        """Return one world (1, V) as it will be when the next command takes effect.

        Args:
            pose: (V, 3) as measured.
            captured_s: (V,) when; a vehicle that was not seen has NaN in both, and is predicted from before.
            effect_s: when the next command takes effect.
        """
        if self._state is None:
            self._started_s = effect_s
            self._state = self.simulation.start(self._true(pose)[None])
            return self._state
        expected = self._state.pose[0].numpy()
        moved = self.motion_between(np.where(np.isfinite(captured_s), captured_s, effect_s), effect_s)
        seen = compose(np.nan_to_num(self._true(pose).numpy()), moved)
        pose_then = np.where(np.isfinite(pose).all(axis=1)[:, None], seen, expected)
        elapsed_s = torch.full_like(self._state.elapsed_s, effect_s - self._started_s)
        return replace(self._state, pose=torch.as_tensor(pose_then)[None], elapsed_s=elapsed_s)

    def measured(self, state: State) -> np.ndarray:
        """Return the poses (V, 3) as the camera will measure them."""
        measured: np.ndarray = self.simulation.observe(state)[0].numpy()
        return measured

    def command_sent(self, state: State, command: np.ndarray, effect_s: float) -> None:
        """Go on with the commands (V, m) that take effect in a state that was predicted."""
        with torch.inference_mode():
            after = self.simulation.step(state, torch.as_tensor(command)[None])
        displacement = _displacement(state, after)
        self.held.append(HeldCommand(effect_s, np.array(command), log_map(displacement)))
        self._state = after

    def motion_between(self, start_s: np.ndarray, end_s: float | np.ndarray) -> np.ndarray:
        """Return the simulated displacements (V, 3) of true poses from moments (V,) to one or to (V,) others.

        Before the first command they stand; the last one goes on.
        """
        vehicles = len(self._at_rest)
        start_s, end_s = (np.broadcast_to(np.asarray(moment, float), vehicles) for moment in (start_s, end_s))
        moved = np.zeros((vehicles, 3))
        edges = [*[held.from_s for held in self.held][1:], np.inf]
        for held, until_s in zip(self.held, edges, strict=True):
            overlap_s = np.minimum(end_s, until_s) - np.maximum(start_s, held.from_s)
            share = np.clip(overlap_s, 0.0, None)[:, None] / self._period_s
            moved = compose(moved, exp_map(held.twist * share))
        return moved

    def command_in_force(self, at_s: float) -> np.ndarray:
        """Return the commands (V, m) in force at a moment; those of rest before the first."""
        in_force = self._at_rest
        for held in self.held:
            if held.from_s <= at_s:
                in_force = held.command
        return in_force

    def true_poses(self, measured: Sequence[np.ndarray]) -> np.ndarray:
        """Return the true poses (V, 3) behind measured ones."""
        true: np.ndarray = self._true(np.array(measured)).numpy()
        return true

    def _true(self, pose: np.ndarray) -> Tensor:
        return self.simulation.from_measured(torch.as_tensor(pose, dtype=torch.float64))


def _displacement(before: State, after: State) -> np.ndarray:
    return displacement_between(before.pose[0], after.pose[0]).numpy()
