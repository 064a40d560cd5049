"""The effects of the catalogue: one file each, found by its name."""

import importlib
import pkgutil
from collections.abc import Sequence
from functools import cache
from typing import Any

from swarmtwin.errors import UserError, near_miss
from swarmtwin.robot import Robot
from swarmtwin.standin.effect import Effect


@cache
def catalogue() -> dict[str, type[Effect]]:
    """Return the effects by name: in each module of this package the one that carries the module's name."""
    found = {}
    for module in pkgutil.iter_modules(__path__):
        content = vars(importlib.import_module(f"{__name__}.{module.name}"))
        class_name = module.name.title().replace("_", "")
        found[module.name] = content[class_name]
    return found


def parse_effects(entries: Sequence[Any], robot: Robot, vehicle_count: int) -> tuple[Effect, ...]:
    """Make effects of their configuration, `[{name: battery_sag, loss: 0.3}, ...]`; what is left out has its default.

    Raises:
        UserError: an unknown effect or parameter, a value out of bounds, or an effect that this robot cannot have, or
            delays that together are longer than its period.
    """
    effects = []
    for entry in entries:
        if not isinstance(entry, dict) or not isinstance(entry.get("name"), str):
            raise UserError(f"effects: {entry!r} is no effect: write {{name: battery_sag, loss: 0.3}}")
        name = entry["name"]
        if name not in catalogue():
            raise UserError(f"effects: unknown effect {name!r}: {near_miss(name, catalogue())}")
        parameters = {key: value for key, value in entry.items() if key != "name"}
        effects.append(catalogue()[name].parse(parameters, f"effect {name!r}").on(robot, vehicle_count))
    late_s = sum(effect.command_delay_s() for effect in effects)
    if late_s > robot.period_s + 1e-9:  # a sum of delays is rounded
        raise UserError(
            f"effect 'command_delay': delay_s {late_s:g} is longer than the period of {robot.name!r}: "
            f"give at most {robot.period_s:g}, all delays together"
        )
    return tuple(effects)
