"""Where a camera that hangs over the arena sees a point, and back: written without OpenCV, to be held against it."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Pinhole:
    """A camera with one radial distortion coefficient.

    A point at `x, y, z` in the camera's frame (x to the right, y down, z ahead) is seen at
    `focal_px · (1 + k1 r²) · (x/z, y/z) + centre_px`, r the length of (x/z, y/z). Pixel (0, 0)'s centre is (0, 0).

    Attributes:
        focal_px: focal length.
        centre_px: (2,) where the optical axis meets the picture.
        k1: radial distortion.
        rotation: (3, 3) from the arena's frame, z upwards, to the camera's.
        place_mm: (3,) of the camera in the arena's frame.
    """

    focal_px: float
    centre_px: np.ndarray
    k1: float
    rotation: np.ndarray
    place_mm: np.ndarray

    def project(self, points_mm: np.ndarray) -> np.ndarray:
        """Return where points (..., 3) of the arena's frame are seen, (..., 2) pixels."""
        seen = (points_mm - self.place_mm) @ self.rotation.T
        slope = seen[..., :2] / seen[..., 2:]
        stretch = 1 + self.k1 * (slope**2).sum(axis=-1, keepdims=True)
        return self.focal_px * stretch * slope + self.centre_px

    def meet(self, pixels: np.ndarray, height_mm: float = 0.0) -> np.ndarray:
        """Return where the rays of pixels (..., 2) meet the plane at a height, (..., 2) mm in the arena's frame."""
        bent = (pixels - self.centre_px) / self.focal_px
        radius = np.sqrt((bent**2).sum(axis=-1, keepdims=True))
        straight = radius
        for _ in range(20):
            straight = straight - (straight + self.k1 * straight**3 - radius) / (1 + 3 * self.k1 * straight**2)
        slope = bent * (straight / np.maximum(radius, 1e-12))
        ray = np.concatenate([slope, np.ones_like(radius)], axis=-1) @ self.rotation
        reach = (height_mm - self.place_mm[2]) / ray[..., 2:]
        return self.place_mm[:2] + reach * ray[..., :2]


def hanging_camera(
    over_mm: np.ndarray, height_mm: float, tilt_rad: float, turn_rad: float, mm_per_pixel: float, k1: float
) -> Pinhole:
    """Return a camera that looks at a point of the floor, its picture's centre at pixel (0, 0).

    Args:
        over_mm: (2,) the point that its optical axis meets.
        height_mm: of the camera above the floor.
        tilt_rad: 0: it looks straight down; else it hangs aside, towards low y for a positive one, and looks across.
        turn_rad: of the picture, clockwise; 0: the arena's x to the right and its y up.
        mm_per_pixel: at the point that it looks at.
        k1: radial distortion.
    """
    down = np.diag([1.0, -1.0, -1.0])
    rotation = _about_axis(turn_rad) @ _about_x(tilt_rad) @ down
    away_mm = height_mm / np.cos(tilt_rad)
    place_mm = np.append(over_mm, 0.0) - away_mm * rotation[2]
    return Pinhole(away_mm / mm_per_pixel, np.zeros(2), k1, rotation, place_mm)


def _about_x(angle_rad: float) -> np.ndarray:
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])


def _about_axis(angle_rad: float) -> np.ndarray:
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
