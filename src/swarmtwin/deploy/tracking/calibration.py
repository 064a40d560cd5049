"""Where a camera hangs and how its lens bends: from pixels to places on the arena's floor and back."""

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated, Self

import cv2
import numpy as np
import yaml
from pydantic import Field

from swarmtwin.errors import UserError
from swarmtwin.markers import ArenaMarkers, marker_of
from swarmtwin.plain_yaml import read_yaml
from swarmtwin.robot import Arena, Robot, StrictModel
from swarmtwin.strict_model import Positive

Vector = tuple[float, float, float]


class Lens(StrictModel):
    """What a camera does to rays, in OpenCV's model.

    Attributes:
        image_size: width and height of its pictures in pixels.
        focal_px: focal lengths along x and y.
        centre_px: where the optical axis meets the picture.
        distortion: k1, k2, p1, p2, k3.
    """

    image_size: tuple[Annotated[int, Field(ge=16)], Annotated[int, Field(ge=16)]]
    focal_px: tuple[Positive, Positive]
    centre_px: tuple[float, float]
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    @property
    def matrix(self) -> np.ndarray:
        """The camera matrix (3, 3)."""
        (focal_x, focal_y), (centre_x, centre_y) = self.focal_px, self.centre_px
        return np.array([[focal_x, 0, centre_x], [0, focal_y, centre_y], [0, 0, 1.0]])


class Calibration(StrictModel):
    """How places in the arena are seen on a camera's pictures.

    The arena's frame has z upwards from the floor. Pixel (0, 0)'s centre is at (0, 0). A mirrored picture's lens and
    pose are those of the picture with left and right exchanged.

    Attributes:
        lens: of the camera.
        rotation_rad: rotation vector from the arena's frame to the camera's (x right, y down, z ahead).
        translation_mm: of the arena's origin in the camera's frame.
        mirrored: whether the pictures show left and right exchanged.
        arena_mm: where the vehicles can move.
        layout: the markers on the arena's floor.
        reprojection_px: root mean square distance of the floor's corners from where they were seen, once each of
            their markers is allowed to lie a little aside.
        uncertainty_mm: standard error of a vehicle's position in the arena's worst corner, from the fit.
    """

    lens: Lens
    rotation_rad: Vector
    translation_mm: Vector
    mirrored: bool
    arena_mm: Arena
    layout: ArenaMarkers
    reprojection_px: Annotated[float, Field(ge=0)]
    uncertainty_mm: Annotated[float, Field(ge=0)]

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a calibration from its YAML file.

        Raises:
            UserError: the file is missing, no YAML, or not a calibration.
        """
        try:
            return cls.parse(read_yaml(path), str(path))
        except FileNotFoundError:
            raise UserError(f"no calibration {path}: make one with `swarmtwin calibrate`") from None
        except yaml.YAMLError as error:
            raise UserError(f"{path} is not valid YAML: {' '.join(str(error).split())}") from None

    def save(self, path: Path) -> None:
        """Write it to a YAML file."""
        path.write_text(yaml.safe_dump(self.model_dump(mode="json"), sort_keys=False))

    @property
    def image_size(self) -> tuple[int, int]:
        """Width and height in pixels of the pictures that it is for."""
        return self.lens.image_size

    @cached_property
    def rotation(self) -> np.ndarray:
        """The rotation (3, 3) from the arena's frame to the camera's."""
        return cv2.Rodrigues(np.array(self.rotation_rad))[0]

    @cached_property
    def camera_mm(self) -> np.ndarray:
        """Where the camera is in the arena's frame, (3,)."""
        return -self.rotation.T @ np.array(self.translation_mm)

    @property
    def floor_markers_mm(self) -> Mapping[int, np.ndarray]:
        """The corners (4, 2) of each marker on the floor, by its id."""
        return self.layout.corners_mm(self.arena_mm)

    def to_arena(self, pixels: np.ndarray, height_mm: float = 0.0) -> np.ndarray:
        """Return the places (N, 2) in mm, all at one height above the floor, that are seen at pixels (N, 2)."""
        pixels = self._unmirrored(np.asarray(pixels, float))
        until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-9)
        slopes = cv2.undistortPoints(
            pixels.reshape(-1, 1, 2), self.lens.matrix, np.array(self.lens.distortion), criteria=until
        ).reshape(-1, 2)
        rays = np.column_stack([slopes, np.ones(len(slopes))]) @ self.rotation
        reach = (height_mm - self.camera_mm[2]) / rays[:, 2:]
        return self.camera_mm[:2] + reach * rays[:, :2]

    def to_pixels(self, points_mm: np.ndarray) -> np.ndarray:
        """Return the pixels (N, 2) at which points (N, 3) of the arena's frame are seen."""
        pixels, _ = cv2.projectPoints(
            np.asarray(points_mm, float).reshape(-1, 1, 3),
            np.array(self.rotation_rad),
            np.array(self.translation_mm),
            self.lens.matrix,
            np.array(self.lens.distortion),
        )
        return self._unmirrored(pixels.reshape(-1, 2))

    def mm_per_pixel(self, height_mm: float = 0.0) -> float:
        """Return how many mm a pixel shows at the arena's middle, at a height."""
        middle = np.append((self.arena_mm.low_mm + self.arena_mm.high_mm) / 2, height_mm)
        seen = self.to_pixels(middle + np.array([[0, 0, 0], [1.0, 0, 0], [0, 1.0, 0]]))
        return float(1 / np.sqrt(abs(np.linalg.det(seen[1:] - seen[0]))))

    def summary(self, robot: Robot) -> str:
        """Return in words where the camera hangs, and how sure that is for a robot's vehicles."""
        marker_height_mm = marker_of(robot).height_mm
        way = ", mirrored" if self.mirrored else ""
        return (
            f"camera {self.camera_mm[2]:.0f} mm above the floor{way}, {self.mm_per_pixel(marker_height_mm):.2f} mm a "
            f"pixel, floor's corners {self.reprojection_px:.2f} px off, vehicles to about {self.uncertainty_mm:.1f} mm"
        )

    def check_size(self, size: tuple[int, int]) -> None:
        """Check that pictures of a width and height are those that it is for.

        Raises:
            UserError: they are not.
        """
        if tuple(size) != self.image_size:
            width, height = self.image_size
            raise UserError(
                f"the camera gives pictures of {size[0]} × {size[1]}, and the calibration is for {width} × {height}: "
                "set the camera's resolution as it was, or calibrate anew"
            )

    def _unmirrored(self, pixels: np.ndarray) -> np.ndarray:
        return np.array([self.image_size[0] - 1, 0]) + pixels * [-1, 1] if self.mirrored else pixels
