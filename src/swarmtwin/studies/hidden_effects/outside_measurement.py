"""Effects of camera, marker and clock that no cause of the catalogue describes: the motion is as ever."""

import math
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from swarmtwin.geometry import rotate
from swarmtwin.robot import Seed
from swarmtwin.standin.effect import Effect

Share = Annotated[float, Field(gt=0, lt=1)]
Positive = Annotated[float, Field(gt=0)]


class LooseCamera(Effect):
    """The camera sways on its mount: its frame goes to and fro, slowly, and turns with it."""

    ages: ClassVar[bool] = True

    sway_mm: Positive
    sway_rad: float
    direction_rad: float
    period_s: Positive
    session_s: Positive

    def picture(self, pose: np.ndarray, progress: Any) -> np.ndarray:
        """Shift and turn what the camera sees."""
        out = np.sin(np.asarray(progress * (2 * math.pi * self.session_s / self.period_s)))[..., None]
        way = np.array([math.cos(self.direction_rad), math.sin(self.direction_rad)]) * self.sway_mm
        position = rotate(pose[..., :2], np.broadcast_to(self.sway_rad * out[..., 0], pose.shape[:-1])) + out * way
        turned = pose[..., 2:] + self.sway_rad * out
        return np.concatenate([position, turned], axis=-1).astype(pose.dtype)


class TiltedCamera(Effect):
    """From some moment on the camera hangs askew: on one side of the picture everything is larger, on the other not.

    A plane seen askew keeps its lines straight: a point's distances are divided by 1 − tilt · s, where s is its
    distance from the arena's middle along the tilt, as a share of the arena.
    """

    ages: ClassVar[bool] = True

    tilt: Share
    direction_rad: float
    after: Share
    x_mm: float
    y_mm: float
    side_mm: Positive

    def picture(self, pose: np.ndarray, progress: Any) -> np.ndarray:
        """Look askew from the moment on."""
        middle = np.array([self.x_mm, self.y_mm], pose.dtype)
        away = pose[..., :2] - middle
        along = away[..., 0] * math.cos(self.direction_rad) + away[..., 1] * math.sin(self.direction_rad)
        larger = 1.0 / (1.0 - self.tilt * np.clip(along / self.side_mm, -0.7, 0.7))
        factor = np.where(np.asarray(progress) > self.after, larger, 1.0)[..., None]
        return np.concatenate([middle + away * factor, pose[..., 2:]], axis=-1).astype(pose.dtype)


class DriftingClock(Effect):
    """The host's clock runs too fast and too slow as the room's temperature goes up and down, and sends by it."""

    ages: ClassVar[bool] = True

    error: Share
    swings: Positive

    def clock_rate(self, progress: Any) -> np.ndarray:
        """Go too fast, then too slow."""
        return 1.0 + self.error * np.sin(np.asarray(progress) * (2 * math.pi * self.swings))


class ComingOffMarker(Effect):
    """The marker comes off: at some moments of the session it slides to another place on the vehicle."""

    ages: ClassVar[bool] = True

    slide_mm: Positive
    places: Annotated[int, Field(ge=2)]
    draw: Seed

    def picture(self, pose: np.ndarray, progress: Any) -> np.ndarray:
        """Show the marker where it is now, in the vehicle's frame."""
        at = np.minimum((np.asarray(progress) * self.places).astype(int), self.places - 1)
        offset_mm = np.broadcast_to(self.offsets_mm()[at], pose[..., :2].shape).astype(pose.dtype)
        return np.concatenate([pose[..., :2] + rotate(offset_mm, pose[..., 2]), pose[..., 2:]], axis=-1)

    def offsets_mm(self) -> np.ndarray:
        """Return the places (places, 2), ahead and left: on average the middle, by root mean square the slide."""
        drawn = np.random.default_rng(self.draw).standard_normal((self.places, 2))
        drawn -= drawn.mean(axis=0)
        scaled: np.ndarray = drawn * (self.slide_mm / np.sqrt((drawn**2).sum(axis=1).mean()))
        return scaled


class ShiftedStrip(Effect):
    """A strip of the picture is shifted, as by a pane's edge or dead lines of the sensor: poses in it jump."""

    shift_mm: Positive
    direction_rad: float
    x_mm: float
    width_mm: Positive

    def picture(self, pose: np.ndarray, progress: Any) -> np.ndarray:
        """Shift what lies in the strip."""
        inside = np.abs(pose[..., 0] - self.x_mm) < self.width_mm / 2
        way = np.array([math.cos(self.direction_rad), math.sin(self.direction_rad)]) * self.shift_mm
        position = pose[..., :2] + inside[..., None] * way
        return np.concatenate([position, pose[..., 2:]], axis=-1).astype(pose.dtype)


MEASUREMENT: dict[str, type[Effect]] = {
    "loose_camera": LooseCamera,
    "tilted_camera": TiltedCamera,
    "drifting_clock": DriftingClock,
    "coming_off_marker": ComingOffMarker,
    "shifted_strip": ShiftedStrip,
}
"""By the names that the study draws them by."""
