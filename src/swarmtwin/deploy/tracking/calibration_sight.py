"""What pictures for a calibration show: the floor's four markers, and vehicles wherever they stand."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from swarmtwin.deploy.tracking.corner_refinement import CornerRefinement
from swarmtwin.deploy.tracking.marker_detection import MarkerDetector, SeenMarker, grey_of, side_px
from swarmtwin.errors import UserError
from swarmtwin.markers import ArenaMarkers, marker_of
from swarmtwin.robot import Robot


@dataclass(frozen=True)
class SightSettings:
    """Which markers are taken for vehicles', and for how many poses of theirs.

    Attributes:
        size_share: a vehicle's marker that seems larger or smaller than stated by more is no vehicle's.
        most_poses: of each vehicle that take part.
        moved_px: a vehicle that has not moved so far has the same pose still.
    """

    size_share: float = 0.25
    most_poses: int = 12
    moved_px: float = 1.0


@dataclass(frozen=True)
class SeenMarkers:
    """What the pictures show.

    Attributes:
        floor_px: the corners (16, 2) of the floor's markers.
        vehicles_px: those (S, 4, 2) of vehicles' markers.
        size: width and height of the pictures.
        mirrored: whether left and right are exchanged; all corners are those of upright pictures.
    """

    floor_px: np.ndarray
    vehicles_px: np.ndarray
    size: tuple[int, int]
    mirrored: bool


def look(
    pictures: Sequence[np.ndarray], robot: Robot, layout: ArenaMarkers, settings: SightSettings | None = None
) -> SeenMarkers:
    """Find and refine all markers on all pictures, and see whether these are mirrored.

    Args:
        pictures: (H, W) or (H, W, 3) uint8, of one camera that does not move.
        robot: whose vehicles are seen, with its arena.
        layout: the markers on the floor.
        settings: see there; None: the defaults.

    Raises:
        UserError: there is no picture, they differ in size, fewer than four of the floor's markers are seen, or one of
            them twice.
    """
    settings = settings or SightSettings()
    if not pictures:
        raise UserError("there is no picture to calibrate from")
    sizes = {(picture.shape[1], picture.shape[0]) for picture in pictures}
    if len(sizes) > 1:
        raise UserError(
            f"the pictures differ in size: {', '.join(f'{w} × {h}' for w, h in sorted(sizes))}: use one camera"
        )
    marker = marker_of(robot)
    detector, refinement = MarkerDetector(marker.dictionary), CornerRefinement(marker.dictionary)
    greys = [grey_of(picture) for picture in pictures]
    plain = _floor_markers(detector, greys[0], layout)
    flipped = _floor_markers(detector, cv2.flip(greys[0], 1), layout)
    mirrored = flipped > plain
    floor: dict[int, list[np.ndarray]] = {number: [] for number in layout.ids}
    vehicles: dict[int, list[np.ndarray]] = {}
    for grey in greys:
        upright = cv2.flip(grey, 1) if mirrored else grey
        found = [refinement.refine(upright, one) for one in detector.find(upright)]
        _refuse_twice(found, layout)
        for number, corners in found:
            if number in floor:
                floor[number].append(corners)
            else:
                _add_pose(vehicles.setdefault(number, []), corners, settings)
    if missing := [str(number) for number, seen in floor.items() if not seen]:
        raise UserError(
            f"{4 - len(missing)} of the arena's four markers are seen, and not {', '.join(missing)} of "
            f"{marker.dictionary}: see that nothing covers them and that they lie flat and in even light"
        )
    floor_px = np.concatenate([np.median(seen, axis=0) for seen in floor.values()])
    return SeenMarkers(
        floor_px, _of_stated_size(vehicles, floor_px, marker.size_mm, layout, settings), sizes.pop(), mirrored
    )


def _floor_markers(detector: MarkerDetector, grey: np.ndarray, layout: ArenaMarkers) -> int:
    return len({one.number for one in detector.find(grey)} & set(layout.ids))


def _refuse_twice(found: Sequence[SeenMarker], layout: ArenaMarkers) -> None:
    for number in layout.ids:
        if sum(one.number == number for one in found) > 1:
            raise UserError(
                f"marker {number} is there twice, and it is one of the arena's four: take the other one away"
            )


def _add_pose(poses: list[np.ndarray], corners: np.ndarray, settings: SightSettings) -> None:
    """Keep where a vehicle's marker was seen, unless it has not moved."""
    still = poses and np.linalg.norm(corners - poses[-1], axis=1).max() < settings.moved_px
    if not still and len(poses) < settings.most_poses:
        poses.append(corners)


def _of_stated_size(
    vehicles: dict[int, list[np.ndarray]],
    floor_px: np.ndarray,
    size_mm: float,
    layout: ArenaMarkers,
    settings: SightSettings,
) -> np.ndarray:
    """Return the corners (S, 4, 2) of those markers that can be vehicles' by their size."""
    expected_px = np.mean([side_px(corners) for corners in floor_px.reshape(4, 4, 2)]) * size_mm / layout.size_mm
    kept = [
        corners
        for poses in vehicles.values()
        for corners in poses
        if abs(side_px(corners) / expected_px - 1) < settings.size_share
    ]
    return np.array(kept).reshape(-1, 4, 2)
