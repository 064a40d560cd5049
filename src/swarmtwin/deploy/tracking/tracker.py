"""Where the vehicles are on each picture, and which of them are doubtful."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from swarmtwin.deploy.camera.camera import Frame
from swarmtwin.deploy.tracking.calibration import Calibration
from swarmtwin.deploy.tracking.camera_check import CameraCheck
from swarmtwin.deploy.tracking.corner_refinement import CornerRefinement
from swarmtwin.deploy.tracking.identity import Identities, IdentitySettings
from swarmtwin.deploy.tracking.marker_detection import (
    Box,
    MarkerDetector,
    SeenMarker,
    cells_along,
    grey_of,
    side_px,
)
from swarmtwin.deploy.tracking.rigid_fit import fitted_poses
from swarmtwin.deploy.tracking.sighting import Sighting
from swarmtwin.errors import UserError
from swarmtwin.geometry import compose
from swarmtwin.markers import marker_of, square_corners_mm, vehicle_ids
from swarmtwin.robot import Robot


@dataclass(frozen=True)
class TrackerSettings:
    """How pictures are looked at.

    Attributes:
        whole_every: every so many pictures the whole of it is searched, for strangers, ids that are there twice and
            the arena's markers; between, only where the vehicles were. A vehicle that is missing is looked for
            everywhere.
        around_sides: how far around a vehicle it is looked for, in sides of its marker.
        size_share: a marker that seems larger or smaller than stated by more is not believed.
        farthest_out_mm: a vehicle farther outside the arena is not believed.
        identity: when a pose is doubted.
    """

    whole_every: int = 5
    around_sides: float = 1.3
    size_share: float = 0.06
    farthest_out_mm: float = 200.0
    identity: IdentitySettings = field(default_factory=IdentitySettings)


class Tracker:
    """Finds vehicles by their markers on the pictures of a calibrated camera, one picture after the other."""

    def __init__(
        self,
        calibration: Calibration,
        robot: Robot,
        vehicles: Sequence[str],
        settings: TrackerSettings | None = None,
    ) -> None:
        """Prepare.

        Args:
            calibration: of the camera.
            robot: whose vehicles they are, and how they are marked.
            vehicles: ids of those that are looked for.
            settings: how pictures are looked at.

        Raises:
            UserError: the robot has no marker, or a vehicle's id is missing or taken.
        """
        self._calibration, self._marker = calibration, marker_of(robot)
        self._settings = settings or TrackerSettings()
        self._owners = vehicle_ids(robot, vehicles, calibration.layout)
        self._square_mm = square_corners_mm(self._marker.size_mm)
        self._on_vehicle = np.array([self._marker.forward_mm, self._marker.left_mm, np.deg2rad(self._marker.turn_deg)])
        height_mm = self._marker.height_mm
        self._side_px = self._marker.size_mm / calibration.mm_per_pixel(height_mm)
        cell_px = self._side_px / cells_along(self._marker.dictionary)
        self._detector = MarkerDetector(self._marker.dictionary, cell_px, calibration.mirrored)
        self._refinement = CornerRefinement(self._marker.dictionary)
        self._identities = Identities(robot, self._settings.identity)
        self._camera_check = CameraCheck(calibration)
        self._looks = 0
        self._twice: frozenset[int] = frozenset()
        self._last_px: dict[int, np.ndarray] = {}

    def track(self, frame: Frame) -> Sighting:
        """Return where the vehicles are on a picture; pictures are given in the order in which they were taken.

        While the picture does not fit the calibration every vehicle that is seen is doubted, with the reason.
        """
        grey = grey_of(frame.image)
        wrong_size = self._wrong_size(grey)
        if wrong_size:
            return Sighting(frame.number, frame.captured_s, {}, dict.fromkeys(self._owners.values(), wrong_size))
        seen = self._look(grey)
        mine = {one.number: self._refinement.refine(grey, one) for one in seen if one.number in self._owners}
        self._last_px = {number: one.corners for number, one in mine.items()}
        poses, doubts = self._poses(mine)
        if self._camera_check.reason:
            doubts |= dict.fromkeys((self._owners[number] for number in mine), self._camera_check.reason)
        believable = {vehicle: pose for vehicle, pose in poses.items() if vehicle not in doubts}
        doubts |= self._identities.doubts(believable, frame.captured_s)
        floor = set(self._calibration.layout.ids)
        return Sighting(
            frame.number,
            frame.captured_s,
            {vehicle: pose for vehicle, pose in poses.items() if vehicle not in doubts},
            doubts,
            tuple(sorted({one.number for one in seen} - self._owners.keys() - floor)),
        )

    def check(self, image: np.ndarray) -> None:
        """Check that a picture fits the calibration.

        Raises:
            UserError: it has another size, the arena's markers are elsewhere, or none of them is seen.
        """
        grey = grey_of(image)
        self._calibration.check_size((grey.shape[1], grey.shape[0]))
        check = CameraCheck(self._calibration, looks_to_tell=1)
        floor = set(self._calibration.layout.ids)
        seen = self._detector.find(grey)
        as_it_is = len(floor & {one.number for one in seen})
        mirrored = len(floor & {one.number for one in self._detector.find(cv2.flip(grey, 1))})
        if mirrored > as_it_is or not as_it_is:
            why = "the picture is mirrored, compared to the calibration" if mirrored else "none of the arena's is seen"
            raise UserError(f"{why}: put the camera back, look to the markers {sorted(floor)}, or calibrate anew")
        check.look(seen, grey)
        if check.reason:
            raise UserError(f"{check.reason}: put the camera back, or calibrate anew")

    def _wrong_size(self, grey: np.ndarray) -> str | None:
        try:
            self._calibration.check_size((grey.shape[1], grey.shape[0]))
        except UserError as error:
            return str(error)
        return None

    def _look(self, grey: np.ndarray) -> list[SeenMarker]:
        """Return the markers on a picture, each with a fifth of a pixel, and take note of the arena's."""
        if self._looks % self._settings.whole_every and len(self._last_px) == len(self._owners):
            seen = self._detector.find_within(grey, [self._box(corners, grey) for corners in self._last_px.values()])
            if {one.number for one in seen} >= self._owners.keys():
                self._looks += 1
                return seen
        self._looks += 1
        seen = self._detector.find(grey)
        counts = Counter(one.number for one in seen)
        self._twice = frozenset(number for number, count in counts.items() if count > 1)
        self._camera_check.look(seen, grey)
        return seen

    def _box(self, corners: np.ndarray, grey: np.ndarray) -> Box:
        """Return the part of a picture in which a vehicle is looked for that was seen at corners (4, 2)."""
        reach = self._settings.around_sides * side_px(corners)
        middle, size = corners.mean(axis=0), np.array(grey.shape[::-1])
        low = np.clip(np.floor(middle - reach), 0, size).astype(int)
        high = np.clip(np.ceil(middle + reach) + 1, 0, size).astype(int)
        return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))

    def _poses(self, mine: Mapping[int, SeenMarker]) -> tuple[dict[str, np.ndarray], dict[str, str]]:
        """Return the vehicles' poses (3,), and which of them make no sense by themselves."""
        if not mine:
            return {}, {}
        pixels = np.concatenate([one.corners for one in mine.values()])
        corners_mm = self._calibration.to_arena(pixels, self._marker.height_mm).reshape(-1, 4, 2)
        marker_poses = fitted_poses(corners_mm, self._square_mm)
        poses = vehicle_poses(marker_poses, self._on_vehicle)
        found, doubts = {}, {}
        for number, pose, corners in zip(mine, poses, corners_mm, strict=True):
            vehicle = self._owners[number]
            found[vehicle] = pose
            if reason := self._implausible(number, pose, corners):
                doubts[vehicle] = reason
        return found, doubts

    def _implausible(self, number: int, pose: np.ndarray, corners_mm: np.ndarray) -> str | None:
        if number in self._twice:
            return f"marker {number} is there twice"
        if not np.isfinite(pose).all():
            return "it is seen where the lens cannot see"
        size = side_px(corners_mm) / self._marker.size_mm
        if abs(size - 1) > self._settings.size_share:
            seems = f"{abs(size - 1):.0%} {'larger' if size > 1 else 'smaller'}"
            return f"its marker seems {seems} than it is: it is lifted or tilted, or marker.size_mm is wrong"
        arena = self._calibration.arena_mm
        out_mm = max((arena.low_mm - pose[:2]).max(), (pose[:2] - arena.high_mm).max())
        if out_mm > self._settings.farthest_out_mm:
            return f"it is {out_mm:.0f} mm outside the arena"
        return None


def vehicle_poses(marker_poses: np.ndarray, on_vehicle: np.ndarray) -> np.ndarray:
    """Return the poses (S, 3) of vehicles whose markers are at poses (S, 3).

    Args:
        marker_poses: in the arena's frame.
        on_vehicle: (3,) of the marker in the vehicle's frame: forward_mm, left_mm, turn_rad.
    """
    vehicle_in_marker = compose(np.array([0, 0, -on_vehicle[2]]), np.array([-on_vehicle[0], -on_vehicle[1], 0.0]))
    return compose(marker_poses, np.broadcast_to(vehicle_in_marker, marker_poses.shape))
