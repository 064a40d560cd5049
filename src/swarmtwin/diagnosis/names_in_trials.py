"""How often causes that were named in judged sessions were there: what `Cause.confidence` is multiplied by."""

from typing import Annotated

from pydantic import AfterValidator, Field

from swarmtwin.errors import near_miss

NAMED_IN_TRIALS: dict[str, tuple[int, int]] = {
    "actuator_asymmetry": (7, 8),
    "actuator_lag": (18, 20),
    "backlash": (10, 11),
    "battery_sag": (16, 17),
    "camera_scale": (16, 18),
    "command_delay": (8, 11),
    "command_loss": (17, 18),
    "dead_band": (21, 29),
    "gain_change": (11, 16),
    "lens_distortion": (14, 16),
    "marker_offset": (18, 18),
    "marker_yaw": (16, 16),
    "neighbour_interaction": (7, 7),
    "noise_change": (9, 11),
    "saturation": (21, 23),
    "steady_drift": (14, 14),
    "surface_patch": (17, 19),
    "timing_jitter": (13, 13),
    "wall_effect": (20, 21),
}
"""Of the causes named in the 496 sessions of docs/results.md, how many were there, and how many were named."""


def _of_those_named(counts: tuple[int, int]) -> tuple[int, int]:
    if counts[0] > counts[1]:
        raise ValueError(f"a cause that was named {counts[1]} times cannot have been there in {counts[0]} of these")
    return counts


def _of_catalogue(trials: dict[str, tuple[int, int]]) -> dict[str, tuple[int, int]]:
    if others := [name for name in trials if name not in NAMED_IN_TRIALS]:
        from swarmtwin.simulation.mechanism import mechanism_names  # with PyTorch: only where it is needed

        known = mechanism_names()
        if unknown := [name for name in others if name not in known]:
            raise ValueError(f"no such mechanism: {unknown[0]!r}: {near_miss(unknown[0], known)}")
    return trials


Named = Annotated[tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=1)]], AfterValidator(_of_those_named)]
"""How often a cause was there, and how often it was named."""

Trials = Annotated[dict[str, Named], AfterValidator(_of_catalogue)]
"""Of causes, by name, how often each was there, and how often it was named."""
