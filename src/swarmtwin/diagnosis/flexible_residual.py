"""What a session's errors depend on at all: a flexible regression, cross-fitted over runs, that knows no mechanism."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from swarmtwin.diagnosis.cross_fitted_ridge import CrossFittedRidge
from swarmtwin.diagnosis.measured_session import MeasuredSession
from swarmtwin.diagnosis.settings import FlexibleSettings


class FlexibleRegressions:
    """Regressions of errors whose usual spread is known, prepared for any number of errors.

    Args:
        columns: (N, q) features,
        alternatives: of which each alternative looks at these numbers.
        fold: (N,) numbers of the folds; whole runs.
        scale: (N, 3) the errors' usual spread.
        weight: (N,) how much each counts.
        settings: of the regressions.
    """

    def __init__(
        self,
        columns: np.ndarray,
        alternatives: Sequence[np.ndarray],
        fold: np.ndarray,
        scale: np.ndarray,
        weight: np.ndarray,
        settings: FlexibleSettings,
    ) -> None:
        self._scale, self._clip_z = scale, settings.clip_z
        self._axes = [
            CrossFittedRidge(columns, weight, fold, settings.ridges, 1 / scale[:, axis], alternatives)
            for axis in range(3)
        ]

    def predicted(self, errors: np.ndarray) -> list[np.ndarray]:
        """Return for each alternative what errors (N, 3) are expected to be, (N, 3)."""
        target = np.clip(errors / self._scale, -self._clip_z, self._clip_z)
        by_axis = [axis.answers(target[:, number]) for number, axis in enumerate(self._axes)]
        return [np.column_stack(answers) * self._scale for answers in zip(*by_axis, strict=True)]


@dataclass(frozen=True)
class FlexibleResidual:
    """Features of N measured situations, and the folds that regressions on them are cross-fitted over.

    Attributes:
        columns: (N, q) features; the first one is 1.
        families: numbers of those that look at the command, memory, heading, place, time, duration, neighbours.
        modulations: (N, p) few smooth functions, each of unit size, of time, place and heading: see `varying_causes`.
        fold: (N,) numbers of the folds; whole runs.
        settings: of the regressions.
    """

    columns: np.ndarray
    families: dict[str, np.ndarray]
    modulations: dict[str, np.ndarray]
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
        given = session.situation
        assert given.previous_command is not None
        assert given.earlier_command is not None
        command, previous, earlier = (
            robot.scaled_command(one.numpy()) for one in (given.command, given.previous_command, given.earlier_command)
        )
        size = np.maximum(np.sqrt((steady**2).mean(axis=0)), 1e-9)
        motion = steady / size
        change = (steady_before - steady) / size
        pose = session.transitions.pose
        arena = conditions.arena_mm
        place = 2 * (pose[:, :2] - arena.low_mm) / (arena.high_mm - arena.low_mm) - 1
        grip = random_cosines(place, settings.place_waves, rng, settings.place_scale)
        heading = np.column_stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])])
        axis = np.column_stack([np.cos(2 * pose[:, 2]), np.sin(2 * pose[:, 2])])  # ground that differs along and across
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
            "heading": np.column_stack([heading, axis, _by(heading, motion), _by(axis, motion)]),
            "place": np.column_stack([grip, _by(grip, motion[:, [0, 2]]), place, _by(_by(place, heading), motion)]),
            "time": np.column_stack([ageing, _by(ageing, motion[:, [0, 2]]), _within_run(session, motion)]),
        }
        duration = session.transitions.duration_s[:, None] / robot.period_s - 1
        if duration.std() > 1e-3:
            families["duration"] = np.column_stack([duration, duration * motion])
        neighbours = session.transitions.neighbours
        if neighbours.shape[1]:
            families["neighbours"] = _pushes(neighbours, max(robot.vehicle_size_mm))
        standardised = [np.ones((len(motion), 1)), *(_standardised(columns) for columns in families.values())]
        ends = np.cumsum([columns.shape[1] for columns in standardised])
        numbers = {name: np.arange(*ends[index : index + 2]) for index, name in enumerate(families)}
        modulations = {"time": ageing, "place": place, "heading": np.column_stack([heading, axis])}
        modulations = {name: _of_unit_size(functions) for name, functions in modulations.items()}
        return cls(np.concatenate(standardised, axis=1), numbers, modulations, session.folds(settings.folds), settings)

    def predicted(self, errors: np.ndarray, scale: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """Return what errors (N, 3) are expected to be by regressions that have not seen their runs, (N, 3).

        Args:
            errors: of the simulation.
            scale: (N, 3) their usual spread.
            weight: (N,) how much each counts.
        """
        return self.regressions([np.arange(self.columns.shape[1])], scale, weight).predicted(errors)[0]

    def alternatives(self, scale: np.ndarray, weight: np.ndarray) -> FlexibleRegressions:
        """Prepare a regression on everything, and one on each family alone.

        What errors depend on in a small way drowns in what it costs to look at everything else as well.
        """
        everything = np.arange(self.columns.shape[1])
        return self.regressions([everything, *(np.append(0, one) for one in self.families.values())], scale, weight)

    def regressions(
        self, alternatives: Sequence[np.ndarray], scale: np.ndarray, weight: np.ndarray
    ) -> FlexibleRegressions:
        """Prepare regressions, each on features of these numbers; otherwise as in `predicted`."""
        return FlexibleRegressions(self.columns, alternatives, self.fold, scale, weight, self.settings)


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


def _of_unit_size(functions: np.ndarray) -> np.ndarray:
    scaled: np.ndarray = functions / np.maximum(np.sqrt((functions**2).mean(axis=0)), 1e-9)
    return scaled
