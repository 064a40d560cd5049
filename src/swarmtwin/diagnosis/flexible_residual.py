"""What a session's errors depend on at all: a flexible regression, cross-fitted over runs, that knows no mechanism."""

from dataclasses import dataclass

import numpy as np
from scipy import optimize

from swarmtwin.diagnosis.measured_session import MeasuredSession
from swarmtwin.diagnosis.settings import FlexibleSettings


@dataclass(frozen=True)
class FlexibleResidual:
    """Features of N measured situations, and the folds that regressions on them are cross-fitted over.

    Attributes:
        families: (N, q) features by what they look at: command, memory, heading, place, time, duration, neighbours.
        fold: (N,) numbers of the folds; whole runs.
        settings: of the regressions.
    """

    families: dict[str, np.ndarray]
    fold: np.ndarray
    settings: FlexibleSettings

    @classmethod
    def of(
        cls,
        session: MeasuredSession,
        steady: np.ndarray,
        steady_before: np.ndarray,
        settings: FlexibleSettings | None = None,
        seed: int = 0,
    ) -> "FlexibleResidual":
        """Prepare for a session.

        Args:
            session: of N transitions.
            steady: (N, 3) twists that the simulation answers to the command.
            steady_before: (N, 3) likewise to the command before.
            settings: of the regressions; None: the defaults.
            seed: of the random features.
        """
        settings = settings or FlexibleSettings()
        rng = np.random.default_rng(seed)
        robot, conditions = session.transitions.robot, session.conditions
        low, high = robot.command_low, robot.command_high

        def unit(command: np.ndarray) -> np.ndarray:
            return 2 * (command - low) / (high - low) - 1

        given = session.situation
        assert given.previous_command is not None
        assert given.earlier_command is not None
        command, previous, earlier = (
            unit(one.numpy()) for one in (given.command, given.previous_command, given.earlier_command)
        )
        size = np.maximum(np.sqrt((steady**2).mean(axis=0)), 1e-9)
        motion = steady / size
        change = (steady_before - steady) / size
        pose = session.transitions.pose
        arena = conditions.arena_mm
        place = 2 * (pose[:, :2] - arena.low_mm) / (arena.high_mm - arena.low_mm) - 1
        grip = random_cosines(place, settings.place_waves, rng, settings.place_scale)
        heading = np.column_stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])])
        progress = session.transitions.time_s[:, None] / conditions.session_s
        ageing = np.cos(np.pi * progress * np.arange(1, settings.time_waves + 1))
        count = settings.command_waves
        families = {
            "command": np.column_stack(
                [motion, command, random_cosines(command, count, rng, 1.5), random_cosines(command, count, rng, 4.0)]
            ),
            "memory": np.column_stack(
                [
                    change,
                    random_cosines(np.column_stack([command, previous]), count, rng, 1.5),
                    change[:, :1] * motion,
                    change[:, 2:] * motion,
                    random_cosines(np.column_stack([command, previous, earlier]), count, rng, 1.0),
                ]
            ),
            "heading": np.column_stack([heading, heading[:, :1] ** 2, heading.prod(axis=1), _by(heading, motion)]),
            "place": np.column_stack([grip, _by(grip, motion[:, [0, 2]]), place, _by(_by(place, heading), motion)]),
            "time": np.column_stack([ageing, _by(ageing, motion[:, [0, 2]]), _within_run(session, motion)]),
        }
        duration = session.transitions.duration_s[:, None] / robot.period_s - 1
        if duration.std() > 1e-3:
            families["duration"] = np.column_stack([duration, duration * motion])
        neighbours = session.transitions.neighbours
        if neighbours.shape[1]:
            families["neighbours"] = _pushes(neighbours, max(robot.vehicle_size_mm))
        fold = session.run % settings.folds
        return cls({name: _standardised(columns) for name, columns in families.items()}, fold, settings)

    def predicted(self, errors: np.ndarray, scale: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """Return what errors (N, 3) are expected to be by regressions that have not seen their runs, (N, 3).

        Args:
            errors: of the simulation.
            scale: (N, 3) their usual spread.
            weight: (N,) how much each counts.
        """
        columns = np.column_stack([np.ones(len(errors)), *self.families.values()])
        predicted = np.zeros_like(errors)
        target = np.clip(errors / scale, -self.settings.clip_z, self.settings.clip_z)
        for axis in range(3):
            predicted[:, axis] = self.cross_fitted(columns / scale[:, axis : axis + 1], target[:, axis], weight)
        return predicted * scale

    def cross_fitted(
        self, columns: np.ndarray, target: np.ndarray, weight: np.ndarray, positive: bool = False
    ) -> np.ndarray:
        """Return ridge regressions' answers (N,), each fold's by the others; of a few ridges those of the best.

        Args:
            columns: (N, q) what is regressed upon.
            target: (N,) what is to be answered.
            weight: (N,) how much each counts.
            positive: whether no coefficient is below 0.
        """
        root = np.sqrt(weight)
        weighted, aim = columns * root[:, None], target * root
        grams, sides = [], []
        for fold in range(self.settings.folds):
            own = self.fold == fold
            part = weighted[own]
            grams.append(part.T @ part)
            sides.append(part.T @ aim[own])
        gram, side = sum(grams), sum(sides)
        mean = float(np.trace(gram)) / len(gram)
        best, least = np.zeros(len(target)), float(weight @ target**2)
        answers = np.zeros((len(target), len(self.settings.ridges)))
        for fold in range(self.settings.folds):
            own = self.fold == fold
            if not own.any():
                continue
            values, vectors = np.linalg.eigh(gram - grams[fold])
            turned = vectors.T @ (side - sides[fold])
            for number, ridge in enumerate(self.settings.ridges):
                precision = np.maximum(values, 0.0) + ridge * mean
                solution = vectors @ (turned / precision)
                if positive:
                    solution = optimize.nnls(np.sqrt(precision)[:, None] * vectors.T, turned / np.sqrt(precision))[0]
                answers[own, number] = columns[own] @ solution
        for number in range(len(self.settings.ridges)):
            left = float(weight @ (target - answers[:, number]) ** 2)
            if left < least:
                best, least = answers[:, number], left
        return best


def random_cosines(inputs: np.ndarray, count: int, rng: np.random.Generator, scale: float) -> np.ndarray:
    """Return (N, count) random cosines of inputs (N, d): together any smooth function (Rahimi and Recht, 2007)."""
    waves = rng.normal(0.0, scale, (inputs.shape[1], count))
    cosines: np.ndarray = np.cos(inputs @ waves + rng.uniform(0, 2 * np.pi, count))
    return cosines


def _by(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return all products of columns (N, p) and (N, q)."""
    products: np.ndarray = (one[:, :, None] * other[:, None, :]).reshape(len(one), -1)
    return products


def _within_run(session: MeasuredSession, motion: np.ndarray) -> np.ndarray:
    """Return (N, 4) how far each run has come, alone and times the motion."""
    time_s = session.transitions.time_s
    begin, end = np.full(session.runs, np.inf), np.full(session.runs, -np.inf)
    np.minimum.at(begin, session.run, time_s)
    np.maximum.at(end, session.run, time_s)
    share = (time_s - begin[session.run]) / np.maximum(end - begin, 1e-9)[session.run]
    return np.column_stack([share, share[:, None] * motion])


def _pushes(neighbours: np.ndarray, size_mm: float) -> np.ndarray:
    """Return (N, 6) sums over neighbours (N, M, 3) of directions, fading over three distances."""
    away = np.nan_to_num(neighbours[:, :, :2], nan=1e9)
    distance = np.maximum(np.linalg.norm(away, axis=2, keepdims=True), 1e-6)
    return np.concatenate(
        [(away / distance * np.exp(-distance / (reach * size_mm))).sum(axis=1) for reach in (0.5, 1.0, 2.0)], axis=1
    )


def _standardised(columns: np.ndarray) -> np.ndarray:
    spread = columns.std(axis=0)
    shown = spread > 1e-9
    standardised: np.ndarray = (columns[:, shown] - columns[:, shown].mean(axis=0)) / spread[shown]
    return standardised
