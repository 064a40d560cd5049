"""`swarmtwin experiment name=tracking`: truth is true, figures are what was planted, methods see what they should."""

import cv2
import numpy as np
import pandas as pd
import pytest

from swarmtwin.commands.app import run_command
from swarmtwin.errors import UserError
from swarmtwin.studies.tracking.errors import COLUMNS, measured_errors, summary
from swarmtwin.studies.tracking.methods import corners_alone
from swarmtwin.studies.tracking.scenes import Case, Hand, Scenes

VEHICLES = ("1", "2", "3")


@pytest.mark.parametrize("camera", [{}, {"turned_deg": 180.0}, {"mirrored": True}, {"tilt_deg": 25.0, "k1": -0.15}])
def test_the_perfect_calibration_is_the_camera_s_own(robots, camera):
    scenes = Scenes(robots["mgr"], VEHICLES, Case(title="any", camera=camera), seed=3)
    calibration = scenes.true_calibration()
    places = np.random.default_rng(1).uniform(0, 1000, (50, 3)) * [1, 1, 0.05]
    seen = scenes.camera.optics.project(places)
    if camera.get("mirrored"):
        seen = [scenes.camera.size[0] - 1, 0] + seen * [-1, 1]
    np.testing.assert_allclose(calibration.to_pixels(places), seen, atol=1e-6)
    assert calibration.camera_mm[2] == pytest.approx(scenes.camera.conditions.camera_height_mm)
    assert scenes.by_hand.camera_height_mm == pytest.approx(calibration.camera_mm[2], rel=0.04)
    assert scenes.by_hand.camera_above_mm == pytest.approx(calibration.camera_mm[:2], abs=20)


def test_pictures_show_the_poses_that_are_said_to_be_true_and_a_seed_says_all(robots):
    case = Case(title="fast", speed_share=1.0, camera={"exposure_s": 0.02}, jpeg_quality=90)
    scenes, again = (Scenes(robots["mgr"], VEHICLES, case, seed=4) for _ in range(2))
    look = corners_alone(scenes.true_calibration(), scenes.robot, VEHICLES, cv2.aruco.CORNER_REFINE_NONE)
    for scene, same in zip(scenes.draw(3), again.draw(3), strict=True):
        found = look(scene.image)
        for vehicle, pose in zip(VEHICLES, scene.pose, strict=True):
            np.testing.assert_allclose(found[vehicle][:2], pose[:2], atol=2.5)
        np.testing.assert_array_equal(scene.image, same.image)


def test_while_calibrating_vehicles_stand_elsewhere_or_not_and_no_cable_hangs(robots):
    def largest_change(**case):
        scenes = Scenes(robots["mgr"], VEHICLES, Case(title="any", **case), seed=5)
        pictures = [picture.astype(int) for picture in scenes.for_calibration(3)]
        return max(np.abs(picture - pictures[0]).max() for picture in pictures[1:]), pictures[0]

    assert largest_change()[0] > 80
    assert largest_change(calibrated_while_standing=True)[0] < 30
    tidy, cables = largest_change()[1], largest_change(camera={"cables": 5})[1]
    assert np.abs(tidy - cables).max() < 30


def planted(off_x_mm=0.0, off_rad=0.0, count=4000, seed=1, noise_mm=0.1):
    """Rows of a method that is off by so much, and by noise."""
    rng = np.random.default_rng(seed)
    noise = rng.normal(0, noise_mm, (count, 2))
    rows = pd.DataFrame(0.0, index=range(count), columns=COLUMNS)
    rows["off_x_mm"], rows["off_y_mm"], rows["off_rad"] = off_x_mm + noise[:, 0], noise[:, 1], off_rad
    rows["seed"], rows["picture"], rows["ms"] = seed, np.arange(count) // 5, 7.0
    return rows


def test_the_summary_finds_planted_errors():
    found = summary(planted(noise_mm=0.1))
    assert found["p50_mm"] == pytest.approx(0.1 * np.sqrt(2 * np.log(2)), rel=0.05)
    assert found["p99_mm"] == pytest.approx(0.1 * np.sqrt(2 * np.log(100)), rel=0.05)
    assert found["bias_mm"] < 0.01
    worst = summary(pd.concat([planted(-0.3, seed=1), planted(0.4, seed=2), planted(0.0, seed=3)]))
    assert worst["bias_mm"] == pytest.approx(0.4, abs=0.01)
    turned = summary(planted(off_rad=np.deg2rad(-0.2)))
    assert turned["p99_deg"] == pytest.approx(0.2)
    assert turned["bias_deg"] == pytest.approx(0.2)
    missing = planted()
    missing.loc[:999, ["off_x_mm", "off_y_mm", "off_rad"]] = np.nan
    missing.loc[1000:1099, "off_x_mm"] = 50.0
    assert summary(missing)["found_share"] == 0.75
    assert summary(missing)["wrong_share"] == 0.025
    assert summary(missing.assign(off_x_mm=np.nan))["found_share"] == 0.0


def test_a_homography_of_the_floor_is_off_by_the_marker_s_parallax_and_our_tracker_is_not(robots):
    camera = {"k1": 0.0, "tilt_deg": 0.0, "camera_height_mm": 2000.0, "off_centre_px": (0.0, 0.0)}
    rows, _ = measured_errors(robots["mgr"], VEHICLES, Case(title="plain", camera=camera), 6, 4, 3, Hand())
    by_method = dict(iter(rows.groupby("method")))
    flat = by_method["homography"]
    height_mm = robots["mgr"].marker.height_mm
    middle = 515.0
    parallax = height_mm / (2000.0 - height_mm)
    np.testing.assert_allclose(flat.off_x_mm, (flat.x_mm - middle) * parallax, atol=0.5)
    np.testing.assert_allclose(flat.off_y_mm, (flat.y_mm - middle) * parallax, atol=0.5)
    ours = summary(by_method["perfect"])
    assert ours["found_share"] == 1.0
    assert ours["p99_mm"] < 0.1
    assert ours["p99_deg"] < 0.15
    assert summary(by_method["measured_height"])["p99_mm"] < 0.4
    assert summary(by_method["measured_place"])["p99_mm"] < 0.4


def test_the_command_leaves_table_errors_and_pictures_and_says_what_it_does_not_know(workplace, capfd):
    few = ["name=tracking", "vehicles=[1,2]", "pictures=1", "seeds=1", "calibrated_on=2"]
    assert run_command("experiment", [*few, "cases=[mirrored]", "output=out"]) == 0
    table = pd.read_csv("out/table.csv").set_index("method")
    assert table.found_share["tracker"] == 1.0
    assert table.found_share["subpixel"] == 0.0
    assert len(pd.read_parquet("out/errors.parquet")) == 2 * len(table)
    for name in ("errors.png", "samples.png", "samples/mirrored.png", "metrics.json"):
        assert (workplace / "out" / name).stat().st_size > 100
    assert run_command("experiment", [*few, "cases=[mirored]", "output=other"]) == 2
    assert "did you mean 'mirrored'" in capfd.readouterr().err


def test_conditions_that_make_no_sense(robots):
    with pytest.raises(UserError, match=r"case 'odd': camera.*tilt"):
        Scenes(robots["mgr"], VEHICLES, Case(title="odd", camera={"tilt": 3}), seed=1)
