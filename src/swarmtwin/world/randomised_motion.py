"""Worlds whose vehicles differ from roll-out to roll-out: each group has parameters of its own, drawn from ranges."""

import json

import numpy as np
import torch

from swarmtwin.simulation.randomisation import Randomisation, with_known_actuation
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.simulation.state import State
from swarmtwin.world.compiled import fastest_motion
from swarmtwin.world.motion import CheckpointedMotion

NOBODY = -1


class RandomisedMotion(CheckpointedMotion):
    """A simulation extended anew for each roll-out, by mechanisms with drawn parameters.

    A draw is a whole group of K vehicles. Worlds that start are dealt new draws. Where there are more worlds than draws
    may be at a time, they share them evenly; and since nobody joins the oldest draw, it is given up in turn.

    Attributes:
        robot: whose vehicles they are.
        simulation: what is extended.
        randomisation: by what.
        is_sampled: whether motion is drawn, or the most likely one of each group.
        parameters: (M, K, P) of each draw, vehicle by vehicle, as `Randomisation.draw` gives them.
        dealt: (W,) which of the M draws each world has.
    """

    def __init__(
        self,
        simulation: Simulation,
        randomisation: Randomisation,
        worlds: int,
        vehicles: int,
        sampled: bool | None = None,
        seed: int = 0,
    ) -> None:
        """Put `worlds` · `vehicles` at the arena's origin; `place` puts them elsewhere.

        Args:
            simulation: what is extended; what it has of a mechanism that is drawn, the drawn one replaces.
            randomisation: by what.
            worlds: how many groups are side by side, W.
            vehicles: how many there are in each, K.
            sampled: as of `SimulatedMotion`; None: motion is drawn.
            seed: of all that is drawn.
        """
        self.robot = simulation.robot
        self.simulation = with_known_actuation(simulation)
        self.randomisation = randomisation
        self.is_sampled = sampled is not False
        draws = 1 if randomisation.is_fixed else min(randomisation.draws, worlds)
        self.parameters = np.zeros((draws, vehicles, sum(len(one.ranges) for one in randomisation.mechanisms)))
        self.dealt = np.full(worlds, NOBODY)
        self._order = np.arange(draws)  # of drawing: the least is the oldest
        self.reseed(seed)
        self._groups = [randomisation.group(self.simulation, values) for values in self.parameters]
        self._deal(np.arange(worlds))
        self._state = self._start(np.arange(worlds), np.zeros((worlds, vehicles, 3)), None)

    def place(self, worlds: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Put vehicles down, each group with a draw of its own as far as there are enough."""
        self._deal(worlds)
        placed = self._start(worlds, pose, self._drawn_from)
        self._state = self._state.with_worlds(torch.as_tensor(worlds), placed)
        return self._observe(worlds, placed)

    def move(self, command: np.ndarray) -> np.ndarray:
        """Step all groups, each by its own simulation.

        Raises:
            UserError: the simulation predicts something that is not finite.
        """
        told = torch.as_tensor(command)
        everywhere = np.arange(len(self.dealt))
        with torch.inference_mode():
            rows = self._rows_of_draws(everywhere)
            stepped = [
                self._groups[draw].step(self._state[row], told[row], rng=self._drawn_from) for draw, row in rows.items()
            ]
            self._state = State.of_worlds(list(rows.values()), stepped)
        return self._observe(everywhere, self._state)

    def reseed(self, seed: int) -> None:
        """Draw everything from now on with another seed; groups under way keep their parameters."""
        self._rng = torch.Generator().manual_seed(seed)
        self._parameter_rng = np.random.default_rng(seed)

    def state(self) -> dict[str, np.ndarray]:
        """Return all that the next motion depends on, for a checkpoint."""
        return {
            **{name: values.numpy().copy() for name, values in self._state.parts().items()},
            "rng": self._rng.get_state().numpy().copy(),
            "parameter_rng": np.array(json.dumps(self._parameter_rng.bit_generator.state)),
            "parameters": self.parameters.copy(),
            "dealt": self.dealt.copy(),
            "order": self._order.copy(),
        }

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Continue from a `state` of the same worlds, vehicles and ranges.

        Raises:
            ValueError: it is of other ones.
        """
        parts = dict(state)
        if parts["pose"].shape != tuple(self._state.pose.shape):
            raise ValueError(f"a state of poses {parts['pose'].shape} does not fit {tuple(self._state.pose.shape)}")
        if parts["parameters"].shape != self.parameters.shape:
            raise ValueError(f"a state of draws {parts['parameters'].shape} does not fit {self.parameters.shape}")
        self._rng.set_state(torch.as_tensor(parts.pop("rng")))
        self._parameter_rng.bit_generator.state = json.loads(str(parts.pop("parameter_rng")))
        self.parameters, self.dealt, self._order = (parts.pop(name).copy() for name in ("parameters", "dealt", "order"))
        self._groups = [self.randomisation.group(self.simulation, values) for values in self.parameters]
        self._state = State.of_parts({name: torch.as_tensor(array) for name, array in parts.items()})

    @property
    def _drawn_from(self) -> torch.Generator | None:
        return self._rng if self.is_sampled else None

    def _deal(self, worlds: np.ndarray) -> None:
        """Give the worlds at indices (n,) new draws, or where all are taken those that fewest have, but the oldest."""
        self.dealt[worlds] = NOBODY
        users = np.bincount(self.dealt[self.dealt != NOBODY], minlength=len(self.parameters))
        in_use = np.flatnonzero(users).tolist()
        oldest = min(in_use, key=lambda draw: int(self._order[draw]), default=NOBODY)
        open_draws = [draw for draw in range(len(users)) if draw != oldest] or [oldest]
        for world in worlds:
            draw = min(open_draws, key=lambda draw: int(users[draw]))
            if not users[draw]:
                self._draw(draw)
            users[draw] += 1
            self.dealt[world] = draw

    def _draw(self, draw: int) -> None:
        self.parameters[draw] = self.randomisation.draw(self._parameter_rng, self.parameters.shape[1])
        self._groups[draw] = self.randomisation.group(self.simulation, self.parameters[draw])
        self._order[draw] = self._order.max() + 1

    def _start(self, worlds: np.ndarray, pose: np.ndarray, rng: torch.Generator | None) -> State:
        """Return the worlds at indices (n,) with vehicles that start at (n, K, 3)."""
        rows, poses = self._rows_of_draws(worlds), torch.as_tensor(pose)
        with torch.inference_mode():
            started = [self._groups[draw].start(poses[row], rng=rng) for draw, row in rows.items()]
            return State.of_worlds(list(rows.values()), started)

    def _observe(self, worlds: np.ndarray, state: State) -> np.ndarray:
        """Return what is measured (n, K, 3) of the worlds at indices (n,), in a state of these alone."""
        measured = np.empty(tuple(state.pose.shape))
        with torch.inference_mode():
            for draw, row in self._rows_of_draws(worlds).items():
                measured[row] = self._groups[draw].observe(state[row], self._drawn_from).numpy()
        return measured

    def _rows_of_draws(self, worlds: np.ndarray) -> dict[int, torch.Tensor]:
        """Return which of the worlds at indices (n,) have each draw, (r,) of these n, by draw."""
        dealt = self.dealt[worlds]
        return {int(draw): torch.as_tensor(np.flatnonzero(dealt == draw)) for draw in np.unique(dealt)}


def motion_in(
    simulation: Simulation,
    worlds: int,
    vehicles: int,
    sampled: bool | None = None,
    seed: int = 0,
    randomisation: Randomisation | None = None,
) -> CheckpointedMotion:
    """Return what moves W · K vehicles in a simulation, the same one in all worlds unless there is a randomisation.

    Raises:
        UserError: motion is to be drawn, and the simulation does not know of anything random.
    """
    if randomisation is None:
        return fastest_motion(simulation, worlds, vehicles, sampled, seed)
    return RandomisedMotion(simulation, randomisation, worlds, vehicles, sampled, seed)
