"""Plain rules: each cause leaves a pattern in the residual, and the pattern that correlates best is named."""

from collections.abc import Iterator

import numpy as np

from swarmtwin.diagnosis.reference import Reference
from swarmtwin.geometry import exp_map, residual_between, rotate
from swarmtwin.transitions import Transitions

Pattern = tuple[str, np.ndarray]


def suggested_cause(
    reference: Reference, transitions: Transitions, simulated: np.ndarray, significant_z: float = 4.0
) -> str | None:
    """Return the cause whose pattern the residual follows most, None where no pattern is significant.

    Args:
        reference: says how large residuals are where nothing is wrong.
        transitions: N measured ones.
        simulated: (N, 3) their simulated displacements.
        significant_z: standard errors over runs from which on a correlation counts.
    """
    own = reference.own_likelihood()
    usual = residual_between(exp_map(own.simulated).numpy(), own.session.transitions.displacement).std(axis=0)
    residual = residual_between(simulated, transitions.displacement) / usual
    _, run = np.unique(transitions.run, return_inverse=True)
    strongest: dict[str, float] = {}
    for name, pattern in _patterns(transitions, simulated):
        correlation, z = _correlation(residual, pattern / usual, run)
        if abs(z) > significant_z:
            strongest[name] = max(strongest.get(name, 0.0), abs(correlation))
    if not strongest:
        return _by_spread(transitions, residual, run, significant_z)
    return max(strongest, key=lambda name: strongest[name])


def _correlation(residual: np.ndarray, pattern: np.ndarray, run: np.ndarray) -> tuple[float, float]:
    """Return the correlation of (N, 3) with a pattern (N, 3), and how significant it is with runs as blocks."""
    product = np.einsum("nd,nd->n", residual, np.nan_to_num(pattern))
    size = np.linalg.norm(residual) * np.linalg.norm(np.nan_to_num(pattern)) + 1e-12
    by_run = np.bincount(run, product)
    return float(product.sum() / size), float(by_run.sum() / (np.linalg.norm(by_run) + 1e-12))


def _by_spread(
    transitions: Transitions, residual: np.ndarray, run: np.ndarray, significant_z: float, steady_clock: float = 0.01
) -> str | None:
    """Name what shows in spreads alone; of periods, in one of more than `steady_clock` as a share of them."""
    if transitions.duration_s.std() > steady_clock * transitions.robot.period_s:
        return "timing_jitter"
    by_run = np.bincount(run, (residual**2).mean(axis=1)) / np.bincount(run)
    z = (by_run.mean() - 1.0) / (by_run.std(ddof=1) / np.sqrt(len(by_run)) + 1e-12)
    return "noise_change" if abs(z) > significant_z else None


def _patterns(transitions: Transitions, simulated: np.ndarray) -> Iterator[Pattern]:
    yield from _of_actuators(transitions, simulated)
    yield from _of_places(transitions, simulated)
    yield from _of_the_camera(transitions, simulated)
    late = _before(transitions, simulated) - simulated
    yield "command_delay", late
    yield "timing_jitter", simulated * (transitions.duration_s / transitions.robot.period_s - 1.0)[:, None]


def _before(transitions: Transitions, simulated: np.ndarray) -> np.ndarray:
    """Return (N, 3) the simulated displacements of the transitions before, NaN where there is none."""
    before = np.full_like(simulated, np.nan)
    same = (transitions.run[1:] == transitions.run[:-1]) & (transitions.vehicle[1:] == transitions.vehicle[:-1])
    before[1:][same] = simulated[:-1][same]
    return before


def _of_actuators(
    transitions: Transitions, simulated: np.ndarray, small_effort: float = 0.3, large_effort: float = 0.7
) -> Iterator[Pattern]:
    """Yield what actuators leave; efforts are small and large below and above these shares of the limit."""
    robot = transitions.robot
    forward, left, turn = simulated.T
    progress = transitions.time_s / max(float(transitions.time_s.max()), 1e-9)
    yield "gain_change", simulated
    yield "battery_sag", simulated * (progress - progress.mean())[:, None]
    if robot.actuation.kind == "wheel":
        half_mm = robot.vehicle_size_mm[1] / 2
        yield "actuator_asymmetry", np.stack([turn * half_mm, np.zeros_like(left), forward / half_mm], axis=1)
    else:
        yield "actuator_asymmetry", np.stack([np.zeros_like(left), np.zeros_like(left), np.abs(forward)], axis=1)
    columns = [robot.command_columns.index(name) for name in robot.actuation.effort]
    if columns:
        effort = transitions.command[:, columns] / robot.command_high[columns]
        before = transitions.previous_command[:, columns] / robot.command_high[columns]
        yield "dead_band", simulated * (np.abs(effort) < small_effort).any(axis=1)[:, None]
        yield "saturation", simulated * (np.abs(effort) - large_effort).clip(min=0.0).sum(axis=1)[:, None]
        yield "backlash", simulated * (effort * before < 0).any(axis=1)[:, None]


def _of_places(
    transitions: Transitions, simulated: np.ndarray, cells: int = 5, wall_reach: float = 0.12
) -> Iterator[Pattern]:
    """Yield what places leave; the arena's smaller side has so many cells, and walls reach over this share of it."""
    arena = transitions.arena_mm
    position_mm, heading_rad = transitions.pose[:, :2], transitions.pose[:, 2]
    side_mm = float(np.min(arena.high_mm - arena.low_mm))
    wall_mm = np.minimum(position_mm - arena.low_mm, arena.high_mm - position_mm).min(axis=1).clip(min=0.0)
    near = np.exp(-wall_mm / (wall_reach * side_mm))
    yield "wall_effect", simulated * (near - near.mean())[:, None]
    cell = np.floor((position_mm - arena.low_mm) / side_mm * cells).astype(int)
    for place in np.unique(cell, axis=0):
        inside = (cell == place).all(axis=1).astype(float)
        yield "surface_patch", simulated * (inside - inside.mean())[:, None]
    for angle_rad in np.arange(4) * (np.pi / 4):
        towards = np.broadcast_to([np.cos(angle_rad), np.sin(angle_rad)], position_mm.shape)
        yield "steady_drift", _with_turn(rotate(towards, -heading_rad))
    if transitions.neighbours.shape[1]:
        away = -transitions.neighbours[..., :2]
        distance_mm = np.linalg.norm(away, axis=-1, keepdims=True) + 1e-9
        push = np.nan_to_num(away / distance_mm * np.exp(-distance_mm / (0.2 * side_mm))).sum(axis=1)
        yield "neighbour_interaction", _with_turn(push)


def _of_the_camera(transitions: Transitions, simulated: np.ndarray) -> Iterator[Pattern]:
    arena = transitions.arena_mm
    moved, turn = simulated[:, :2], simulated[:, 2]
    from_middle = transitions.pose[:, :2] - (arena.low_mm + arena.high_mm) / 2
    radius = (from_middle**2).sum(axis=1) / ((arena.high_mm - arena.low_mm) ** 2).sum() * 4
    yield "camera_scale", _with_turn(moved)
    yield "lens_distortion", _with_turn(moved * (radius - radius.mean())[:, None])
    yield "marker_yaw", _with_turn(np.stack([moved[:, 1], -moved[:, 0]], axis=1))
    for offset in ((1.0, 0.0), (0.0, 1.0)):
        marker = np.broadcast_to(offset, moved.shape)
        yield "marker_offset", _with_turn(rotate(marker, turn) - marker)


def _with_turn(moved: np.ndarray) -> np.ndarray:
    """Return a pattern (N, 3) of a motion (N, 2) without a turn."""
    return np.concatenate([moved, np.zeros((len(moved), 1))], axis=1)
