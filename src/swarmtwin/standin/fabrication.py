"""How one unit differs from the drawing: it depends on the robot and the vehicle's id alone, never on a seed."""

import zlib
from collections.abc import Mapping, Sequence

import numpy as np

LARGEST_DEVIATION = 2.0


def fabricate(robot: str, vehicles: Sequence[str], spreads: Mapping[str, float]) -> dict[str, np.ndarray]:
    """Draw each property's relative factor for each vehicle.

    Args:
        robot: name of the robot.
        vehicles: V ids.
        spreads: relative standard deviation of each property; deviations end at two of them.

    Returns:
        for each property its factors (V,), 1 where the unit is as drawn.
    """
    factors = np.ones((len(spreads), len(vehicles)))
    for index, vehicle in enumerate(vehicles):
        rng = np.random.default_rng(zlib.crc32(f"{robot}/{vehicle}".encode()))
        deviation = np.clip(rng.standard_normal(len(spreads)), -LARGEST_DEVIATION, LARGEST_DEVIATION)
        factors[:, index] += deviation * np.fromiter(spreads.values(), float)
    return dict(zip(spreads, factors, strict=True))
