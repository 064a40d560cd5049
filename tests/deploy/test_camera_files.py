"""Videos, folders of pictures and cameras of this machine, and what is said of those that are none."""

import time
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest

from swarmtwin.deploy.camera.camera import CameraLostError
from swarmtwin.deploy.camera.opening import open_camera
from swarmtwin.deploy.camera.usb_camera import UsbCamera
from swarmtwin.errors import UserError

SIZE = (96, 64)


def all_frames(camera):
    frames = []
    while (frame := camera.next_frame(frames[-1].number if frames else -1)) is not None:
        frames.append(frame)
    return frames


def grey(brightness, size=SIZE):
    return np.full(size[::-1], brightness, np.uint8)


def make_video(path, times_ms, codec="libx264", size=SIZE):
    """A video whose pictures grow brighter, each shown at its time."""
    with av.open(str(path), "w") as file:
        stream = file.add_stream(codec, rate=30)
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        stream.codec_context.time_base = stream.time_base = Fraction(1, 1000)
        for number, time_ms in enumerate(times_ms):
            frame = av.VideoFrame.from_ndarray(grey(10 * number % 250, size), format="gray").reformat(format="yuv420p")
            frame.pts, frame.time_base = time_ms, stream.codec_context.time_base
            file.mux(stream.encode(frame))
        file.mux(stream.encode(None))
    return path


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
def test_every_picture_of_a_video_comes_at_the_time_it_states(tmp_path, suffix):
    times_ms = [500, 533, 566, 700, 733, 900, 933, 1000, 1500]
    camera = open_camera(str(make_video(tmp_path / f"run.{suffix}", times_ms)))
    frames = all_frames(camera)
    assert not camera.is_live
    assert camera.size == SIZE
    assert [frame.number for frame in frames] == list(range(9))
    np.testing.assert_allclose([frame.captured_s for frame in frames], (np.array(times_ms) - 500) / 1000, atol=2e-3)
    np.testing.assert_allclose([frame.image.mean() for frame in frames], 10 * np.arange(9), atol=3)
    assert camera.next_frame(8) is None
    camera.close()
    camera.close()


def test_a_video_that_breaks_off_or_is_damaged_is_said_to_be(tmp_path):
    whole = make_video(tmp_path / "whole.mkv", range(0, 3000, 33))
    (tmp_path / "cut.mkv").write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    try:
        assert 0 < len(all_frames(open_camera(str(tmp_path / "cut.mkv")))) < 91
    except UserError as error:
        assert "cut.mkv is damaged" in str(error)  # noqa: PT017
    (tmp_path / "none.mp4").write_bytes(b"no video at all")
    with pytest.raises(UserError, match=r"none.mp4 is no video"):
        open_camera(str(tmp_path / "none.mp4"))
    with av.open(str(tmp_path / "sound.wav"), "w") as file:
        stream = file.add_stream("pcm_s16le", rate=8000)
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), layout=stream.layout.name)
        sound.sample_rate = 8000
        file.mux(stream.encode(sound))
    with pytest.raises(UserError, match=r"sound.wav has no pictures"):
        open_camera(str(tmp_path / "sound.wav"))


def test_pictures_of_a_folder_come_by_their_numbers(tmp_path):
    for number in (1, 2, 10, 9):
        cv2.imwrite(str(tmp_path / f"picture{number}.png"), grey(number))
    (tmp_path / "notes.txt").write_text("not one of them")
    camera = open_camera(tmp_path.as_posix())
    assert [frame.image.mean() for frame in all_frames(camera)] == [1, 2, 9, 10]
    assert camera.size == SIZE


def test_a_folder_s_table_states_times_and_order(tmp_path):
    for name in "abc":
        cv2.imwrite(str(tmp_path / f"{name}.png"), grey(ord(name)))
    (tmp_path / "times.csv").write_text("file,time_s,note\nc.png,0.25,\na.png,1.5,late\n")
    frames = all_frames(open_camera(str(tmp_path)))
    assert [(frame.captured_s, frame.image.mean()) for frame in frames] == [(0.25, ord("c")), (1.5, ord("a"))]


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("file,when\na.png,1\n", "times.csv has no column 'time_s'"),
        ("file,time_s\na.png,soon\n", "times.csv, line 2: 'soon' is no time"),
        ("file,time_s\na.png,nan\n", "line 2: 'nan' is no time"),
        ("file,time_s\na.png\n", "line 2: None is no time"),
        ("file,time_s\na.png,1\na.png,2\n", "line 3: a.png is there twice"),
        ("file,time_s\nb.png,1\n", "line 2: there is no picture 'b.png'"),
        ("file,time_s\n", "holds no pictures"),
    ],
)
def test_a_wrong_table_of_times(tmp_path, table, message):
    cv2.imwrite(str(tmp_path / "a.png"), grey(1))
    (tmp_path / "times.csv").write_text(table)
    with pytest.raises(UserError, match=message):
        open_camera(str(tmp_path))


def test_a_single_picture_is_a_camera_too(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((10, 20, 3), np.uint8))
    camera = open_camera(str(tmp_path / "a.png"))
    assert len(all_frames(camera)) == 1
    assert camera.size == (20, 10)


def test_folders_that_are_no_camera_s(tmp_path):
    with pytest.raises(UserError, match="holds no pictures"):
        open_camera(str(tmp_path))
    (tmp_path / "a.png").write_bytes(b"no picture")
    with pytest.raises(UserError, match=r"a.png is no picture"):
        open_camera(str(tmp_path))
    cv2.imwrite(str(tmp_path / "a.png"), grey(1))
    cv2.imwrite(str(tmp_path / "b.png"), grey(1, (32, 32)))
    with pytest.raises(UserError, match=r"b.png has 32 x 32 pixels and a.png has 96 x 64"):
        all_frames(open_camera(str(tmp_path)))


@pytest.mark.parametrize("source", ["", "nowhere.mp4", "-1", "http:/mistyped"])
def test_what_is_not_there(source):
    with pytest.raises(UserError, match=f"camera={source}: there is no such file or folder"):
        open_camera(source)


@pytest.mark.parametrize("source", [97, "97", "/dev/video97"])
def test_a_camera_that_this_machine_has_not(source, capfd):
    with pytest.raises(UserError, match=r"there is no camera .*97 of this machine"):
        open_camera(source)
    assert capfd.readouterr().err == ""


class Device:
    """What cv2.VideoCapture of a camera does: gives a picture every 10 ms until it is pulled out."""

    def __init__(self, plugged, brightness=50):
        self.plugged, self.brightness, self.released = plugged, brightness, False

    def isOpened(self):  # noqa: N802
        return self.plugged()

    def grab(self):
        time.sleep(0.01)
        self.brightness += 1
        return self.plugged()

    def retrieve(self):
        return True, grey(self.brightness % 250)

    def release(self):
        self.released = True


def test_a_camera_of_this_machine_gives_its_newest_picture_until_it_is_pulled_out():
    plugged, opened = [True], []

    def open_device():
        opened.append(Device(lambda: plugged[0]))
        return opened[-1]

    camera = UsbCamera(open_device, "camera 0", pause_s=0.02)
    first = camera.next_frame()
    time.sleep(0.1)
    begin_s = time.monotonic()
    frame = camera.next_frame(first.number)
    assert frame.number > first.number + 3
    assert 0 <= begin_s - frame.captured_s < 0.05
    plugged[0] = False
    time.sleep(0.1)
    number = camera.next_frame().number
    with pytest.raises(CameraLostError, match=r"camera 0 has given no picture for 0\.\d s: it is gone"):
        camera.next_frame(number, timeout_s=0.1)
    plugged[0] = True
    assert camera.next_frame(number).number == number + 1
    camera.close()
    assert all(device.released for device in opened)
