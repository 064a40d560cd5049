"""A calibration from pictures of the arena's four markers and of vehicles on it."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from swarmtwin.deploy.tracking.calibration import Calibration, Lens
from swarmtwin.deploy.tracking.calibration_sight import SeenMarkers, look
from swarmtwin.deploy.tracking.marker_detection import side_px
from swarmtwin.deploy.tracking.rigid_fit import fitted_square
from swarmtwin.errors import UserError
from swarmtwin.markers import ArenaMarkers, marker_of, square_corners_mm
from swarmtwin.robot import Robot

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FitSettings:
    """What the fit takes for granted.

    Attributes:
        corner_px: standard error of a corner; more than noise alone makes of it, as many err in the same way.
        spread_px: standard deviation of how much too far outside all corners seem to lie: blur and light make dark
            things larger or smaller.
        placed_mm: standard error, along x and y, of where a marker was laid on the floor.
        printed_share: standard error of the size of the vehicles' markers over that of the floor's.
        centre_share: standard deviation of the optical axis from the picture's middle, in widths of the picture.
        k1: standard deviation of the radial distortion among lenses.
        log_focal: standard deviation of the logarithm of the focal length among cameras, in widths of the picture.
        usual_focal: its median.
        camera_height_share: standard error of a camera's height that was measured by hand.
        camera_above_mm: standard error, along x and y, of the point below the lens that was found by a plumb line.
        largest_error_mm: where a marker on the floor seems to lie farther from where it should, the fit is refused.
        focal_widths: focal lengths, in widths of the picture, from which an unknown lens is searched for.
        rough_steps: of the search from each of them, before the best one is followed to its end.
    """

    corner_px: float = 0.06
    spread_px: float = 0.2
    placed_mm: float = 0.2
    printed_share: float = 0.0005
    centre_share: float = 0.01
    k1: float = 0.15
    log_focal: float = 0.6
    usual_focal: float = 1.1
    camera_height_share: float = 0.005
    camera_above_mm: float = 5.0
    largest_error_mm: float = 2.0
    focal_widths: tuple[float, ...] = (0.7, 1.3, 2.6)
    rough_steps: int = 8


class MeasuredByHand(NamedTuple):
    """Where the camera hangs, as far as somebody has measured it.

    Attributes:
        camera_height_mm: of the lens above the floor, by a tape measure; None: nobody has.
        camera_above_mm: x and y in the arena's frame of the point of the floor below the lens, by a plumb line; None:
            nobody has.
    """

    camera_height_mm: float | None = None
    camera_above_mm: tuple[float, float] | None = None


def fit_calibration(
    pictures: Sequence[np.ndarray],
    robot: Robot,
    layout: ArenaMarkers | None = None,
    lens: Lens | None = None,
    by_hand: MeasuredByHand | None = None,
    settings: FitSettings | None = None,
) -> Calibration:
    """Find out where a camera hangs from several of its pictures.

    The corners of the arena's four markers, averaged over the pictures, give pose and lens; how large and how square
    the vehicles' raised markers look wherever they stand gives the rest: above all the camera's height, by which a
    raised marker is displaced. What both leave open is held near what is usual. Whether a picture is turned or mirrored
    is found out from the markers.

    Args:
        pictures: (H, W) or (H, W, 3) uint8, of one camera that does not move; vehicles may.
        robot: whose vehicles are seen, with its arena.
        layout: the arena's markers; None: as the defaults say.
        lens: known from a board; None: it is fitted.
        by_hand: where the camera hangs, as far as somebody has measured it; None: nobody has.
        settings: see there.

    Raises:
        UserError: fewer than four of the arena's markers are seen, one of them twice, the pictures differ in size, or
            the markers do not lie where they should.
    """
    settings, layout = settings or FitSettings(), layout or ArenaMarkers()
    seen = look(pictures, robot, layout)
    if lens is not None and tuple(lens.image_size) != seen.size:
        raise UserError(f"the lens was measured on pictures of {lens.image_size}, and these are {seen.size}")
    problem = _Problem(seen, robot, layout, lens, by_hand or MeasuredByHand(), settings)
    best = problem.solve()
    number, off_mm = problem.misplaced(best)
    if off_mm > settings.largest_error_mm:
        raise UserError(
            f"the arena's markers {', '.join(map(str, layout.ids))} are not seen where they should lie: "
            f"marker {number} is off by {off_mm:.0f} mm (at most {settings.largest_error_mm:g}): "
            "check which marker lies at which corner and how they are turned, "
            "and that size_mm, outside_mm or centres_mm are as measured"
        )
    return problem.calibration(best)


def loaded_or_fitted(
    file: Path | None, pictures: Callable[[], Sequence[np.ndarray]], robot: Robot, by_hand: MeasuredByHand
) -> Calibration:
    """Return the calibration in a file, or where there is none that by the arena's markers on pictures.

    Raises:
        UserError: it cannot be read or fitted, or something was measured by hand that a stored one cannot heed.
    """
    if file is None:
        found = fit_calibration(pictures(), robot, by_hand=by_hand)
        log.info("calibrated by the arena's markers: %s", found.summary(robot))
        return found
    if unheeded := [name for name, value in by_hand._asdict().items() if value is not None]:
        raise UserError(
            f"{unheeded[0]} is of use where the arena's markers calibrate, and calibration={file} is a stored "
            f"calibration: give {unheeded[0]} to `swarmtwin calibrate` when you make that, or leave one of both out"
        )
    return Calibration.load(file)


class _Problem:
    """The least-squares problem.

    Its unknowns are how far outside corners seem to lie, by what share the vehicles' markers are larger than stated,
    how far each marker on the floor lies from where it should (8), the pose (6), and where the lens is not known the
    logarithm of its focal length, its centre (2) and k1.
    """

    def __init__(
        self,
        seen: SeenMarkers,
        robot: Robot,
        layout: ArenaMarkers,
        lens: Lens | None,
        by_hand: MeasuredByHand,
        settings: FitSettings,
    ) -> None:
        self._seen, self._robot, self._layout, self._lens = seen, robot, layout, lens
        self._by_hand, self._settings = by_hand, settings
        self._marker = marker_of(robot)
        floor = np.concatenate(list(layout.corners_mm(robot.arena_mm).values()))
        self._floor_mm = np.column_stack([floor, np.zeros(len(floor))])
        self._mm_per_px = layout.size_mm / side_px(seen.floor_px[:4])

    def solve(self) -> OptimizeResult:
        """Search from several focal lengths for some steps, and from the best place so found to the end."""
        if self._lens is not None:
            return self._search(self._start(self._lens.matrix))
        width, height = self._seen.size
        rough = []
        for focal in np.array(self._settings.focal_widths) * width:
            matrix = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
            start = np.concatenate([self._start(matrix), [np.log(focal), *matrix[:2, 2], 0.0]])
            rough.append(
                least_squares(self._residuals, start, x_scale=self._scale(), max_nfev=self._settings.rough_steps)
            )
        return self._search(min(rough, key=lambda solution: float(solution.cost)).x)

    def _start(self, matrix: np.ndarray) -> np.ndarray:
        """Return the pose that belongs to a camera matrix, with nothing displaced."""
        bends = np.array(self._lens.distortion) if self._lens else np.zeros(5)
        _, turned, moved = cv2.solvePnP(self._floor_mm, self._seen.floor_px, matrix, bends, flags=cv2.SOLVEPNP_IPPE)
        return np.concatenate([np.zeros(10), turned.ravel(), moved.ravel()])

    def _search(self, start: np.ndarray) -> OptimizeResult:
        return least_squares(self._residuals, start, x_scale=self._scale(), method="lm")

    def calibration(self, solution: OptimizeResult) -> Calibration:
        """Return the solution as a calibration, with how sure it is."""
        draft = self._at(solution.x)
        off = draft.to_pixels(self._placed(solution.x)) - self._floor_px(solution.x[0])
        return draft.model_copy(
            update={
                "reprojection_px": float(np.sqrt((off**2).sum(axis=1).mean())),
                "uncertainty_mm": self._uncertainty_mm(solution, draft),
            }
        )

    def misplaced(self, solution: OptimizeResult) -> tuple[int, float]:
        """Return the marker on the floor that lies farthest from where it should, and how far in mm."""
        off_px = self._at(solution.x).to_pixels(self._floor_mm) - self._floor_px(solution.x[0])
        seen_mm = self._mm_per_px * np.linalg.norm(off_px, axis=1).reshape(4, 4).mean(axis=1)
        off_mm = np.maximum(seen_mm, np.linalg.norm(solution.x[2:10].reshape(4, 2), axis=1))
        return self._layout.ids[int(off_mm.argmax())], float(off_mm.max())

    def _placed(self, numbers: np.ndarray) -> np.ndarray:
        """Return where the floor's corners (16, 3) lie, each marker moved from where it should."""
        moved = np.repeat(numbers[2:10].reshape(4, 2), 4, axis=0)
        return self._floor_mm + np.column_stack([moved, np.zeros(16)])

    def _floor_px(self, spread_px: float = 0.0) -> np.ndarray:
        """Return where the floor's corners (16, 2) were seen on the pictures as they came, drawn in by `spread_px`."""
        return self._as_came(_drawn_in(self._seen.floor_px.reshape(4, 4, 2), spread_px)).reshape(16, 2)

    def _as_came(self, pixels: np.ndarray) -> np.ndarray:
        return np.array([self._seen.size[0] - 1, 0]) + pixels * [-1, 1] if self._seen.mirrored else pixels

    def _scale(self) -> np.ndarray:
        pose = [0.05, 0.001] + [0.5] * 8 + [0.01] * 3 + [10.0] * 3
        return np.array(pose if self._lens else [*pose, 0.01, 5.0, 5.0, 0.02])

    def _at(self, numbers: np.ndarray) -> Calibration:
        lens = self._lens
        if lens is None:
            focal = float(np.exp(numbers[16]))
            lens = Lens.model_construct(
                image_size=self._seen.size,
                focal_px=(focal, focal),
                centre_px=(float(numbers[17]), float(numbers[18])),
                distortion=(float(numbers[19]), 0.0, 0.0, 0.0, 0.0),
            )
        return Calibration.model_construct(
            lens=lens,
            rotation_rad=tuple(numbers[10:13].tolist()),
            translation_mm=tuple(numbers[13:16].tolist()),
            mirrored=self._seen.mirrored,
            arena_mm=self._robot.arena_mm,
            layout=self._layout,
            reprojection_px=0.0,
            uncertainty_mm=0.0,
        )

    def _residuals(self, numbers: np.ndarray) -> np.ndarray:
        """Return deviations in standard errors."""
        settings, calibration = self._settings, self._at(numbers)
        off_px = calibration.to_pixels(self._placed(numbers)) - self._floor_px(numbers[0])
        tolerances = np.array([settings.spread_px, settings.printed_share, *[settings.placed_mm] * 8])
        parts = [off_px.ravel() / settings.corner_px, numbers[:10] / tolerances]
        if len(self._seen.vehicles_px):
            pixels = self._as_came(_drawn_in(self._seen.vehicles_px, numbers[0])).reshape(-1, 2)
            seen_mm = calibration.to_arena(pixels, self._marker.height_mm).reshape(-1, 4, 2)
            square = fitted_square(seen_mm, square_corners_mm(self._marker.size_mm * (1 + numbers[1])))
            parts.append((seen_mm - square).ravel() / (self._mm_per_px * settings.corner_px))
        if self._lens is None:
            width, height = self._seen.size
            off = (numbers[17:19] - np.array([width - 1, height - 1]) / 2) / (settings.centre_share * width)
            focal = (numbers[16] - np.log(settings.usual_focal * width)) / settings.log_focal
            parts.append(np.array([*off, focal, numbers[19] / settings.k1]))
        parts.append(self._off_by_hand(calibration))
        return np.concatenate(parts)

    def _off_by_hand(self, calibration: Calibration) -> np.ndarray:
        """Return how far the camera is from where it was measured to hang, in standard errors, (0 to 3,)."""
        settings, by_hand, camera_mm = self._settings, self._by_hand, calibration.camera_mm
        off: list[float] = []
        if by_hand.camera_height_mm is not None:
            off.append((camera_mm[2] / by_hand.camera_height_mm - 1) / settings.camera_height_share)
        if by_hand.camera_above_mm is not None:
            off.extend((camera_mm[:2] - by_hand.camera_above_mm) / settings.camera_above_mm)
        return np.array(off)

    def _uncertainty_mm(self, solution: OptimizeResult, draft: Calibration) -> float:
        """Return the standard error of where a vehicle's marker is, in the arena's worst corner."""
        covariance = np.linalg.pinv(solution.jac.T @ solution.jac)
        low, high = self._robot.arena_mm.low_mm, self._robot.arena_mm.high_mm
        corners = np.array([[x, y, self._marker.height_mm] for x in (low[0], high[0]) for y in (low[1], high[1])])
        pixels = draft.to_pixels(corners)
        changes = []
        for index, step in enumerate(self._scale() * 1e-3):
            other = solution.x.copy()
            other[index] += step
            changes.append((self._at(other).to_arena(pixels, self._marker.height_mm) - corners[:, :2]) / step)
        slope = np.array(changes)
        variance = np.einsum("ink,ij,jnk->n", slope, covariance, slope)
        return float(np.sqrt(variance.max()))


def _drawn_in(corners: np.ndarray, spread_px: float) -> np.ndarray:
    """Return corners (S, 4, 2) each moved towards the middle by so much along both axes of its marker."""
    outwards = corners - corners.mean(axis=1, keepdims=True)
    length = np.linalg.norm(outwards, axis=2, keepdims=True).mean(axis=1, keepdims=True)
    return corners - outwards * (np.sqrt(2) * spread_px / length)
