"""Rendered pictures with the truth: a group of vehicles at random poses under a camera of some conditions."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any

import cv2
import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from swarmtwin.deploy.tracking.calibration import Calibration, Lens
from swarmtwin.deploy.tracking.calibration_fit import FitSettings, MeasuredByHand
from swarmtwin.markers import ArenaMarkers, arena_markers, marker_of
from swarmtwin.robot import Robot
from swarmtwin.standin.overhead_camera import CameraConditions, OverheadCamera
from swarmtwin.strict_model import StrictModel
from swarmtwin.world.scenario import draw_apart


class Case(StrictModel):
    """What is hard about the pictures of a case.

    Attributes:
        title: what people call it.
        camera: what of `CameraConditions` is not as each seed draws it.
        marker_mm: size of the vehicles' markers; None: as the robot's file says.
        speed_share: how fast the vehicles drive, as a share of their top speed.
        jpeg_quality: of the pictures' compression; None: they are not compressed.
        laid_mm: standard deviation, along x and y, of where the arena's markers lie from where they should.
        calibrated_while_standing: the vehicles stay where they are on the pictures for the calibration; else they stand
            elsewhere on each.
    """

    title: str
    camera: dict[str, Any] = Field(default_factory=dict)
    marker_mm: Annotated[float, Field(gt=0)] | None = None
    speed_share: Annotated[float, Field(ge=0, le=1)] = 0.0
    jpeg_quality: Annotated[int, Field(ge=1, le=100)] | None = None
    laid_mm: Annotated[float, Field(ge=0)] = 0.0
    calibrated_while_standing: bool = False


class Hand(StrictModel):
    """How well somebody measures by hand where the camera hangs.

    Attributes:
        height_share: standard error of the camera's height by a tape measure, as a share of it.
        plumb_mm: standard error, along x and y, of the point below the lens by a plumb line.
    """

    height_share: Annotated[float, Field(gt=0)] = 0.01
    plumb_mm: Annotated[float, Field(gt=0)] = 5.0


@dataclass(frozen=True)
class Scene:
    """One picture and what is true of it.

    Attributes:
        image: (H, W) uint8.
        pose: (V, 3) true poses in the arena's frame, mm and rad.
    """

    image: np.ndarray
    pose: np.ndarray


class Scenes:
    """Pictures of one camera, hung up as a seed says.

    Attributes:
        robot: whose vehicles are seen, with the marker that they bear in this case.
        vehicles: their names.
        camera: that sees them.
        by_hand: where the camera hangs as somebody measured it.
        fit_settings: of a calibration that knows how well that was measured.
    """

    def __init__(
        self, robot: Robot, vehicles: tuple[str, ...], case: Case, seed: int, hand: Hand | None = None
    ) -> None:
        """Hang the camera up: height, tilt, turn, lens and middle as seeds draw them, but for what the case says.

        Args:
            robot: whose vehicles are seen.
            vehicles: their names.
            case: what is hard.
            seed: of the camera, the poses and the noise.
            hand: how well somebody measures; None: as the defaults say.

        Raises:
            UserError: the case's conditions make no sense, or the robot has no marker.
        """
        marker = marker_of(robot)
        size_mm = marker.size_mm if case.marker_mm is None else case.marker_mm
        self.robot = robot.model_copy(update={"marker": marker.model_copy(update={"size_mm": size_mm})})
        self.vehicles = vehicles
        self._case = case
        self._rng = np.random.default_rng([seed, 1])
        chance = np.random.default_rng([seed, 0])
        drawn = _drawn_conditions(chance, seed)
        conditions = CameraConditions.parse({**drawn, **case.camera}, f"case {case.title!r}: camera")
        self._layout = _laid(self.robot, case.laid_mm, chance)
        self.camera = OverheadCamera(self.robot, vehicles, conditions, self._layout)
        hand = hand or Hand()
        height_mm = conditions.camera_height_mm * (1 + hand.height_share * chance.standard_normal())
        x_mm, y_mm = self.camera.optics.place_mm[:2] + hand.plumb_mm * chance.standard_normal(2)
        self.by_hand = MeasuredByHand(height_mm, (x_mm, y_mm))
        self.fit_settings = FitSettings(camera_height_share=hand.height_share, camera_above_mm=hand.plumb_mm)

    def draw(self, count: int) -> Iterator[Scene]:
        """Yield pictures, each with the vehicles elsewhere."""
        for pose in self._poses(count):
            yield self._scene(pose)

    def for_calibration(self, count: int) -> list[np.ndarray]:
        """Return pictures to calibrate with: the vehicles stand on each; no cable hangs there yet."""
        if self.camera.conditions.cables:
            tidy = self.camera.conditions.model_copy(update={"cables": 0})
            camera = OverheadCamera(self.robot, self.vehicles, tidy, self._layout)
        else:
            camera = self.camera
        poses = self._poses(count)
        if self._case.calibrated_while_standing:
            poses = np.broadcast_to(poses[:1], poses.shape)
        return [camera.render(pose, self._rng) for pose in poses]

    def true_calibration(self) -> Calibration:
        """Return the calibration that a perfect one would be."""
        optics = self.camera.optics
        rotation_rad = Rotation.from_matrix(optics.rotation).as_rotvec()  # OpenCV's own is rough near a half turn
        return Calibration(
            lens=Lens(
                image_size=self.camera.size,
                focal_px=(optics.focal_px, optics.focal_px),
                centre_px=tuple(optics.centre_px.tolist()),
                distortion=(optics.k1, 0.0, 0.0, 0.0, 0.0),
            ),
            rotation_rad=tuple(rotation_rad.tolist()),
            translation_mm=tuple((-optics.rotation @ optics.place_mm).tolist()),
            mirrored=self.camera.conditions.mirrored,
            arena_mm=self.robot.arena_mm,
            layout=ArenaMarkers(),
            reprojection_px=0.0,
            uncertainty_mm=0.0,
        )

    def _scene(self, pose: np.ndarray) -> Scene:
        velocity = self._velocities(pose[:, 2]) * self._case.speed_share
        image = self.camera.render(pose, self._rng, velocity=velocity)
        if self._case.jpeg_quality is not None:
            _, content = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, self._case.jpeg_quality])
            image = np.asarray(cv2.imdecode(content, cv2.IMREAD_GRAYSCALE))
        return Scene(image, pose)

    def _poses(self, count: int) -> np.ndarray:
        """Return poses (count, V, 3) of vehicles that lie within the arena and do not touch."""
        reach_mm = max(self.robot.vehicle_size_mm) / 2
        room = self.robot.arena_mm.low_mm + reach_mm, self.robot.arena_mm.high_mm - reach_mm
        nobody = np.empty((count, 0, 3))
        apart_mm = float(np.hypot(*self.robot.vehicle_size_mm))
        places = draw_apart(self._rng, len(self.vehicles), room, apart_mm, nobody)
        headings = self._rng.uniform(-np.pi, np.pi, (count, len(self.vehicles)))
        return np.concatenate([places, headings[..., None]], axis=2)

    def _velocities(self, heading_rad: np.ndarray) -> np.ndarray:
        """Return velocities (V, 3) in the arena's frame at the top of what the robot can: the faster the less it turns.

        Top is the largest displacement in a control period.
        """
        top = self.robot.displacement_limit / self.robot.period_s
        ahead = self._rng.uniform(-1, 1, len(heading_rad))
        turning = (1 - np.abs(ahead)) * self._rng.choice([-1, 1], len(heading_rad))
        speed = top[0] * ahead
        return np.column_stack([speed * np.cos(heading_rad), speed * np.sin(heading_rad), top[2] * turning])


def _laid(robot: Robot, deviation_mm: float, rng: np.random.Generator) -> ArenaMarkers:
    """Return where the arena's markers lie that were laid by hand."""
    centres = np.array([corners.mean(axis=0) for corners in arena_markers(robot).values()])
    centres = centres + rng.normal(0, 1, centres.shape) * deviation_mm
    return ArenaMarkers.parse({"centres_mm": centres.tolist()}, "the arena's markers")


def _drawn_conditions(rng: np.random.Generator, seed: int) -> dict[str, Any]:
    """Return how a camera of the usual kind hangs."""
    return {
        "seed": seed,
        "camera_height_mm": rng.uniform(1700, 2600),
        "tilt_deg": rng.uniform(-3, 3),
        "turned_deg": rng.uniform(-8, 8),
        "k1": rng.uniform(-0.06, 0.01),
        "off_centre_px": tuple(rng.uniform(-8, 8, 2).tolist()),
    }
