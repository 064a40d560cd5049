"""Where the vehicles are on one picture."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Sighting:
    """What one picture showed of the vehicles that were asked for.

    Attributes:
        number: of the picture.
        captured_s: when it was taken, see `Frame`.
        poses: (3,) x_mm, y_mm, heading_rad in the arena's frame of each vehicle that was seen, its centre on the floor.
        doubts: vehicles whose marker was seen and not believed (it jumped, or is there twice), and why.
        strangers: ids of markers that belong to no vehicle.
    """

    number: int
    captured_s: float
    poses: Mapping[str, np.ndarray]
    doubts: Mapping[str, str] = field(default_factory=dict)
    strangers: tuple[int, ...] = ()
