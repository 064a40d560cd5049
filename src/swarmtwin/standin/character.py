"""How unruly a stand-in is: what a laboratory's robots do at all times, as opposed to an effect that is switched on."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from swarmtwin.standin.streams import Streams

CharacterName = Literal["regular", "unruly"]


@dataclass(frozen=True)
class Character:
    """What is always there, in the reference as in the measured session; as it stands here a robot is well-behaved.

    Attributes:
        motion_freedom: degrees of freedom of Student's t that the random part of a period's motion follows; None: it is
            normal.
        camera_freedom: likewise of the camera's error of a pose.
        largest_factor: a heavy tail ends where the random part is so many times as large as usual.
        noise_factor: on the random part of the motion.
        side_noise_mm: standard deviation over one second of sliding sideways at full speed.
        marker_mm: how far ahead of the centre and to its left the marker is glued on.
        marker_spread_mm: standard deviation of that from unit to unit, in both directions.
        delay_s: how late each command arrives.
        loss_probability: how probably a command never arrives.
        jitter: spread of the periods' lengths, as a share of them.
    """

    motion_freedom: float | None = None
    camera_freedom: float | None = None
    largest_factor: float = 8.0
    noise_factor: float = 1.0
    side_noise_mm: float = 0.0
    marker_mm: tuple[float, float] = (0.0, 0.0)
    marker_spread_mm: float = 0.0
    delay_s: float = 0.0
    loss_probability: float = 0.0
    jitter: float = 0.0

    def heavy_tail(self, freedom: float | None, shape: tuple[int, ...], streams: Streams, source: str) -> np.ndarray:
        """Return factors (shape) on normal noise that make it Student's t; ones where `freedom` is None."""
        if freedom is None:
            return np.ones(shape)
        squared = streams.of(source).chisquare(freedom, shape) / freedom
        return np.minimum(1.0 / np.sqrt(squared), self.largest_factor)
