"""An overhead camera over stand-in vehicles: pictures of their markers, with everything a real camera does to them."""

from collections.abc import Collection, Sequence
from typing import Annotated

import cv2
import numpy as np
from pydantic import Field

from swarmtwin.geometry import compose
from swarmtwin.markers import ArenaMarkers, arena_markers, marker_of, vehicle_ids
from swarmtwin.robot import Robot, Seed, StrictModel
from swarmtwin.standin.rendering.light import LightName, SensorNoise, floor_pattern, light
from swarmtwin.standin.rendering.pinhole import Pinhole, hanging_camera
from swarmtwin.standin.rendering.sprite import Paint, Sprite, marker_sprite
from swarmtwin.strict_model import Positive


class CameraConditions(StrictModel):
    """How the camera hangs and what its pictures suffer from.

    Attributes:
        mm_per_pixel: on the floor at the arena's middle.
        margin_mm: floor that is seen around the arena.
        camera_height_mm: above the floor; a raised marker is seen displaced away from the point below the camera.
        tilt_deg: between the optical axis and straight down: perspective.
        turned_deg: of the picture, clockwise; 180: upside down.
        mirrored: left and right exchanged, as some webcams show it.
        k1: radial lens distortion: a point at r times the focal length from the middle is seen at r (1 + k1 r²).
        off_centre_px: where the optical axis meets the picture, from its middle.
        blur_px: standard deviation of the optics' blur.
        exposure_s: how long a picture is exposed; vehicles that move are smeared.
        pixel_noise: standard deviation in grey levels, of 255.
        light: ordinary or harsh.
        cables: thin things that hang across the picture and hide what is below them.
        seed: of the floor, the light and the cables.
    """

    mm_per_pixel: Positive = 1.9
    margin_mm: Annotated[float, Field(ge=0)] = 120.0
    camera_height_mm: Positive = 2000.0
    tilt_deg: Annotated[float, Field(ge=-40, le=40)] = 1.5
    turned_deg: Annotated[float, Field(ge=-360, le=360)] = 0.0
    mirrored: bool = False
    k1: Annotated[float, Field(ge=-0.4, le=0.4)] = -0.03
    off_centre_px: tuple[float, float] = (0.0, 0.0)
    blur_px: Annotated[float, Field(ge=0, le=5)] = 0.5
    exposure_s: Annotated[float, Field(ge=0, le=1)] = 0.005
    pixel_noise: Annotated[float, Field(ge=0)] = 2.0
    light: LightName = "ordinary"
    cables: Annotated[int, Field(ge=0)] = 0
    seed: Seed = 1


class OverheadCamera:
    """A camera that sees the vehicles of a robot, and the four markers on the arena's floor.

    A pixel's value is the mean of what its area sees; pixel (0, 0)'s centre is at (0, 0), as in OpenCV. A picture shows
    the vehicles as they are in the middle of the exposure.

    Attributes:
        robot: whose vehicles it sees.
        vehicles: their names.
        conditions: how it hangs.
        size: width and height of its pictures.
        optics: where it sees a point: for tests and studies. A picture that is mirrored is so after that.
    """

    def __init__(
        self,
        robot: Robot,
        vehicles: Sequence[str],
        conditions: CameraConditions | None = None,
        layout: ArenaMarkers | None = None,
        rays_per_side: int = 4,
        obstacles: Sequence[Sequence[float]] = (),
    ) -> None:
        """Hang the camera up.

        Args:
            robot: one that has a marker.
            vehicles: names of the V vehicles that it will see.
            conditions: how it hangs; None: as the defaults say.
            layout: the markers on the floor; None: as the defaults say.
            rays_per_side: of the square of rays that a pixel averages over.
            obstacles: x_mm, y_mm, radius_mm of round things on the floor: discs of one brightness, as flat as paper.

        Raises:
            UserError: the robot has no marker, or a vehicle's id is missing or taken.
        """
        self.robot, self.vehicles = robot, tuple(vehicles)
        self.conditions = conditions or CameraConditions()
        self._marker, self._rays = marker_of(robot), rays_per_side
        self.optics, self.size = _hang(robot, self.conditions)
        rng = np.random.default_rng(self.conditions.seed)
        self._light = light(self.conditions.light, self.size, rng)
        self._noise = SensorNoise(self.size, self.conditions.pixel_noise, rng)
        rows, columns = np.mgrid[: self.size[1], : self.size[0]]
        self._floor_mm = self.optics.meet(np.dstack([columns, rows]).astype(float)).astype(np.float32)
        finest_mm = self.conditions.mm_per_pixel / rays_per_side
        numbers = {vehicle: number for number, vehicle in vehicle_ids(robot, vehicles, layout).items()}
        size_mm, body_mm = self._marker.size_mm, robot.vehicle_size_mm
        self._sprites = [
            marker_sprite(self._marker, numbers[vehicle], size_mm, finest_mm, Paint(), body_mm) for vehicle in vehicles
        ]
        self._cables = _cables(self.size, self.conditions.cables, rng)
        self._scene = self._empty_scene(layout or ArenaMarkers(), finest_mm, rng)
        for x_mm, y_mm, radius_mm in obstacles:
            self._scene[np.linalg.norm(self._floor_mm - (x_mm, y_mm), axis=2) < radius_mm] = Paint.obstacle
        self._background = self._as_seen(self._scene, slice(None), slice(None))

    def render(
        self,
        pose: np.ndarray,
        rng: np.random.Generator,
        hidden: Collection[str] = frozenset(),
        velocity: np.ndarray | None = None,
    ) -> np.ndarray:
        """Take a picture.

        Args:
            pose: (V, 3) true poses in the arena's frame, mm and rad, the vehicles' centres on the floor.
            rng: of the sensor's noise.
            hidden: vehicles that are not seen at all.
            velocity: (V, 3) mm/s, mm/s, rad/s in the arena's frame, for motion blur; None: they stand.

        Returns:
            (H, W) uint8.
        """
        pose = np.asarray(pose, float)
        moving = np.zeros_like(pose) if velocity is None else np.asarray(velocity, float) * self.conditions.exposure_s
        scene, picture = self._scene.copy(), self._background.copy()
        changed = []
        for index, vehicle in enumerate(self.vehicles):
            if vehicle not in hidden and np.isfinite(pose[index]).all():
                changed.append(self._paint(scene, self._sprites[index], self._exposed(pose[index], moving[index])))
        for rows, columns in changed:
            picture[rows, columns] = self._as_seen(scene, rows, columns)
        picture = self._noise.add(picture, rng)
        return cv2.flip(picture, 1) if self.conditions.mirrored else picture

    def marker_poses(self, pose: np.ndarray) -> np.ndarray:
        """Return where the markers (V, 3) are when the vehicles are at poses (V, 3), in the arena's frame."""
        marker = self._marker
        return compose(pose, np.array([marker.forward_mm, marker.left_mm, np.deg2rad(marker.turn_deg)]))

    def _exposed(self, pose: np.ndarray, moved: np.ndarray) -> np.ndarray:
        """Return the marker's poses (n, 3) during the exposure, two a pixel of the way."""
        tip_mm = np.hypot(*moved[:2]) + abs(moved[2]) * self._marker.size_mm / 2
        count = 1 + 2 * int(np.ceil(tip_mm / self.conditions.mm_per_pixel - 0.1))
        share = (np.arange(count) + 0.5) / count - 0.5
        return self.marker_poses(pose + share[:, None] * moved)

    def _paint(self, scene: np.ndarray, sprite: Sprite, poses: np.ndarray) -> tuple[slice, slice]:
        """Lay a vehicle over the scene, and return the rows and columns that it changed, blur included."""
        height_mm = self._marker.height_mm
        outline = np.concatenate([sprite.outline_mm(pose) for pose in poses])
        rows, columns = self._box(outline, height_mm)
        if rows.start >= rows.stop or columns.start >= columns.stop:
            return slice(0, 0), slice(0, 0)
        self._lay(scene, sprite, poses, height_mm, rows, columns)
        scene[rows, columns][self._cables[rows, columns]] = Paint.black
        reach = self._blur_reach
        return (
            slice(max(0, rows.start - reach), rows.stop + reach),
            slice(max(0, columns.start - reach), columns.stop + reach),
        )

    def _lay(
        self, scene: np.ndarray, sprite: Sprite, poses: np.ndarray, height_mm: float, rows: slice, columns: slice
    ) -> None:
        lift = 1 - height_mm / self.optics.place_mm[2]
        below = (1 - lift) * self.optics.place_mm[:2]
        plane_mm = self._floor_mm[rows, columns] * np.float32(lift) + below.astype(np.float32)
        seen = [sprite.seen_through(plane_mm, pose, self._rays) for pose in poses]
        mean = np.asarray(seen[0] if len(seen) == 1 else np.mean(seen, axis=0, dtype=np.float32))
        part = scene[rows, columns]
        part[:] = mean[..., 0] + part * (1 - mean[..., 1] * np.float32(1 / 255)) + np.float32(0.5)

    def _box(self, outline_mm: np.ndarray, height_mm: float) -> tuple[slice, slice]:
        """Return the rows and columns in which an outline (N, 2) at a height is seen, with a rim."""
        pixels = self.optics.project(np.column_stack([outline_mm, np.full(len(outline_mm), height_mm)]))
        low = np.clip(np.floor(pixels.min(axis=0)) - 1, 0, self.size).astype(int)
        high = np.clip(np.ceil(pixels.max(axis=0)) + 2, 0, self.size).astype(int)
        return slice(low[1], high[1]), slice(low[0], high[0])

    def _empty_scene(self, layout: ArenaMarkers, finest_mm: float, rng: np.random.Generator) -> np.ndarray:
        """Return the floor (H, W) with the arena's four markers, uint8, before light and optics."""
        scene = floor_pattern(self.size, rng)
        for number, corners in arena_markers(self.robot, layout).items():
            sprite = marker_sprite(self._marker, number, layout.size_mm, finest_mm, Paint(), quiet_cells=1.0)
            pose = np.append(corners.mean(axis=0), 0.0)
            self._lay(scene, sprite, pose[None], 0.0, *self._box(sprite.outline_mm(pose), 0.0))
        scene[self._cables] = Paint.black
        return scene

    @property
    def _blur_reach(self) -> int:
        return int(np.ceil(3 * self.conditions.blur_px))

    def _as_seen(self, scene: np.ndarray, rows: slice, columns: slice) -> np.ndarray:
        """Return a part of the scene blurred and lit, uint8."""
        reach, blur_px = self._blur_reach, self.conditions.blur_px
        first = max(0, (rows.start or 0) - reach), max(0, (columns.start or 0) - reach)
        end_row = None if rows.stop is None else rows.stop + reach
        end_column = None if columns.stop is None else columns.stop + reach
        part: np.ndarray = scene[first[0] : end_row, first[1] : end_column].astype(np.float32)
        if blur_px:
            part = cv2.GaussianBlur(part, (2 * reach + 1, 2 * reach + 1), blur_px)
        cut = part[
            (rows.start or 0) - first[0] : None if rows.stop is None else rows.stop - first[0],
            (columns.start or 0) - first[1] : None if columns.stop is None else columns.stop - first[1],
        ]
        return np.clip(self._light.falls_on(cut, rows, columns) + 0.5, 0, 255).astype(np.uint8)


def _hang(robot: Robot, conditions: CameraConditions) -> tuple[Pinhole, tuple[int, int]]:
    """Return the camera's optics, and the width and height of a picture that just holds the arena and its margin."""
    low, high = robot.arena_mm.low_mm - conditions.margin_mm, robot.arena_mm.high_mm + conditions.margin_mm
    optics = hanging_camera(
        (low + high) / 2,
        conditions.camera_height_mm,
        np.deg2rad(conditions.tilt_deg),
        np.deg2rad(conditions.turned_deg),
        conditions.mm_per_pixel,
        conditions.k1,
    )
    rim = np.array([[low[0], low[1], 0], [high[0], low[1], 0], [high[0], high[1], 0], [low[0], high[1], 0]])
    reach = np.ceil(np.abs(optics.project(rim)).max(axis=0)).astype(int)
    middle = reach - 0.5 + np.array(conditions.off_centre_px)
    width, height = 2 * reach
    centred = Pinhole(optics.focal_px, middle, optics.k1, optics.rotation, optics.place_mm)
    return centred, (int(width), int(height))


def _cables(size: tuple[int, int], count: int, rng: np.random.Generator, thickness_px: int = 4) -> np.ndarray:
    """Return which pixels (H, W) lie behind a cable."""
    width, height = size
    hidden = np.zeros((height, width), np.uint8)
    for _ in range(count):
        ends = rng.uniform(0, 1, (2, 2)) * [[width, 0], [width, 0]] + [[0, 0], [0, height]]
        cv2.line(hidden, ends[0].astype(int).tolist(), ends[1].astype(int).tolist(), 1, thickness_px)
    return hidden.astype(bool)
