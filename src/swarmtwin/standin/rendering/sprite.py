"""Flat printed things, such as a vehicle seen from above with its marker, laid into a picture area-true."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from swarmtwin.hardware import Marker


@dataclass(frozen=True)
class Paint:
    """How bright things are, 0 to 255, in full light."""

    white: int = 230
    black: int = 20
    body: int = 70
    obstacle: int = 45


@dataclass(frozen=True)
class Sprite:
    """A flat thing in its own frame, its centre at the origin.

    Attributes:
        texture: (R, C, 2) brightness where it covers, times coverage; and coverage; uint8.
        texel_mm: length of a texel's side.
    """

    texture: np.ndarray
    texel_mm: float

    @property
    def reach_mm(self) -> np.ndarray:
        """Half its width and height, (2,)."""
        rows, columns = self.texture.shape[:2]
        return np.array([columns, rows]) * (self.texel_mm / 2)

    def outline_mm(self, pose: np.ndarray) -> np.ndarray:
        """Return its corners (4, 2) in the arena's frame when it lies at a pose (3,)."""
        return pose[:2] + (np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * self.reach_mm) @ _turn(pose[2]).T

    def texel_map(self, pose: np.ndarray) -> np.ndarray:
        """Return the affine map (2, 3) from places in mm to texels, column and row, centres at whole numbers."""
        inverse = _turn(pose[2]).T * np.array([[1.0], [-1.0]]) / self.texel_mm
        rows, columns = self.texture.shape[:2]
        offset = np.array([columns, rows]) / 2 - 0.5 - inverse @ pose[:2]
        return np.column_stack([inverse, offset])

    def seen_through(self, floor_mm: np.ndarray, pose: np.ndarray, samples: int) -> np.ndarray:
        """Return what pixels see of it, averaged over each pixel's area by samples × samples rays.

        Texels are interpolated between: where they are as fine as the rays, an edge is as sharp as the rays allow and
        its place is exact.

        Args:
            floor_mm: (h, w, 2) where the pixels' centres meet its plane.
            pose: (3,) of it in that plane.
            samples: rays along each side of a pixel.

        Returns:
            (h, w, 2) brightness and coverage, as in the texture.
        """
        texels = cv2.transform(floor_mm, self.texel_map(pose).astype(np.float32))
        no_second_map: Any = None
        rays = cv2.resize(texels, None, fx=samples, fy=samples, interpolation=cv2.INTER_LINEAR)
        seen = cv2.remap(self.texture, rays, no_second_map, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        return cv2.resize(seen, texels.shape[1::-1], interpolation=cv2.INTER_AREA)


def marker_sprite(
    marker: Marker,
    number: int,
    size_mm: float,
    finest_mm: float,
    paint: Paint,
    body_mm: tuple[float, float] | None = None,
    quiet_cells: float = 1.0,
) -> Sprite:
    """Return a marker on its white plate, in the marker's frame, and the vehicle under it.

    Args:
        marker: how the robot is marked.
        number: the marker's id.
        size_mm: length of its black square's side.
        finest_mm: no texel is larger.
        paint: how bright everything is.
        body_mm: length and width of the vehicle that carries it; None: it lies on the floor.
        quiet_cells: width of the white around it, in cells of the marker.
    """
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, marker.dictionary))
    cells = dictionary.markerSize + 2
    per_cell = int(np.ceil(size_mm / cells / finest_mm))
    texel_mm = size_mm / cells / per_cell
    square = cv2.aruco.generateImageMarker(dictionary, number, cells * per_cell)
    plate_half = len(square) // 2 + round(quiet_cells * per_cell)
    half = plate_half if body_mm is None else max(plate_half, round(np.hypot(*body_mm) / texel_mm))
    texture = np.zeros((2 * half + 2, 2 * half + 2, 2), np.uint8)
    if body_mm is not None:
        _fill(texture, _body_corners(marker, body_mm) / texel_mm, paint.body)
    _place(texture, np.full((2 * plate_half, 2 * plate_half), paint.white, np.uint8))
    _place(texture, np.where(square > 0, paint.white, paint.black).astype(np.uint8))
    return Sprite(_trimmed(texture), texel_mm)


def _body_corners(marker: Marker, body_mm: tuple[float, float]) -> np.ndarray:
    """Return the corners (4, 2) of the vehicle's footprint in the marker's frame."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (np.array(body_mm) / 2)
    return (corners - [marker.forward_mm, marker.left_mm]) @ _turn(np.deg2rad(marker.turn_deg))


def _fill(texture: np.ndarray, polygon: np.ndarray, brightness: int) -> None:
    """Paint a polygon (4, 2), in texels from the centre, y upwards."""
    points = (polygon * [1, -1] + np.array(texture.shape[1::-1]) / 2 - 0.5) * 2**8
    cv2.fillConvexPoly(texture, points.round().astype(np.int32), (brightness, 255), lineType=cv2.LINE_AA, shift=8)


def _place(texture: np.ndarray, grey: np.ndarray) -> None:
    """Put an opaque square, of an even number of texels, into the middle."""
    start = (len(texture) - len(grey)) // 2
    texture[start : start + len(grey), start : start + len(grey)] = np.dstack([grey, np.full_like(grey, 255)])


def _trimmed(texture: np.ndarray) -> np.ndarray:
    """Cut off what is empty on all four sides alike, up to one texel, so that the origin stays in the middle."""
    rows, columns = np.nonzero(texture[..., 1])
    row = max(0, min(rows.min(), len(texture) - 1 - rows.max()) - 1)
    column = max(0, min(columns.min(), texture.shape[1] - 1 - columns.max()) - 1)
    return np.ascontiguousarray(texture[row : len(texture) - row, column : texture.shape[1] - column])


def _turn(angle_rad: float) -> np.ndarray:
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[cos, -sin], [sin, cos]])
