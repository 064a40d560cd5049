"""The hidden states that driven rows may begin in, for someone who knows some of the commands before."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from swarmtwin.geometry import compose, displacement_between
from swarmtwin.standin.driven_rows import DrivenRows
from swarmtwin.standin.latent_bank import LatentBank, contexts, place_context
from swarmtwin.standin.physics import Physics, advance
from swarmtwin.standin.session import DrivenSession


class LatentHistory:
    """One vehicle's rows, as someone knows them who has seen the commands of the `before` periods before each.

    Attributes:
        physics: of the vehicle alone, in single precision.
        bank: what its hidden states may be.
        before: how many commands before each row are known.
        rows: the N rows.
        context: (N, c) what of a row's situation its hidden state depends on.
        step: (N,) how many periods of its run went before each row.
        period_s: nominal length of those.
    """

    def __init__(self, physics: Physics, driven: DrivenSession, vehicle: int, bank: LatentBank, before: int) -> None:
        self.physics, self.bank, self.before = physics, bank, before
        self.rows = DrivenRows.of(driven, vehicle)
        self.context = contexts(driven, vehicle)
        self.step = np.tile(np.arange(driven.session.steps), len(driven.command))
        self.period_s = driven.session.robot.period_s

    def parts(self, rng: np.random.Generator) -> Iterator[tuple[DrivenRows, np.ndarray, np.ndarray]]:
        """Yield the rows part by part, with states (states, n, draws) and commands in force (m, n, draws) at each."""
        drawn = None if self.before else self.bank.draw(self.context, rng)
        for part, rows in self.rows.chunks(self.physics.latent_draws):
            if drawn is None:
                hidden, active = self._brought_up(np.arange(self.step.size)[part], rows.state[:3, :, 0], rng)
            else:
                hidden, active = self.bank.hidden[:, drawn[part]], self.bank.command[:, drawn[part]]
            pose = np.broadcast_to(rows.state[:3], (3, *hidden.shape[1:]))
            yield rows, np.concatenate([pose, hidden]), active

    def _brought_up(
        self, index: np.ndarray, pose: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return hidden states (states, n, draws) and commands in force (m, n, draws) at rows `index`.

        Where the vehicle was when the commands given began is not known. For a robot that remembers places it is taken
        to be where it must have come from to be at `pose` (3, n) now, going as far as vehicles go on average, of eight.
        The commands given leave half as much open as there is without them, so half as many draws tell the mean.
        """
        start, draws = pose, self.physics.latent_draws
        if self.physics.memory_of_place:
            state, _ = self._replayed(index, start, draws // 8, rng)
            moved = displacement_between(start.T[:, None], np.moveaxis(state[:3], 0, -1)).mean(axis=1)
            start = self._started_from(pose, moved)
        state, active = self._replayed(index, start, 2, rng)
        return state[3:], active

    def _replayed(
        self, index: np.ndarray, start: np.ndarray, every: int, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return states and commands in force at rows `index` after the periods before, begun at poses (3, n).

        Only one in `every` of the bank's strata is drawn from.
        """
        physics = self.physics
        age = self.step[index]
        first = np.maximum(index - self.before, 0)
        context = self.context[first].copy()
        if physics.memory_of_place:
            context[:, :4] = place_context(start, self.rows.state[1].std()).T
        drawn = self.bank.draw(context, rng)[:, ::every]
        fresh = (age < self.before)[:, None]
        state = physics.at_rest(np.broadcast_to(start[:, :, None], (3, *drawn.shape)).copy())
        resting = np.reshape(physics.resting_command, (-1, 1, 1)).astype(np.float32)
        state[3:] = np.where(fresh, state[3:], self.bank.hidden[:, drawn])
        active = np.where(fresh, resting, self.bank.command[:, drawn])
        for periods in range(self.before, 0, -1):
            rows = self.rows.at(np.maximum(index - periods, 0))
            rows = replace(rows, duration_s=np.full_like(rows.duration_s, self.period_s))
            lost = rng.random(active.shape[1:], np.float32) < physics.conditions.loss_probability
            arriving = np.where(lost, active, rows.command)
            noise = rng.standard_normal((physics.substeps, physics.noises, *active.shape[1:]), np.float32)
            driven = (age >= periods)[:, None]
            state = np.where(driven, advance(physics, state, rows.period(arriving, active), noise), state)
            active = np.where(driven, arriving, active)
        return state, active

    def _started_from(self, pose: np.ndarray, displacement: np.ndarray) -> np.ndarray:
        """Return the poses (3, n), where the vehicle has ever been, from which displacements (n, 3) lead to `pose`."""
        start = compose(pose.T, displacement_between(displacement, np.zeros_like(displacement))).T
        seen_mm = self.rows.state[:2, :, 0]
        position_mm = np.clip(start[:2], seen_mm.min(axis=1, keepdims=True), seen_mm.max(axis=1, keepdims=True))
        return np.concatenate([position_mm, start[2:]]).astype(np.float32)
