"""The last commands of vehicles, as these observe them: who knows what it has sent can live with a delay.

A command that acts late is still under way when the next one is chosen, and no pose shows it.
"""

import numpy as np

from swarmtwin.robot import Robot


def past_command_names(robot: Robot, count: int) -> tuple[str, ...]:
    """Names of what `PastCommands` adds to an observation; command 1 is the newest."""
    return tuple(f"command_{ago}_{column}" for ago in range(1, count + 1) for column in robot.command_columns)


class PastCommands:
    """The last n commands of W · K vehicles; before the first one vehicles were at rest.

    Attributes:
        shares: (W, K, n · m) float32, the newest command first, each column as a share −1…1 of its limits.
    """

    def __init__(self, robot: Robot, count: int, worlds: int, vehicles: int) -> None:
        self._middle = (robot.command_high + robot.command_low) / 2
        self._half = (robot.command_high - robot.command_low) / 2
        self._at_rest = np.tile(self._share(robot.command_at_rest), count)
        self.shares = np.tile(self._at_rest, (worlds, vehicles, 1))

    def forget(self, worlds: np.ndarray) -> None:
        """Let the vehicles of the worlds at indices (n,) have been at rest."""
        self.shares[worlds] = self._at_rest

    def remember(self, command: np.ndarray, worlds: np.ndarray) -> None:
        """Take notice of commands (W, K, m), within the limits, that were sent in the worlds of a mask (W,)."""
        if not self.shares.size:
            return
        newest_first = np.concatenate([self._share(command), self.shares], axis=-1)[..., : self.shares.shape[-1]]
        self.shares = np.where(worlds[:, None, None], newest_first, self.shares)

    def beside(self, observation: np.ndarray, worlds: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Return observations (n, K, o) in the worlds at indices (n,), all of them if none are given, with these."""
        return np.concatenate([observation, self.shares[worlds]], axis=-1) if self.shares.size else observation

    def _share(self, command: np.ndarray) -> np.ndarray:
        share: np.ndarray = ((command - self._middle) / self._half).astype(np.float32)
        return share
