"""All effects that the study hides, of the catalogue, by another law or of no catalogue, looked up by their names."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from swarmtwin.standin.effect import Effect
from swarmtwin.standin.effects import catalogue, parse_effects
from swarmtwin.standin.session import StandInSession
from swarmtwin.studies.hidden_effects.effect_sizes import CATALOGUE, PARAMETERS, Draw, Sizes
from swarmtwin.studies.hidden_effects.other_laws import OTHER_LAW_PARAMETERS, OTHER_LAW_SIZES, OTHER_LAWS
from swarmtwin.studies.hidden_effects.outside_effects import OUTSIDE, OUTSIDE_EFFECTS, OUTSIDE_PARAMETERS

SIZES: Mapping[str, Mapping[str, Sizes]] = {
    "one": CATALOGUE,
    "misspecified": OTHER_LAW_SIZES,
    "outside": OUTSIDE,
}
"""Sizes of all effects, by the kind of session in which one of them hides alone, as tables and pictures order them."""

_SIZES: Mapping[str, Sizes] = {name: sizes for effects in SIZES.values() for name, sizes in effects.items()}
_PARAMETERS: Mapping[str, Callable[[Draw], dict[str, Any]]] = {
    **PARAMETERS,
    **OTHER_LAW_PARAMETERS,
    **OUTSIDE_PARAMETERS,
}


def sizes_of(name: str, robot: str) -> tuple[float, float]:
    """Return the smallest size of an effect, which nobody can see on a robot, and the largest that makes sense."""
    return _SIZES[name][robot]


def drawn_parameters(name: str, drawn: Draw) -> dict[str, Any]:
    """Return the parameters of an effect, from its size and what is left to chance."""
    return _PARAMETERS[name](drawn)


def effect_class(name: str) -> type[Effect]:
    """Return what an effect is made of."""
    return {**catalogue(), **OTHER_LAWS, **OUTSIDE_EFFECTS}[name]


def made_effects(entries: Sequence[Mapping[str, Any]], session: StandInSession) -> tuple[Effect, ...]:
    """Make effects, of the catalogue or outside it, of their names and parameters."""
    made: list[Effect] = []
    for entry in entries:
        if entry["name"] in CATALOGUE:
            made += parse_effects([dict(entry)], session.robot, len(session.vehicles))
        else:
            own = {key: value for key, value in entry.items() if key != "name"}
            made.append(effect_class(entry["name"]).parse(own, entry["name"]))
    return tuple(made)
