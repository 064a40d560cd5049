from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from tiny_worlds import Scripted, one_world, task_named, world_of

from swarmtwin.robot import Robot
from swarmtwin.standin.overhead_camera import OverheadCamera
from swarmtwin.world.rendering.canvas import COLOURS, Panel, rgb
from swarmtwin.world.rendering.drawing import draw, side_by_side
from swarmtwin.world.rendering.frame import Status, frame_of
from swarmtwin.world.rendering.paths import paths_figure
from swarmtwin.world.rendering.video import pictures, write_video
from swarmtwin.world.rollout import roll_out
from swarmtwin.world.world import World

MGR = Robot.load(Path(__file__).resolve().parents[2] / "conf" / "robot" / "mgr.yaml")


@pytest.fixture(scope="module")
def rollout():
    """A short roll-out of the group in which somebody collides."""
    task = task_named("collective", steps=40, vehicles=2, hold_s=1.0)
    line = np.linspace(350.0, 40.0, 41)
    path = np.stack(
        [np.stack([515 + side * line, np.full(41, 515.0), np.full(41, 0.3)], axis=-1) for side in (-1, 1)], 1
    )
    world = World(task, Scripted(task.robot, path[1:, None]), 1, 0)
    world.start(one_world(task, path[0], (515.0, 515.0)))
    return roll_out(world, lambda observation: np.zeros(world.shape))


def colour_at(picture, frame, position_mm):
    column, row = np.round(Panel(frame.arena).at(np.array(position_mm))).astype(int)
    return tuple(picture[row, column].tolist())


def test_vehicles_are_drawn_where_they_are(rollout):
    frame = frame_of(rollout, 0, 5, "simulation")
    picture = draw(frame)
    assert picture.dtype == np.uint8
    for vehicle, (x_mm, y_mm, heading_rad) in enumerate(frame.path[-1]):
        backwards = np.array([x_mm, y_mm]) - 38 * np.array([np.cos(heading_rad), np.sin(heading_rad)])
        assert colour_at(picture, frame, backwards) == rgb(COLOURS.vehicle(vehicle))
    assert colour_at(picture, frame, (30.0, 970.0)) == (255, 255, 255)


def test_the_front_is_marked_and_up_is_up(rollout):
    frame = frame_of(rollout, 0, 0, "simulation")
    x_mm, y_mm, heading_rad = frame.path[-1, 0]
    front = np.array([x_mm, y_mm]) + 28 * np.array([np.cos(heading_rad), np.sin(heading_rad)])
    assert colour_at(draw(frame), frame, front) == (255, 255, 255)
    panel = Panel(frame.arena)
    assert panel.at(np.array([0.0, 1000.0]))[1] < panel.at(np.array([0.0, 0.0]))[1]


def test_between_two_periods_vehicles_are_in_between(rollout):
    before, between, after = (frame_of(rollout, 0, periods, "").path[-1] for periods in (3, 3.5, 4))
    assert between == pytest.approx((before + after) / 2)
    assert frame_of(rollout, 0, 3.5, "").time_s == 1.75


def test_the_status_tells_what_has_happened_so_far(rollout):
    reached, collided = int(rollout.reached_step[0]), int(rollout.collided_step[0])
    assert 0 < reached < collided
    assert frame_of(rollout, 0, 0, "").status is Status.ON_THE_WAY
    assert frame_of(rollout, 0, reached, "").status is Status.REACHED
    assert frame_of(rollout, 0, collided - 1, "").status is Status.REACHED
    assert frame_of(rollout, 0, collided, "").status is Status.COLLIDED
    assert frame_of(rollout, 0, 40, "").colliding.all()
    assert frame_of(rollout, 0, 1000, "").time_s == 20


def test_square_pictures_stand_side_by_side_and_wide_ones_one_under_the_other():
    square, wide = np.zeros((720, 674, 3), np.uint8), np.zeros((630, 1080, 3), np.uint8)
    assert side_by_side([square, square]).shape == (720, 1348, 3)
    assert side_by_side([wide, wide]).shape == (1260, 1080, 3)


def test_a_video_has_the_right_number_of_frames_and_plays(rollout, tmp_path):
    path = tmp_path / "video.mp4"
    images = list(pictures({"simulation": rollout, "stand-in": rollout}, world=0, speed=10))
    assert len(images) == 2 * 24 + 1 + 36
    write_video(path, images)
    assert [file.name for file in tmp_path.iterdir()] == ["video.mp4"]
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert stream.average_rate == 24
        decoded = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
    assert len(decoded) == len(images)
    assert decoded[0].shape == images[0].shape == (720, 1348, 3)
    assert np.abs(decoded[-1].astype(float) - images[-1]).mean() < 3
    capture = cv2.VideoCapture(str(path))
    assert int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) == len(images)
    assert capture.read()[0]


def test_a_video_that_breaks_off_leaves_the_old_one(tmp_path):
    path = tmp_path / "video.mp4"
    path.write_bytes(b"old")

    def broken():
        yield np.zeros((64, 64, 3), np.uint8)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(path, broken())
    assert path.read_bytes() == b"old"
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("images", [[], [np.zeros((63, 64, 3), np.uint8)]])
def test_a_video_needs_pictures_of_an_even_size(tmp_path, images):
    with pytest.raises(ValueError, match="a video needs pictures of an even width and height"):
        write_video(tmp_path / "video.mp4", images)


@pytest.mark.parametrize("name", ["collective", "obstacle", "pair"])
def test_every_task_can_be_drawn(name):
    world = world_of(task_named(name), worlds=1)
    played = roll_out(world, lambda observation: np.tile(world.robot.command_high / 2, (1, world.shape[1], 1)))
    picture = draw(frame_of(played, 0, 3, "simulation"))
    assert not any(size % 2 for size in picture.shape[:2])
    figure = paths_figure({"simulation": played, "stand-in": played}, 0)
    titles = [panel.get_title() for panel in figure.axes]
    assert len(titles) == 2
    assert titles[1].startswith("stand-in: ")


def test_the_same_pictures_of_an_odd_width_give_the_same_bytes_whatever_lay_in_memory_before(tmp_path):
    """670 is no multiple of 64. The pictures must be made anew each time, or memory holds the same each time, too."""
    camera = OverheadCamera(MGR, ["1", "2"])

    def drive():
        rng = np.random.default_rng(3)
        for k in range(12):
            image = camera.render(np.array([[300 + 5 * k, 400, 0.1 * k], [700, 600 - 4 * k, 1]]), rng)
            yield cv2.cvtColor(image, cv2.COLOR_GRAY2RGB)

    films = set()
    for number in range(5):
        write_video(tmp_path / f"{number}.mp4", drive())
        films.add((tmp_path / f"{number}.mp4").read_bytes())
    assert camera.size[0] % 64
    assert len(films) == 1
