"""The tracker on rendered pictures of known poses: how exact it is, and whom it does not believe."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from overhead import VEHICLES, Scene, poses_at
from swarmtwin.deploy.camera.camera import Frame
from swarmtwin.deploy.tracking.calibration_fit import MeasuredByHand, fit_calibration
from swarmtwin.deploy.tracking.tracker import Tracker, TrackerSettings, vehicle_poses
from swarmtwin.errors import UserError
from swarmtwin.geometry import compose, residual_between

PERIOD_S = 1 / 30


@pytest.fixture(scope="module")
def mgr(robots):
    return robots["mgr"]


@pytest.fixture(scope="module")
def lab(mgr):
    """A camera as usual, and its calibration with a height measured by hand."""
    scene = Scene(mgr)
    return scene, fit_calibration(scene.pictures(), mgr, by_hand=MeasuredByHand(2000))


def errors(scene, tracker, times_s):
    """What the tracker finds minus the truth, (N, 3), and how often a vehicle was not found."""
    off, missed = [], 0
    for number, time_s in enumerate(times_s):
        sighting = tracker.track(Frame(number, time_s, scene.picture(time_s)))
        missed += len(VEHICLES) - len(sighting.poses)
        off += [residual_between(poses_at(time_s)[int(one) - 1], pose) for one, pose in sighting.poses.items()]
    return np.array(off), missed


def test_poses_are_exact_in_ordinary_light(lab, mgr):
    scene, calibration = lab
    off, missed = errors(scene, Tracker(calibration, mgr, VEHICLES), np.arange(0, 8, 0.1))
    assert missed == 0
    assert np.quantile(np.hypot(off[:, 0], off[:, 1]), 0.99) < 0.3
    assert np.quantile(np.abs(off[:, 2]), 0.99) < np.deg2rad(0.3)
    assert np.abs(off[:, :2].mean(axis=0)).max() < 0.15
    assert abs(off[:, 2].mean()) < np.deg2rad(0.02)


@pytest.mark.parametrize(
    ("conditions", "most_missed", "most_mm", "most_deg"),
    [
        ({"turned_deg": 90, "mirrored": True, "tilt_deg": 5}, 0, 0.5, 0.2),
        ({"exposure_s": 0.04}, 0, 0.3, 0.3),
        ({"blur_px": 1.2}, 2, 0.4, 0.3),
        ({"light": "harsh", "pixel_noise": 6}, 20, 1.5, 1.0),
    ],
    ids=["turned and mirrored", "smeared", "out of focus", "harsh light"],
)
def test_poses_are_right_where_the_picture_is_worse(mgr, conditions, most_missed, most_mm, most_deg):
    scene = Scene(mgr, **conditions)
    calibration = fit_calibration(scene.pictures(), mgr, by_hand=MeasuredByHand(2000))
    assert calibration.mirrored == conditions.get("mirrored", False)
    off, missed = errors(scene, Tracker(calibration, mgr, VEHICLES), np.arange(0, 4, 0.1))
    assert missed <= most_missed
    assert np.quantile(np.hypot(off[:, 0], off[:, 1]), 0.99) < most_mm
    assert np.quantile(np.abs(off[:, 2]), 0.99) < np.deg2rad(most_deg)


def test_where_the_marker_sits_on_the_vehicle_is_undone(mgr):
    marker = mgr.marker.model_copy(update={"forward_mm": 18.0, "left_mm": -7.0, "turn_deg": -90.0})
    robot = mgr.model_copy(update={"marker": marker})
    scene = Scene(robot)
    calibration = fit_calibration(scene.pictures(), robot, by_hand=MeasuredByHand(2000))
    off, _ = errors(scene, Tracker(calibration, robot, VEHICLES), np.arange(0, 2, 0.1))
    assert np.hypot(off[:, 0], off[:, 1]).max() < 0.4
    assert np.abs(off[:, 2]).max() < np.deg2rad(0.3)


@settings(max_examples=50, deadline=None)
@given(*[st.floats(-500, 500)] * 4, *[st.floats(-3.1, 3.1)] * 2)
def test_a_vehicle_s_pose_and_its_marker_s_are_each_other_s_inverse(x_mm, y_mm, forward_mm, left_mm, heading, turn):
    pose, on_vehicle = np.array([[x_mm, y_mm, heading]]), np.array([forward_mm, left_mm, turn])
    back = vehicle_poses(compose(pose, on_vehicle[None]), on_vehicle)
    np.testing.assert_allclose(residual_between(pose, back), 0, atol=1e-9)


class Watch:
    """Shows a tracker pictures of vehicles wherever one wants."""

    def __init__(self, lab, robot, vehicles=VEHICLES):
        self.scene, calibration = lab
        self.tracker = Tracker(calibration, robot, vehicles)
        self.number = 0
        self.poses = poses_at(0.0)

    def see(self, pictures=1, hidden=(), change=lambda picture: picture, elapsed_s=PERIOD_S):
        for _ in range(pictures):
            self.number += 1
            self.time_s = getattr(self, "time_s", 0.0) + elapsed_s
            picture = self.scene.camera.render(self.poses, self.scene.rng, hidden=hidden)
            sighting = self.tracker.track(Frame(self.number, self.time_s, change(picture)))
        return sighting


@pytest.fixture
def watch(lab, mgr):
    return Watch(lab, mgr)


def test_who_jumps_is_doubted_until_it_persists(watch):
    assert set(watch.see(3).poses) == set(VEHICLES)
    watch.poses = watch.poses + np.array([[60, 0, 0], *[[0, 0, 0]] * 4])
    sighting = watch.see()
    assert set(sighting.poses) == set("2345")
    assert sighting.doubts["1"].startswith("it jumped by 60 mm and 0° within 0.03 s")
    assert "1" in watch.see(3).doubts
    assert set(watch.see().poses) == set(VEHICLES)


def test_who_jumps_and_comes_back_is_believed_where_it_was(watch):
    watch.see(3)
    before = watch.poses.copy()
    watch.poses = before + np.array([[60, 0, 0], *[[0, 0, 0]] * 4])
    assert "1" in watch.see().doubts
    watch.poses = before
    assert set(watch.see().poses) == set(VEHICLES)


def test_turning_on_the_spot_beyond_belief_is_a_jump(watch):
    watch.see(3)
    watch.poses = watch.poses + np.array([[0, 0, 1.0], *[[0, 0, 0]] * 4])
    assert watch.see().doubts["1"].startswith("it jumped by 0 mm and 57°")


def test_the_fastest_that_a_robot_may_move_is_no_jump(watch, mgr):
    watch.see(3)
    step = mgr.displacement_limit * PERIOD_S / mgr.period_s
    for _ in range(10):
        watch.poses = compose(watch.poses, np.broadcast_to(step, (5, 3)))
        assert set(watch.see().poses) == set(VEHICLES)


def test_two_that_exchange_places_are_both_doubted(watch):
    watch.see(3)
    watch.poses = watch.poses[[1, 0, 2, 3, 4]]
    doubts = watch.see().doubts
    assert doubts == {
        "1": "it appears where vehicle 2 was, and 2 where 1 was",
        "2": "it appears where vehicle 1 was, and 1 where 2 was",
    }


def test_an_exchange_while_nobody_looked_is_noticed(watch):
    watch.see(3)
    watch.see(2, hidden=("1", "2"), elapsed_s=20.0)
    watch.poses = watch.poses[[1, 0, 2, 3, 4]]
    assert set(watch.see().doubts) == {"1", "2"}


def test_who_is_hidden_is_left_out_and_found_again_elsewhere(watch):
    watch.see(3)
    sighting = watch.see(30, hidden=("3",))
    assert set(sighting.poses) == set("1245")
    assert not sighting.doubts
    watch.poses = watch.poses + np.array([*[[0, 0, 0]] * 2, [40, 30, 0.3], *[[0, 0, 0]] * 2])
    assert set(watch.see().poses) == set(VEHICLES)


def with_marker(number, row, column, side_px=32):
    """A change that lays another marker onto the picture."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    printed = cv2.aruco.generateImageMarker(dictionary, number, side_px)
    block = cv2.copyMakeBorder(printed, 9, 9, 9, 9, cv2.BORDER_CONSTANT, value=230).clip(20, 230)

    def change(picture):
        picture = picture.copy()
        picture[row : row + len(block), column : column + len(block)] = block
        return picture

    return change


def test_a_marker_that_is_there_twice_is_doubted_while_it_is(watch):
    watch.see(3)
    sighting = watch.see(12, change=with_marker(2, 310, 40))
    assert sighting.doubts == {"2": "marker 2 is there twice"}
    assert set(sighting.poses) == set("1345")
    assert set(watch.see(TrackerSettings().whole_every).poses) == set(VEHICLES)


def test_strangers_are_named(watch):
    seen = [watch.see(change=with_marker(33, 310, 40)).strangers for _ in range(10)]
    assert (33,) in seen


def test_a_vehicle_that_was_not_asked_for_is_a_stranger(lab, mgr):
    sighting = Watch(lab, mgr, vehicles=("1", "2", "4", "5")).see()
    assert sighting.strangers == (3,)
    assert set(sighting.poses) == set("1245")


def test_a_marker_of_another_size_is_not_believed(watch):
    sighting = watch.see(hidden=("2",), change=with_marker(2, 310, 40, side_px=40))
    assert "its marker seems" in sighting.doubts["2"]
    assert "larger than it is" in sighting.doubts["2"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda picture: np.roll(picture, 12, axis=0), "the camera has moved since it was calibrated"),
        (lambda picture: cv2.rotate(picture, cv2.ROTATE_180), "the picture is upside down"),
        (lambda picture: picture[:600], "670 × 600, and the calibration is for 670 × 670"),
    ],
)
def test_while_the_picture_does_not_fit_the_calibration_nobody_is_believed(watch, change, said):
    watch.see(3)
    sighting = watch.see(3 * TrackerSettings().whole_every, change=change)
    assert not sighting.poses
    assert all(said in reason for reason in sighting.doubts.values())
    assert len(sighting.doubts) == 5
    assert set(watch.see(4 * TrackerSettings().whole_every).poses) == set(VEHICLES)


def test_one_floor_marker_that_is_covered_does_not_matter(watch):
    def covered(picture):
        picture = picture.copy()
        picture[:90, :90] = 100
        return picture

    assert set(watch.see(12, change=covered).poses) == set(VEHICLES)
    watch.tracker.check(covered(watch.scene.picture(0.0)))


def test_looking_only_where_vehicles_were_finds_the_same(lab, mgr):
    scene, calibration = lab
    thorough = Tracker(calibration, mgr, VEHICLES, TrackerSettings(whole_every=1))
    quick = Tracker(calibration, mgr, VEHICLES, TrackerSettings(whole_every=100))
    for number in range(12):
        frame = Frame(number, number * PERIOD_S, scene.picture(number * PERIOD_S))
        whole, part = thorough.track(frame), quick.track(frame)
        assert whole.poses.keys() == part.poses.keys()
        for vehicle, pose in whole.poses.items():
            np.testing.assert_allclose(part.poses[vehicle], pose, atol=0.05)


def test_colour_pictures_are_read_like_grey_ones(watch):
    sighting = watch.see(change=lambda picture: cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR))
    assert set(sighting.poses) == set(VEHICLES)


def test_vehicles_that_cannot_be_told_apart_are_refused(lab, mgr):
    _, calibration = lab
    with pytest.raises(UserError, match="named twice"):
        Tracker(calibration, mgr, ("1", "1"))
    with pytest.raises(UserError, match="has no marker"):
        Tracker(calibration, mgr.model_copy(update={"marker": None}), ("1",))
    with pytest.raises(UserError, match="which lies on the arena's floor"):
        Tracker(calibration, mgr, ("46",))
