"""`swarmtwin calibrate`: the file says where the emulated camera truly hangs; what cannot be calibrated is refused."""

import cv2
import numpy as np
import pytest

from overhead import Scene
from swarmtwin.commands import calibrate
from swarmtwin.deploy.tracking.calibration import Calibration
from swarmtwin.errors import UserError
from swarmtwin.markers import ArenaMarkers


@pytest.fixture
def options(robots, tmp_path):
    def with_changes(pictures, **changes):
        folder = tmp_path / "pictures"
        folder.mkdir(exist_ok=True)
        for number, picture in enumerate(pictures):
            cv2.imwrite(str(folder / f"{number}.png"), picture)
        robot = robots["mgr"]
        chosen = {
            "robot": robot.model_dump() | {"marker": robot.marker.model_dump()},
            "camera": str(folder),
            "pictures": 12,
            "camera_height_mm": None,
            "camera_above_mm": None,
            "markers": ArenaMarkers().model_dump(),
            "board": {"pictures": None},
            "output": str(tmp_path / "lab" / "calibration.yaml"),
            "overwrite": False,
        }
        return calibrate.Options.parse(chosen | changes, "swarmtwin calibrate")

    return with_changes


def largest_error_mm(scene, calibration, height_mm):
    grid = np.stack(np.meshgrid(np.linspace(0, 1030, 9), np.linspace(0, 1030, 9)), axis=-1).reshape(-1, 2)
    found = calibration.to_arena(scene.seen_at(grid, height_mm), height_mm)
    return np.linalg.norm(found - grid, axis=1).max()


def test_it_leaves_a_file_and_a_picture_that_shows_the_fence_where_it_is(options, robots, tmp_path, capsys):
    scene = Scene(robots["mgr"])
    figures = calibrate.run(options(scene.pictures(4), camera_height_mm=2000))
    calibration = Calibration.load(tmp_path / "lab" / "calibration.yaml")
    assert largest_error_mm(scene, calibration, 45.0) < 0.3
    assert figures["reprojection_px"] < 0.1
    assert "camera 200" in capsys.readouterr().out
    picture = cv2.imread(str(tmp_path / "lab" / "calibration.png")).astype(int)
    yellow = (picture[..., 2] > 180) & (picture[..., 1] > 150) & (picture[..., 0] < 120)
    for x_px, y_px in scene.seen_at(np.array([[515, 0], [1030, 515], [515, 1030], [0, 700]])):
        assert yellow[round(y_px) - 1 : round(y_px) + 2, round(x_px) - 1 : round(x_px) + 2].any()


def test_a_stored_calibration_is_the_same(options, robots, tmp_path):
    calibrate.run(options(Scene(robots["mgr"]).pictures(2)))
    path = tmp_path / "lab" / "calibration.yaml"
    calibration = Calibration.load(path)
    calibration.save(tmp_path / "again.yaml")
    assert (tmp_path / "again.yaml").read_text() == path.read_text()
    with pytest.raises(UserError, match=r"calibration.yaml exists: give another output, or overwrite=true"):
        calibrate.run(options([]))


def test_without_vehicles_it_says_that_the_height_is_unsure(options, robots, caplog):
    calibrate.run(options(Scene(robots["mgr"], ()).pictures(2)))
    assert "the camera's height is known poorly" in caplog.text


def covered(picture):
    """The picture with the marker at its upper right covered."""
    hidden = picture.copy()
    hidden[:80, -80:] = 90
    return hidden


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (covered, "3 of the arena's four markers are seen, and not 48 of DICT_4X4_50"),
        (lambda picture: np.full_like(picture, 90), "0 of the arena's four markers are seen"),
        (lambda picture: np.vstack([picture, picture]), "marker 46 is there twice"),
    ],
)
def test_pictures_that_do_not_show_the_arena_are_refused(options, robots, tmp_path, change, said):
    with pytest.raises(UserError, match=said):
        calibrate.run(options([change(Scene(robots["mgr"]).picture(0.0))]))
    assert not (tmp_path / "lab").exists()


@pytest.mark.parametrize(
    "stated",
    [
        {"ids": [47, 46, 48, 49]},
        {"ids": [49, 46, 47, 48]},
        {"size_mm": 60},
        {"centres_mm": [[-50, -50], [1080, -50], [1080, 1080], [-20, 1080]]},
    ],
)
def test_markers_that_lie_elsewhere_than_stated_are_refused(options, robots, stated):
    with pytest.raises(
        UserError,
        match=r"are not seen where they should lie: marker \d+ is off by \d+ mm.*check which marker lies at which",
    ):
        calibrate.run(options(Scene(robots["mgr"]).pictures(1), markers=stated))


def test_the_output_must_be_a_yaml_file(options):
    with pytest.raises(UserError, match=r"a calibration is a YAML file: give it the ending .yaml"):
        calibrate.run(options([], output="calibration"))
