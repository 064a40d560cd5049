"""Whether a camera still hangs where it was calibrated, by the arena's own markers."""

from collections.abc import Mapping, Sequence

import numpy as np

from swarmtwin.deploy.tracking.calibration import Calibration
from swarmtwin.deploy.tracking.marker_detection import SeenMarker


class CameraCheck:
    """Looks where the arena's markers are seen, and says so when they are elsewhere for several pictures.

    Attributes:
        reason: why pictures do not fit the calibration; None: they do, as far as is known.
    """

    def __init__(self, calibration: Calibration, largest_shift_mm: float = 5.0, looks_to_tell: int = 3) -> None:
        """Prepare.

        Args:
            calibration: that should fit.
            largest_shift_mm: of a marker that is still taken for none.
            looks_to_tell: so many pictures in a row must say the same.
        """
        self.reason: str | None = None
        self._centres_px = {
            number: calibration.to_pixels(np.column_stack([corners, np.zeros(4)])).mean(axis=0)
            for number, corners in calibration.floor_markers_mm.items()
        }
        self._mm_per_pixel = calibration.mm_per_pixel()
        self._largest_shift_mm, self._looks_to_tell = largest_shift_mm, looks_to_tell
        self._strange_looks = 0

    def look(self, seen: Sequence[SeenMarker], grey: np.ndarray) -> None:
        """Take in the markers that a whole picture (H, W) shows."""
        floor = {one.number: one.corners.mean(axis=0) for one in seen if one.number in self._centres_px}
        if not floor:
            return
        shifts_mm = self._mm_per_pixel * np.array(
            [np.linalg.norm(centre - self._centres_px[number]) for number, centre in floor.items()]
        )
        if np.median(shifts_mm) <= self._largest_shift_mm:
            self._strange_looks, self.reason = 0, None
            return
        self._strange_looks += 1
        if self._strange_looks >= self._looks_to_tell:
            self.reason = self._explained(floor, float(np.median(shifts_mm)), np.array(grey.shape[::-1]))

    def _explained(self, floor: Mapping[int, np.ndarray], shift_mm: float, size: np.ndarray) -> str:
        """Say what has become of the picture, if a turn by 180° explains it."""
        off = [np.linalg.norm(size - 1 - centre - self._centres_px[number]) for number, centre in floor.items()]
        if np.median(off) < 0.05 * size.max():
            return "the picture is upside down, compared to the calibration"
        return f"the camera has moved since it was calibrated: the arena's markers are seen {shift_mm:.0f} mm elsewhere"
