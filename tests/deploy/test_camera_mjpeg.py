"""MJPEG over HTTP from a server that keeps to the convention, and from such that do not."""

import socket
import threading
import time

import numpy as np
import pytest
from mjpeg_server import MjpegServer, jpeg, part

from swarmtwin.deploy.camera.camera import CameraLostError
from swarmtwin.deploy.camera.mjpeg_stream import MjpegStream
from swarmtwin.deploy.camera.multipart import MultipartReader
from swarmtwin.deploy.camera.opening import open_camera
from swarmtwin.errors import UserError


def steady(period_s=0.01, **fields):
    """A stream whose pictures grow brighter, each stamped 1000 s ahead of this machine's clock."""

    def stream(write, connection):
        for number in range(1000):
            write(part(jpeg(number % 250), time.monotonic() + 1000, **fields))
            time.sleep(period_s)

    return stream


@pytest.fixture
def cut():
    """A stream of four parts, garbage between them."""
    return [jpeg(10), jpeg(60, (320, 240)), b"x" * 5000, jpeg(110)]


@pytest.mark.parametrize("length", [True, False])
@pytest.mark.parametrize("piece", [1, 7, 1000, 10**6])
def test_parts_are_found_whatever_way_the_stream_is_cut(cut, length, piece):
    data = b"\r\ngarbage" + b"".join(part(content, 5.0, length) for content in cut) + b"--frame\r\n"
    reader = MultipartReader("frame")
    parts = [found for at in range(0, len(data), piece) for found in reader.feed(data[at : at + piece], at)]
    assert [found.content.removesuffix(b"\r\n") for found in parts] == cut
    assert {found.stamp_s for found in parts} == {5.0}
    if piece == 1:
        begins = [data.index(content) - 1 for content in cut]
        assert [found.began_s for found in parts] == begins


def test_wrong_lengths_endless_headers_and_noise_cost_no_more_than_the_pictures_they_touch():
    rng = np.random.default_rng(3)
    good, reader = jpeg(200), MultipartReader("frame", largest_bytes=100_000)
    for rude in (
        part(b"y" * 500).replace(b"500", b"900"),
        part(b"y" * 500).replace(b"500", b"9" * 4000),
        part(b"y" * 500).replace(b"500", b"-3"),
        b"--frame\r\n" + b"X-Long: 1\r\n" * 3000,
        b"--frame" * 4000,
        rng.bytes(300_000),
        b"--frame\r\n\r\n" + rng.bytes(300_000),
        b"--frame\r\nX-Timestamp: nan\r\nContent-Length\r\n:\r\n\r\n" + good + b"\r\n",
    ):
        pictures = b"".join(part(good) for _ in range(6))
        data = rude + pictures
        parts = [found for at in range(0, len(data), 1000) for found in reader.feed(data[at : at + 1000], 0.0)]
        assert [found.content for found in parts].count(good) >= 4
        assert len(reader._rest) < 200_000


@pytest.mark.parametrize("length", [True, False])
def test_pictures_come_newest_first_with_the_time_they_were_taken(length):
    with MjpegServer(steady(length=length)) as server:
        camera = open_camera(server.address)
        assert camera.is_live
        assert camera.size == (64, 48)
        number = -1
        for _ in range(10):
            frame = camera.next_frame(number)
            assert frame.number > number
            assert 0 <= time.monotonic() - frame.captured_s < 0.2
            number = frame.number
        time.sleep(0.3)
        late = camera.next_frame(number)
        assert late.number > number + 5
        assert late.image.dtype == np.uint8
        assert late.image.mean() == pytest.approx(late.number, abs=3)
        assert time.monotonic() - late.captured_s < 0.2
        camera.close()
        camera.close()
        with pytest.raises(CameraLostError, match="closed"):
            camera.next_frame()


def test_a_picture_that_was_delayed_looks_as_old_as_it_is_also_after_the_clock_was_set():
    def stream(write, connection):
        for number in range(30 if connection == 1 else 0):
            ahead_s, delay_s = (0.0, 0.0) if number < 10 else (-500.0, 0.0 if number < 20 else 0.25)
            stamp_s = time.monotonic() + ahead_s
            time.sleep(delay_s if number == 20 else 0.02)
            write(part(jpeg(number), stamp_s if number <= 20 else stamp_s - delay_s))

    with MjpegServer(stream) as server:
        camera = open_camera(server.address)
        number, ages = -1, {}
        while 29 not in ages:
            frame = camera.next_frame(number)
            number = frame.number
            ages[round(frame.image.mean())] = time.monotonic() - frame.captured_s
        camera.close()
    assert max(age for shown, age in ages.items() if shown < 20) < 0.1
    assert min(age for shown, age in ages.items() if shown >= 20) > 0.22


def test_without_stamps_a_picture_is_as_old_as_its_arrival():
    def stream(write, connection):
        for number in range(200):
            write(part(jpeg(number)))
            time.sleep(0.01)

    with MjpegServer(stream) as server:
        camera = open_camera(server.address)
        frame = camera.next_frame()
        assert 0 <= time.monotonic() - frame.captured_s < 0.1
        camera.close()


def test_damaged_pictures_are_passed_over():
    def stream(write, connection):
        for number in range(1000):
            whole = jpeg(number % 250)
            write(part(whole) if number % 3 == 0 else part(whole[: len(whole) // 2] if number % 3 == 1 else b"junk"))
            time.sleep(0.005)

    with MjpegServer(stream) as server:
        camera = open_camera(server.address)
        number = -1
        for _ in range(10):
            number = camera.next_frame(number).number
            assert number % 3 == 0
        camera.close()


def test_a_stream_that_ends_is_opened_anew_and_one_that_stays_away_is_lost():
    def stream(write, connection):
        for number in range(5):
            write(part(jpeg(number)))
            time.sleep(0.01)

    with MjpegServer(stream) as server:
        camera = MjpegStream(server.address, pause_s=0.02)
        number = -1
        for _ in range(12):
            number = camera.next_frame(number).number
        assert server.connections >= 3
    number = _drained(camera, number)
    with pytest.raises(CameraLostError, match=r"127.0.0.1.* has given no picture for 0\.\d s: cannot be reached"):
        camera.next_frame(number, timeout_s=0.3)
    with MjpegServer(stream, port=server.port):
        assert camera.next_frame(number, timeout_s=2.0).number > number
        camera.close()


def test_a_stream_that_falls_silent_is_lost_and_found_again():
    silent = threading.Event()

    def stream(write, connection):
        for number in range(1000):
            if silent.is_set() and connection == 1:
                time.sleep(1.0)
                return
            write(part(jpeg(number % 250)))
            time.sleep(0.01)

    with MjpegServer(stream) as server:
        camera = MjpegStream(server.address, patience_s=0.4, silence_s=0.4, pause_s=0.02)
        number = camera.next_frame().number
        silent.set()
        time.sleep(0.05)
        number = _drained(camera, number)
        with pytest.raises(CameraLostError, match="has given no picture for 0"):
            camera.next_frame(number, timeout_s=0.1)
        assert camera.next_frame(number, timeout_s=2.0).number > number
        assert server.connections == 2
        begin_s = time.monotonic()
        camera.close()
        assert time.monotonic() - begin_s < 0.3


def test_pictures_of_another_size_are_not_taken_for_the_same_camera_s():
    def stream(write, connection):
        for number in range(1000):
            write(part(jpeg(10, (64, 48) if number < 5 else (80, 60))))
            time.sleep(0.01)

    with MjpegServer(stream) as server:
        camera = open_camera(server.address)
        with pytest.raises(CameraLostError, match="80 x 60 now, and of 64 x 48"):
            _take(camera, count=50)
        camera.close()


@pytest.mark.parametrize(
    ("path", "content_type", "status", "message"),
    [
        ("/nowhere", "multipart/x-mixed-replace; boundary=frame", 200, "answers 404"),
        ("/camera", "text/html", 200, "is no MJPEG stream, but text/html"),
        ("/camera", "image/jpeg", 200, "is no MJPEG stream, but image/jpeg"),
        ("/camera", "multipart/x-mixed-replace", 200, "is no MJPEG stream"),
        ("/camera", "multipart/x-mixed-replace; boundary=frame", 401, "asks for user and password"),
        ("/camera", "multipart/x-mixed-replace; boundary=frame", 503, "answers 503"),
    ],
)
def test_what_is_no_stream_is_said_to_be_none(path, content_type, status, message):
    with MjpegServer(steady(), content_type, status) as server, pytest.raises(UserError, match=message):
        open_camera(f"http://user:secret@127.0.0.1:{server.port}{path}")


def test_a_stream_without_pictures_is_none():
    def words(write, connection):
        for _ in range(100):
            write(part(b"no picture"))
            time.sleep(0.01)

    with MjpegServer(words) as server, pytest.raises(UserError, match="no JPEG pictures"):
        MjpegStream(server.address)
    with (
        MjpegServer(lambda write, connection: time.sleep(0.5)) as server,
        pytest.raises(UserError, match="no picture for"),
    ):
        MjpegStream(server.address, patience_s=0.2)


def test_nobody_there_and_the_password_is_not_told():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        address = f"http://user:secret@127.0.0.1:{taken.getsockname()[1]}/camera"
        with pytest.raises(UserError, match=r"camera http://127.0.0.1.* cannot be reached") as refused:
            open_camera(address)
    assert "secret" not in str(refused.value)


def test_an_address_that_is_none():
    with pytest.raises(UserError, match="http://"):
        open_camera("http://")
    with pytest.raises(UserError, match=r"rtsp.*cannot be read"):
        open_camera("rtsp://127.0.0.1/stream")


def _take(camera, count):
    number = -1
    for _ in range(count):
        number = camera.next_frame(number).number


def _drained(camera, number):
    """The number of the last picture that came."""
    while True:
        try:
            number = camera.next_frame(number, timeout_s=0.05).number
        except CameraLostError:
            return number
