"""The catalogue's causes as the oracle supposes them: the stand-in's own effects, each with bounded parameters."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from swarmtwin.robot import Robot
from swarmtwin.standin.effect import Effect, thrust_limit
from swarmtwin.standin.effects import parse_effects

NOT_OF_THE_COURSE = ("noise_change", "timing_jitter")
"""Causes that change no mean: one is a factor on the filter's noise, the other is read off the clock."""


@dataclass(frozen=True)
class SupposedCause:
    """A cause with P parameters.

    Attributes:
        name: of the effect.
        named: what an effect of it is told, given its parameters (P,).
        low, high: (P,) their bounds; the prior is uniform between them.
        step: (P,) by which they are changed to see what that does.
        tried: where the search may begin, (P,) each.
        scaled: which parameter is the effect's size, for which 0 beyond `nothing` is none; None where it cannot be
            scaled up from a small one.
        nothing: the value of that parameter at which there is no effect.
        is_rough: whether the likelihood jumps, wherever a command is on the other side of a threshold.
    """

    name: str
    named: Callable[[np.ndarray], dict[str, Any]]
    low: np.ndarray
    high: np.ndarray
    step: np.ndarray
    tried: tuple[np.ndarray, ...]
    scaled: int | None
    nothing: float
    is_rough: bool = False

    def effects(self, values: np.ndarray, robot: Robot, vehicles: int) -> Sequence[Effect]:
        """Return the stand-in's effect with these parameters (P,); none where no motion's mean changes."""
        if self.name in NOT_OF_THE_COURSE:
            return ()
        named = {key: float(value) for key, value in self.named(values).items()}
        return parse_effects([{"name": self.name, **named}], robot, vehicles)


def supposed_causes(robot: Robot, vehicles: int, late_s: float = 0.0) -> dict[str, SupposedCause]:
    """Return the causes that vehicles of a robot may have; commands are already `late_s` late without any."""
    limit = thrust_limit(robot)
    is_fin = robot.actuation.kind == "thrust"
    side_mm = float(np.min(robot.arena_mm.high_mm - robot.arena_mm.low_mm))
    causes = [
        _one("gain_change", "gain", (0.4, 1.6), 0.01, [0.95, 0.8, 1.2], 1.0),
        _one("dead_band", "width", (1e-3 * limit, 0.95 * limit), 0.01 * limit, limit * _shares, None),
        _one("saturation", "limit", (0.05 * limit, 0.999 * limit), 0.01 * limit, limit * (1 - _shares), None),
        _one("command_delay", "delay_s", (1e-5, robot.period_s - late_s - 1e-6), 0.005, [0.02, 0.1], 0.0),
        _one("actuator_lag", "time_constant_s", (1e-5, 0.9), 0.005, [0.02, 0.1], 0.0),
        _one("camera_scale", "scale", (0.5, 1.6), 0.01, [1.02], 1.0),
        _one("lens_distortion", "coefficient", (-0.3, 0.5), 0.01, [0.03], 0.0),
        _one("marker_yaw", "angle_rad", (-1.2, 1.2), 0.01, [0.03], 0.0),
        _one("command_loss", "probability", (1e-5, 0.6), 0.003, [0.002, 0.02, 0.15], None),
        _one("noise_change", "factor", (0.3, 4.9), 0.03, [1.1, 1.5, 2.5], None),
        _battery(),
        _drift(),
        _marker(),
        *_patches(robot, side_mm),
        _wall(side_mm),
    ]
    if is_fin:
        causes.append(_one("actuator_asymmetry", "angle_rad", (-0.69, 0.69), 0.01, [0.04], 0.0))
        causes.append(_one("backlash", "travel_rad", (1e-4, 0.95), 0.01, [0.02, 0.1, 0.4], None))
    else:
        causes.append(_one("actuator_asymmetry", "ratio", (0.31, 2.9), 0.01, [1.04], 1.0))
        causes.append(_one("backlash", "travel_mm", (1e-3, 35.0), 0.1, [0.5, 3.0, 12.0], None))
    if vehicles > 1:
        causes.append(_neighbours(side_mm))
    return {cause.name: cause for cause in causes}


_shares = np.array([0.05, 0.15, 0.3, 0.5, 0.7])


def _one(
    name: str,
    parameter: str,
    bounds: tuple[float, float],
    step: float,
    tried: Sequence[float] | np.ndarray,
    nothing: float | None,
) -> SupposedCause:
    return SupposedCause(
        name,
        lambda values: {parameter: values[0]},
        np.array([bounds[0]]),
        np.array([bounds[1]]),
        np.array([step]),
        tuple(np.array([value]) for value in tried),
        None if nothing is None else 0,
        nothing or 0.0,
        name == "dead_band",
    )


def _several(
    name: str,
    named: Callable[[np.ndarray], dict[str, Any]],
    bounds: Sequence[tuple[float, float, float]],
    tried: Sequence[Sequence[float]],
    scaled: int | None,
) -> SupposedCause:
    """Return a cause of several parameters, each with its low, high and step."""
    low, high, step = np.array(bounds).T
    return SupposedCause(name, named, low, high, step, tuple(np.array(one) for one in tried), scaled, 0.0)


def _battery() -> SupposedCause:
    bounds = [(1e-5, 0.9, 0.005), (0.3, 4.0, 0.1)]
    tried = [(0.05, 0.6), (0.05, 1.0), (0.05, 2.0)]
    return _several("battery_sag", lambda values: dict(zip(("loss", "shape"), values, strict=True)), bounds, tried, 0)


def _drift() -> SupposedCause:
    def named(values: np.ndarray) -> dict[str, Any]:
        return {
            "speed_mm_s": min(max(math.hypot(*values), 1e-6), 100.0),
            "direction_rad": math.atan2(values[1], values[0]),
        }

    directions = [(math.cos(angle), math.sin(angle)) for angle in np.arange(8) * math.pi / 4]
    return _several("steady_drift", named, [(-60.0, 60.0, 0.2)] * 2, directions, None)


def _marker() -> SupposedCause:
    def named(values: np.ndarray) -> dict[str, Any]:
        return dict(zip(("forward_mm", "left_mm"), values, strict=True))

    return _several(
        "marker_offset", named, [(-90.0, 90.0, 0.5)] * 2, [(2.0, 0.0), (-2.0, 0.0), (0.0, 2.0), (0.0, -2.0)], None
    )


def _patches(robot: Robot, side_mm: float) -> list[SupposedCause]:
    low, high = robot.arena_mm.low_mm, robot.arena_mm.high_mm
    bounds = [
        *((start, end, 0.015 * side_mm) for start, end in zip(low, high, strict=True)),
        (0.08 * side_mm, 0.45 * side_mm, 0.015 * side_mm),
        (-0.45, 0.98, 0.01),
    ]
    centres = [low + (high - low) * np.array([x, y]) for x in (0.27, 0.5, 0.73) for y in (0.27, 0.5, 0.73)]
    tried = [(*centre, 0.25 * side_mm, 0.1) for centre in centres]
    names = ("x_mm", "y_mm", "radius_mm", "loss")
    return [_several("surface_patch", lambda values: dict(zip(names, values, strict=True)), bounds, tried, 3)]


def _wall(side_mm: float) -> SupposedCause:
    bounds = [(1e-4, 0.98, 0.01), (0.05 * side_mm, 0.4 * side_mm, 0.01 * side_mm)]
    tried = [(0.1, 0.11 * side_mm), (0.1, 0.2 * side_mm)]
    names = ("loss", "reach_mm")
    return _several("wall_effect", lambda values: dict(zip(names, values, strict=True)), bounds, tried, 0)


def _neighbours(side_mm: float) -> SupposedCause:
    bounds = [(-199.0, 199.0, 0.5), (0.05 * side_mm, 0.5 * side_mm, 0.01 * side_mm)]
    tried = [(5.0, 0.13 * side_mm), (5.0, 0.25 * side_mm)]
    names = ("strength_mm_s", "reach_mm")
    return _several("neighbour_interaction", lambda values: dict(zip(names, values, strict=True)), bounds, tried, 0)


def jitter_nats(duration_s: np.ndarray, period_s: float, usual: float, resolution_s: float = 0.001) -> float:
    """Return by how much periods (R, T) are likelier with a spread of their own than with the usual one.

    Half a log of their number is what a parameter costs. Times are recorded to a `resolution_s`.
    """
    spread = float(np.std(duration_s / period_s))
    expected = math.hypot(usual, resolution_s / period_s)
    if spread <= expected:
        return 0.0
    count = duration_s.size
    return count * (math.log(expected / spread) + 0.5 * ((spread / expected) ** 2 - 1.0)) - 0.5 * math.log(count)


def prior_nats(names: Mapping[str, Any] | Sequence[str], offered: int, prior: float) -> float:
    """Return the log-probability of a set of causes, each of the `offered` ones there with probability `prior`."""
    return len(names) * math.log(prior) + (offered - len(names)) * math.log1p(-prior)
