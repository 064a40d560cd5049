"""The MJPEG reader on the emulated fleet's camera, a server in another process: delayed, set, frozen and killed."""

import os
import signal
import time

import numpy as np
import pytest

from swarmtwin.deploy.camera.camera import CameraLostError
from swarmtwin.deploy.camera.opening import open_camera
from swarmtwin.deploy.fleet.fleet import Fleet
from swarmtwin.deploy.fleet.orders import CameraFaults


def ages_s(camera, count=20):
    """Ages of the newest pictures when they are handed out; a second's worth of them is let pass first."""
    number, ages = camera.next_frame(timeout_s=5.0).number, []
    end_s = time.monotonic() + 1.0
    while len(ages) < count or time.monotonic() < end_s:
        frame = camera.next_frame(number, timeout_s=5.0)
        ages.append(time.monotonic() - frame.captured_s)
        number = frame.number
    return np.array(ages[-count:])


def test_the_fleet_s_pictures_come_with_their_age_through_delay_clock_steps_and_freezes(mosquitto, robots):
    with Fleet(robots["mgr"], ("1",), mosquitto.broker, camera_port=0) as fleet:
        camera = open_camera(fleet.camera_url)
        assert camera.next_frame().image.shape == camera.size[::-1]
        assert np.median(ages_s(camera)) < 0.06
        fleet.set_faults(camera=CameraFaults(delay_s=0.4))
        assert 0.38 < np.median(ages_s(camera)) < 0.5
        fleet.set_faults(camera=CameraFaults(clock_s=-3600.0))
        assert np.median(ages_s(camera)) < 0.06
        os.kill(fleet.camera.pid, signal.SIGSTOP)
        number = camera.next_frame(timeout_s=1.0).number
        with pytest.raises(CameraLostError, match="has given no picture for"):
            camera.next_frame(number, timeout_s=0.3)
        os.kill(fleet.camera.pid, signal.SIGCONT)
        assert camera.next_frame(number, timeout_s=3.0).number > number
        os.kill(fleet.camera.pid, signal.SIGKILL)
        time.sleep(0.2)
        number = camera.next_frame(timeout_s=1.0).number
        with pytest.raises(CameraLostError, match="cannot be reached"):
            camera.next_frame(number, timeout_s=0.5)
        fleet.restart_camera()
        assert np.median(ages_s(camera)) < 0.06
        camera.close()
