"""Vehicles of one world that are not built alike: each is moved by a simulation of its own."""

from collections.abc import Sequence

import torch
from torch import Tensor

from swarmtwin.simulation.simulation import Simulation
from swarmtwin.simulation.state import State


class UnlikeVehicles:
    """K simulations, one for each vehicle of a world, stepped as one simulation is.

    They differ in the parameters of their mechanisms alone; clock, session and the sight of each other are shared.

    Attributes:
        simulations: of vehicles 0 to K − 1.
    """

    def __init__(self, simulations: Sequence[Simulation]) -> None:
        self.simulations = tuple(simulations)

    def start(self, pose: Tensor, rng: torch.Generator | None = None) -> State:
        """Put vehicles down at (W, K, 3), as `Simulation.start` does; a world is at one moment of the session."""
        elapsed_s = self.simulations[0].start(pose, rng=rng).elapsed_s
        return State.side_by_side(
            [
                simulation.start(pose[:, own], elapsed_s[:, own])
                for own, simulation in zip(self._columns(), self.simulations, strict=True)
            ]
        )

    def step(self, state: State, command: Tensor, rng: torch.Generator | None = None) -> State:
        """Hold commands (W, K, m) for one control period, as `Simulation.step` does."""
        duration_s = None if rng is None else self.simulations[0].drawn_duration_s(state.pose.shape[:2], rng)
        seen, after = state.neighbours, None
        parts = [
            (simulation, own, None if duration_s is None else duration_s[:, own])
            for own, simulation in zip(self._columns(), self.simulations, strict=True)
        ]
        if any(simulation.looks_at_neighbours for simulation in self.simulations):
            ends = [
                simulation.most_likely_end(state.of_vehicles(own), command[:, own], lasting_s, seen[:, own])
                for simulation, own, lasting_s in parts
            ]
            after = state.neighbours_at(torch.cat(ends, dim=1))
        return State.side_by_side(
            [
                simulation.step(
                    state.of_vehicles(own),
                    command[:, own],
                    lasting_s,
                    rng,
                    seen[:, own],
                    None if after is None else after[:, own],
                )
                for simulation, own, lasting_s in parts
            ]
        )

    def observe(self, state: State, rng: torch.Generator | None = None) -> Tensor:
        """Return the poses (W, K, 3) that the camera measures; with `rng`, with its noise."""
        return torch.cat(
            [
                simulation.observe(state.of_vehicles(own), rng)
                for own, simulation in zip(self._columns(), self.simulations, strict=True)
            ],
            dim=1,
        )

    def _columns(self) -> list[slice]:
        return [slice(vehicle, vehicle + 1) for vehicle in range(len(self.simulations))]
