"""Calibrations against the emulated camera's true optics, which are written without OpenCV."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from overhead import Scene
from swarmtwin.deploy.tracking.calibration import Calibration, Lens
from swarmtwin.deploy.tracking.calibration_fit import MeasuredByHand, fit_calibration, loaded_or_fitted
from swarmtwin.deploy.tracking.lens_board import Board, measure_lens
from swarmtwin.deploy.tracking.rigid_fit import fitted_poses, fitted_square
from swarmtwin.errors import UserError
from swarmtwin.geometry import compose, residual_between
from swarmtwin.markers import ArenaMarkers, square_corners_mm
from swarmtwin.standin.rendering.pinhole import Pinhole, hanging_camera

GRID_MM = np.stack(np.meshgrid(np.linspace(0, 1030, 6), np.linspace(0, 1030, 6)), axis=-1).reshape(-1, 2)


def with_optics(optics, size, arena, mirrored=False):
    """The calibration that says exactly what optics do."""
    translation = -optics.rotation @ optics.place_mm
    lens = Lens(
        image_size=size,
        focal_px=(optics.focal_px, optics.focal_px),
        centre_px=tuple(optics.centre_px),
        distortion=(optics.k1, 0, 0, 0, 0),
    )
    return Calibration(
        lens=lens,
        rotation_rad=tuple(Rotation.from_matrix(optics.rotation).as_rotvec()),  # OpenCV's own is rough near a half turn
        translation_mm=tuple(translation),
        mirrored=mirrored,
        arena_mm=arena,
        layout=ArenaMarkers(),
        reprojection_px=0,
        uncertainty_mm=0,
    )


@settings(max_examples=40, deadline=None)
@given(
    st.floats(-0.3, 0.3),
    st.floats(-3.1, 3.1),
    st.floats(-0.1, 0.1),
    st.floats(800, 3000),
    st.floats(0, 120),
    st.booleans(),
)
def test_it_agrees_with_optics_written_by_hand_and_undoes_itself(
    robots, tilt, turn, k1, camera_mm, height_mm, mirrored
):
    optics = hanging_camera(np.array([515.0, 515.0]), camera_mm, tilt, turn, 1.9, k1)
    optics = Pinhole(optics.focal_px, np.array([330.0, 340.0]), k1, optics.rotation, optics.place_mm)
    calibration = with_optics(optics, (670, 670), robots["mgr"].arena_mm, mirrored)
    points = np.column_stack([GRID_MM, np.full(len(GRID_MM), height_mm)])
    pixels = optics.project(points)
    pixels = [669, 0] + pixels * [-1, 1] if mirrored else pixels
    np.testing.assert_allclose(calibration.to_pixels(points), pixels, atol=1e-3)
    np.testing.assert_allclose(calibration.to_arena(pixels, height_mm), GRID_MM, atol=1e-3)


@settings(max_examples=50, deadline=None)
@given(*[st.floats(-800, 800)] * 2, st.floats(-3.14, 3.14), st.floats(10, 100))
def test_a_square_s_pose_is_found_from_its_corners(x_mm, y_mm, heading, size_mm):
    square, pose = square_corners_mm(size_mm), np.array([[x_mm, y_mm, heading]])
    corners = compose(pose[:, None], np.concatenate([square, np.zeros((4, 1))], axis=1)[None])[..., :2]
    np.testing.assert_allclose(residual_between(pose, fitted_poses(corners, square)), 0, atol=1e-9)
    np.testing.assert_allclose(fitted_square(corners, square), corners, atol=1e-9)


def largest_error_mm(scene, calibration, height_mm):
    found = calibration.to_arena(scene.seen_at(GRID_MM, height_mm), height_mm)
    return np.linalg.norm(found - GRID_MM, axis=1).max()


@pytest.mark.parametrize(
    "conditions",
    [
        {},
        {"tilt_deg": 12, "turned_deg": 180},
        {"off_centre_px": (6, -4), "k1": -0.08, "tilt_deg": 4},
        {"mirrored": True, "turned_deg": 90},
        {"camera_height_mm": 1400, "mm_per_pixel": 1.4},
        {"light": "harsh", "pixel_noise": 5},
    ],
    ids=["usual", "tilted and upside down", "off centre", "mirrored", "near", "harsh"],
)
def test_with_the_height_measured_by_hand_raised_markers_are_where_they_are(robots, conditions):
    scene = Scene(robots["mgr"], **conditions)
    height_mm = conditions.get("camera_height_mm", 2000)
    calibration = fit_calibration(scene.pictures(4), robots["mgr"], by_hand=MeasuredByHand(height_mm))
    assert largest_error_mm(scene, calibration, 45.0) < 0.5
    assert largest_error_mm(scene, calibration, 0.0) < 0.5
    assert calibration.mirrored == conditions.get("mirrored", False)
    np.testing.assert_allclose(calibration.camera_mm[2], scene.camera.optics.place_mm[2], rtol=0.01)


def test_without_it_vehicles_tell_the_height(robots):
    scene = Scene(robots["mgr"])
    calibration = fit_calibration(scene.pictures(), robots["mgr"])
    np.testing.assert_allclose(calibration.camera_mm[2], 2000, rtol=0.06)
    assert largest_error_mm(scene, calibration, 45.0) < 1.0


def test_markers_laid_a_little_aside_do_little_harm(robots):
    centres = ((-50.8, -50.0), (1080.0, -49.5), (1080.6, 1080.4), (-50.0, 1079.4))
    scene = Scene(robots["mgr"], layout=ArenaMarkers(centres_mm=centres))
    calibration = fit_calibration(scene.pictures(4), robots["mgr"], by_hand=MeasuredByHand(2000))
    assert largest_error_mm(scene, calibration, 45.0) < 1.2


def board_picture(board, optics, size, pose):
    """A picture of a printed board that is held before a camera: pose (rotation vector, translation)."""
    texels_per_mm = 4
    width_mm, height_mm = np.array(board.squares) * board.square_mm
    printed = board.printed().generateImage((int(width_mm * texels_per_mm), int(height_mm * texels_per_mm)))
    rows, columns = np.mgrid[: size[1], : size[0]]
    bent = (np.dstack([columns, rows]) - optics.centre_px) / optics.focal_px
    radius = np.linalg.norm(bent, axis=2, keepdims=True)
    straight = radius / (1 + optics.k1 * radius**2)
    for _ in range(20):
        straight = radius / (1 + optics.k1 * straight**2)
    slope = bent * straight / np.maximum(radius, 1e-12)
    rotation, moved = cv2.Rodrigues(np.array(pose[0], float))[0], np.array(pose[1], float)
    to_board = np.linalg.inv(np.column_stack([rotation[:, :2], moved]))
    place = np.dstack([slope, np.ones(slope.shape[:2])]) @ to_board.T
    texel = (place[..., :2] / place[..., 2:] * texels_per_mm - 0.5).astype(np.float32)
    fine = cv2.GaussianBlur(printed, (0, 0), 2.0)
    return cv2.remap(fine, texel[..., 0], texel[..., 1], cv2.INTER_LINEAR, borderValue=128)


def held_boards(board, optics, size):
    poses = [
        ((tilt, slant, 0.2 * index), (-120 + 60 * (index % 3) - 60, -90 + 40 * (index % 2), 560 + 30 * index))
        for index, (tilt, slant) in enumerate(
            [(0.4, 0), (-0.4, 0.1), (0, 0.45), (0.1, -0.45), (0.3, 0.3), (-0.3, -0.35)]
        )
    ]
    return [board_picture(board, optics, size, pose) for pose in poses]


def test_a_board_measures_the_lens(robots):
    optics = Pinhole(700.0, np.array([325.0, 244.0]), -0.12, np.eye(3), np.zeros(3))
    lens = measure_lens(held_boards(Board(), optics, (640, 480)), Board())
    np.testing.assert_allclose(lens.focal_px, 700, rtol=0.004)
    np.testing.assert_allclose(lens.centre_px, [325, 244], atol=3)
    assert lens.distortion[0] == pytest.approx(-0.12, abs=0.02)


def test_a_lens_that_is_known_is_taken_as_it_is(robots):
    scene = Scene(robots["mgr"], off_centre_px=(9, -7), k1=-0.1)
    optics = scene.camera.optics
    lens = with_optics(optics, scene.camera.size, robots["mgr"].arena_mm).lens
    calibration = fit_calibration(scene.pictures(4), robots["mgr"], lens=lens)
    assert calibration.lens == lens
    assert largest_error_mm(scene, calibration, 45.0) < 0.5


def test_boards_that_cannot_be_read_are_refused(robots):
    optics = Pinhole(700.0, np.array([325.0, 244.0]), 0.0, np.eye(3), np.zeros(3))
    pictures = held_boards(Board(), optics, (640, 480))
    with pytest.raises(UserError, match="0 of 6 pictures show the board well, and 6 are needed"):
        measure_lens(pictures, Board(dictionary="DICT_6X6_50"))
    with pytest.raises(UserError, match="do not fit into squares of 30 mm"):
        measure_lens(pictures, Board(marker_mm=31))
    with pytest.raises(UserError, match="differ in size"):
        measure_lens([*pictures, pictures[0][:-10]], Board())


def test_files_that_are_no_calibration_are_refused(robots, tmp_path):
    path = tmp_path / "calibration.yaml"
    with pytest.raises(UserError, match="make one with `swarmtwin calibrate`"):
        Calibration.load(path)
    path.write_text("lens: {focal_px: [1")
    with pytest.raises(UserError, match="is not valid YAML"):
        Calibration.load(path)
    path.write_text("lens: 3")
    with pytest.raises(UserError, match=r"calibration.yaml: field 'lens'"):
        Calibration.load(path)


def test_one_picture_of_another_size_is_refused(robots):
    pictures = Scene(robots["mgr"]).pictures(2)
    with pytest.raises(UserError, match="the pictures differ in size: 670 × 660, 670 × 670"):
        fit_calibration([pictures[0], pictures[1][:-10]], robots["mgr"])


def test_what_was_measured_by_hand_says_where_the_camera_hangs(robots):
    """A plumb line and a tape, each a little wrong, are heeded as far as they can be trusted."""
    scene = Scene(robots["mgr"], tilt_deg=3.0, off_centre_px=(9.0, -7.0))
    true_mm = scene.camera.optics.place_mm
    pictures = scene.pictures(4)
    by_hand = MeasuredByHand(float(true_mm[2]) * 1.003, (float(true_mm[0]) + 2.0, float(true_mm[1]) - 2.0))
    alone, helped = (fit_calibration(pictures, robots["mgr"], by_hand=one) for one in (None, by_hand))
    off_alone, off_helped = (np.abs(one.camera_mm - true_mm) for one in (alone, helped))
    assert off_helped[:2].max() < 6.0
    assert off_helped[2] < 0.01 * true_mm[2]
    assert np.hypot(*off_helped[:2]) < np.hypot(*off_alone[:2])
    assert helped.uncertainty_mm < alone.uncertainty_mm


def test_a_stored_calibration_is_not_mixed_with_what_was_measured_by_hand(robots, tmp_path):
    with pytest.raises(UserError, match="camera_above_mm is of use where the arena's markers calibrate"):
        loaded_or_fitted(tmp_path / "lab.yaml", list, robots["mgr"], MeasuredByHand(None, (500.0, 500.0)))
    with pytest.raises(UserError, match="no calibration"):
        loaded_or_fitted(tmp_path / "lab.yaml", list, robots["mgr"], MeasuredByHand())
