"""Camera effects change what is measured, not what moves."""

import numpy as np
from pairs import session, true_displacements

from swarmtwin.geometry import displacement_between
from swarmtwin.standin.exact_means import mean_given_state
from swarmtwin.standin.session import drive_session


def test_camera_scale_scales_translation_and_not_rotation(robots):
    robot = robots["mgr"]
    plain, changed = (
        mean_given_state(drive_session(session(robot, *entries)))
        for entries in ((), ({"name": "camera_scale", "scale": 1.1},))
    )
    np.testing.assert_allclose(changed[..., :2], 1.1 * plain[..., :2], atol=1e-3)
    np.testing.assert_allclose(changed[..., 2], plain[..., 2], atol=1e-5)


def test_lens_distortion_leaves_the_centre_and_magnifies_the_edge(robots):
    robot = robots["mgr"]
    conditions = session(robot, {"name": "lens_distortion", "coefficient": 0.2}).conditions
    centre, corner = np.array([515.0, 515.0, 1.0]), np.array([1030.0, 1030.0, 1.0])
    np.testing.assert_allclose(conditions.seen(centre), centre)
    np.testing.assert_allclose(conditions.seen(corner), [515 + 515 * 1.2, 515 + 515 * 1.2, 1.0])


def test_a_marker_off_the_centre_swings_with_the_turn(robots):
    robot = robots["mgr"]
    offset = np.array([9.0, -4.0])
    entry = {"name": "marker_offset", "forward_mm": 9, "left_mm": -4}
    plain, changed = (drive_session(session(robot, *entries)) for entries in ((), (entry,)))
    conditions = changed.session.conditions
    pose = np.moveaxis(changed.state[:3], 0, -1)
    seen = displacement_between(conditions.seen(pose)[:, :-1], conditions.seen(pose)[:, 1:])
    true = true_displacements(plain)
    cos, sin = np.cos(true[..., 2]), np.sin(true[..., 2])
    swing = np.stack([(cos - 1) * offset[0] - sin * offset[1], sin * offset[0] + (cos - 1) * offset[1]], axis=-1)
    np.testing.assert_allclose(seen[..., :2], true[..., :2] + swing, atol=1e-9)
    np.testing.assert_allclose(seen[..., 2], true[..., 2], atol=1e-9)


def test_a_turned_marker_turns_the_measured_translation_back(robots):
    robot = robots["mgr"]
    plain, changed = (
        mean_given_state(drive_session(session(robot, *entries)))
        for entries in ((), ({"name": "marker_yaw", "angle_rad": 0.3},))
    )
    forward, left = plain[..., 0], plain[..., 1]
    np.testing.assert_allclose(changed[..., 0], np.cos(0.3) * forward + np.sin(0.3) * left, atol=1e-3)
    np.testing.assert_allclose(changed[..., 1], np.cos(0.3) * left - np.sin(0.3) * forward, atol=1e-3)
    np.testing.assert_allclose(changed[..., 2], plain[..., 2], atol=1e-6)
