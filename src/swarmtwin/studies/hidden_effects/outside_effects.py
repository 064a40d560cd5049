"""Effects outside the catalogue that the study hides: how large they may be, and what parameters one of a size has."""

from collections.abc import Callable
from typing import Any

from swarmtwin.standin.effect import Effect
from swarmtwin.studies.hidden_effects.effect_sizes import Draw, Sizes
from swarmtwin.studies.hidden_effects.outside_ground import GROUND_AND_SUPPLY
from swarmtwin.studies.hidden_effects.outside_measurement import MEASUREMENT
from swarmtwin.studies.hidden_effects.outside_mechanics import MECHANICS
from swarmtwin.studies.hidden_effects.random_fields import FIELDS

OUTSIDE_EFFECTS: dict[str, type[Effect]] = {**GROUND_AND_SUPPLY, **MECHANICS, **MEASUREMENT, **FIELDS}
"""All effects that no cause describes, by name."""

OUTSIDE: dict[str, Sizes] = {
    "brushed_floor": {"mgr": (0.01, 0.9), "mur": (0.01, 0.9)},
    "striped_floor": {"mgr": (0.01, 0.9), "mur": (0.01, 0.9)},
    "oscillating_gain": {"mgr": (0.01, 0.9), "mur": (0.01, 0.9)},
    "warm_up": {"mgr": (0.02, 0.95), "mur": (0.02, 0.95)},
    "sudden_loss": {"mgr": (0.01, 0.9), "mur": (0.01, 0.9)},
    "weak_left_turn": {"mgr": (0.01, 0.9), "mur": (0.01, 0.9)},
    "coarse_commands": {"mgr": (0.02, 0.33), "mur": (0.04, 0.33)},
    "bent_response": {"mgr": (0.02, 0.85), "mur": (0.03, 0.85)},
    "swapped_wheels": {"mgr": (0.001, 0.3)},
    "rotating_current": {"mgr": (0.3, 40.0), "mur": (0.6, 60.0)},
    "whirl": {"mgr": (0.5, 80.0), "mur": (0.8, 100.0)},
    "bowl": {"mgr": (0.5, 80.0), "mur": (0.8, 100.0)},
    "out_of_round_wheel": {"mgr": (0.01, 0.9)},
    "slipping_wheel": {"mgr": (0.02, 0.95)},
    "sticky_motors": {"mgr": (1.0, 90.0)},
    "shared_supply": {"mgr": (0.01, 0.9), "mur": (0.01, 0.9)},
    "cross_coupling": {"mgr": (0.005, 0.8), "mur": (0.005, 0.8)},
    "dragging_cable": {"mgr": (0.002, 0.3), "mur": (0.002, 0.3)},
    "temperature": {"mgr": (0.02, 0.95), "mur": (0.02, 0.95)},
    "loose_camera": {"mgr": (0.3, 40.0), "mur": (0.6, 80.0)},
    "tilted_camera": {"mgr": (0.02, 0.9), "mur": (0.02, 0.9)},
    "drifting_clock": {"mgr": (0.01, 0.6), "mur": (0.01, 0.6)},
    "coming_off_marker": {"mgr": (0.5, 40.0), "mur": (1.0, 80.0)},
    "shifted_strip": {"mgr": (1.0, 60.0), "mur": (1.0, 90.0)},
    "random_by_command": {"mgr": (0.01, 0.7), "mur": (0.01, 0.7)},
    "random_by_previous_command": {"mgr": (0.01, 0.7), "mur": (0.01, 0.7)},
    "random_ageing": {"mgr": (0.01, 0.7), "mur": (0.01, 0.7)},
    "random_ground": {"mgr": (0.01, 0.7), "mur": (0.01, 0.7)},
    "random_current": {"mgr": (0.3, 40.0), "mur": (0.6, 60.0)},
    "random_gusts": {"mgr": (0.3, 40.0), "mur": (0.6, 60.0)},
    "random_lens": {"mgr": (1.0, 80.0), "mur": (1.0, 120.0)},
}
"""For each robot that can have them the smallest size, which nobody can see, and the largest that makes sense."""


def _warm_up(drawn: Draw) -> dict[str, float]:
    lasts = {"run_s": drawn.run_s, "session_s": drawn.session_s}
    return {"loss": drawn.size, "warm_after_s": 0.15 * drawn.run_s, **lasts}


def _rotating_current(drawn: Draw) -> dict[str, float]:
    turns = drawn.uniform(1.0, 3.0)
    return {"speed_mm_s": drawn.size, "turns": turns, "direction_rad": drawn.direction_rad()}


def _around_middle(drawn: Draw) -> dict[str, float]:
    x_mm, y_mm = drawn.middle_mm
    return {"speed_mm_s": drawn.size * drawn.sign(), "x_mm": x_mm, "y_mm": y_mm, "radius_mm": drawn.side_mm / 2}


def _cable(drawn: Draw) -> dict[str, Any]:
    low, high = drawn.robot.arena_mm.low_mm, drawn.robot.arena_mm.high_mm
    along = drawn.uniform(0.2, 0.8)
    x_mm = low[0] + along * (high[0] - low[0])
    return {"rate_s": drawn.size, "x_mm": float(x_mm), "y_mm": float(high[1]), "slack_mm": 0.35 * drawn.side_mm}


def _loose(drawn: Draw) -> dict[str, Any]:
    angles = {"sway_rad": drawn.size / drawn.side_mm * drawn.uniform(-1.0, 1.0), "direction_rad": drawn.direction_rad()}
    lasts = {"period_s": drawn.robot.period_s * drawn.uniform(6.0, 20.0), "session_s": drawn.session_s}
    return {"sway_mm": drawn.size, **angles, **lasts}


def _tilted(drawn: Draw) -> dict[str, Any]:
    x_mm, y_mm = drawn.middle_mm
    place = {"x_mm": x_mm, "y_mm": y_mm, "side_mm": drawn.side_mm}
    return {"tilt": drawn.size, "direction_rad": drawn.direction_rad(), "after": drawn.uniform(0.2, 0.6), **place}


def _strip(drawn: Draw) -> dict[str, Any]:
    low, high = drawn.robot.arena_mm.x
    x_mm = low + (high - low) * drawn.uniform(0.35, 0.65)
    width_mm = drawn.side_mm * drawn.uniform(0.15, 0.3)
    return {"shift_mm": drawn.size, "direction_rad": drawn.direction_rad(), "x_mm": x_mm, "width_mm": width_mm}


def _field(drawn: Draw, low: tuple[float, ...], high: tuple[float, ...]) -> dict[str, Any]:
    smoothness = {"length_scale": drawn.uniform(0.15, 0.45), "draw": int(drawn.rng.integers(2**31))}
    return {"size": drawn.size, **smoothness, "low": low, "high": high}


def _over_commands(drawn: Draw, over: str) -> dict[str, Any]:
    robot = drawn.robot
    field = _field(drawn, tuple(robot.command_low.tolist()), tuple(robot.command_high.tolist()))
    return {**field, "over": over, "actuators": 1 if drawn.is_fin else 2}


def _over_places(drawn: Draw) -> dict[str, Any]:
    arena = drawn.robot.arena_mm
    return _field(drawn, (arena.x[0], arena.y[0]), (arena.x[1], arena.y[1]))


def _over_time(drawn: Draw) -> dict[str, Any]:
    return _field(drawn, (0.0,), (1.0,))


OUTSIDE_PARAMETERS: dict[str, Callable[[Draw], dict[str, Any]]] = {
    "brushed_floor": lambda drawn: {"loss": drawn.size, "direction_rad": drawn.direction_rad()},
    "striped_floor": lambda drawn: {"loss": drawn.size, "width_mm": drawn.side_mm * drawn.uniform(0.12, 0.2)},
    "oscillating_gain": lambda drawn: {"amplitude": drawn.size, "period_s": 60.0, "session_s": drawn.session_s},
    "warm_up": _warm_up,
    "sudden_loss": lambda drawn: {"loss": drawn.size, "after": drawn.uniform(0.35, 0.65)},
    "weak_left_turn": lambda drawn: {"loss": drawn.size},
    "coarse_commands": lambda drawn: {"step": drawn.size * drawn.full_thrust},
    "bent_response": lambda drawn: {"bend": drawn.size * drawn.sign()},
    "swapped_wheels": lambda drawn: {"probability": drawn.size},
    "rotating_current": _rotating_current,
    "whirl": _around_middle,
    "bowl": _around_middle,
    "out_of_round_wheel": lambda drawn: {"eccentricity": drawn.size, "radius_mm": drawn.uniform(14.0, 20.0)},
    "slipping_wheel": lambda drawn: {"loss": drawn.size, "at_mm_s2": 900.0, "grips_after_s": 0.25},
    "sticky_motors": lambda drawn: {"breakaway_mm_s": drawn.size},
    "shared_supply": lambda drawn: {"loss": drawn.size},
    "cross_coupling": lambda drawn: {"share": drawn.size * drawn.sign()},
    "dragging_cable": _cable,
    "temperature": lambda drawn: {"loss": drawn.size, "warm_after": drawn.uniform(0.1, 0.3)},
    "loose_camera": _loose,
    "tilted_camera": _tilted,
    "drifting_clock": lambda drawn: {"error": drawn.size, "swings": drawn.uniform(1.5, 4.0)},
    "coming_off_marker": lambda drawn: {
        "slide_mm": drawn.size,
        "places": int(drawn.rng.integers(3, 7)),
        "draw": int(drawn.rng.integers(2**31)),
    },
    "shifted_strip": _strip,
    "random_by_command": lambda drawn: _over_commands(drawn, "command"),
    "random_by_previous_command": lambda drawn: _over_commands(drawn, "previous_command"),
    "random_ageing": _over_time,
    "random_ground": _over_places,
    "random_current": _over_places,
    "random_gusts": _over_time,
    "random_lens": _over_places,
}
"""The parameters of an effect, from its size and what is left to chance."""
