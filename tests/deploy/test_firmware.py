"""The emulated firmware does what the published one does, with the patch and without."""

import numpy as np
import pytest

from swarmtwin.deploy.link.message_format import MessageFormat
from swarmtwin.standin.firmware import Firmware


def test_it_reads_its_own_numbers_from_the_group_s_message_and_holds_them_for_ever(robots):
    firmware = Firmware(robots["mgr"], "2")
    assert firmware.topic == "mkr/command"
    assert firmware.announcement == ("mkr/setup", b"2")
    np.testing.assert_array_equal(firmware.command(0.0), [0, 0])
    assert firmware.receive(b'{"1": {"L": 9, "R": 9}, "2": {"L": -80, "R": 95}}', 1.0)
    np.testing.assert_array_equal(firmware.command(1.0), [-80, 95])
    np.testing.assert_array_equal(firmware.command(1e6), [-80, 95])
    assert not firmware.receive(b'{"1": {"L": 0, "R": 0}}', 2.0), "the message was for another vehicle"
    np.testing.assert_array_equal(firmware.command(3.0), [-80, 95])


def test_patched_with_a_time_out_it_stops_by_itself_until_the_next_command(robots):
    firmware = Firmware(robots["mgr"], "2", timeout_s=0.5)
    firmware.receive(b'{"2": {"L": 50, "R": 60}}', 1.0)
    np.testing.assert_array_equal(firmware.command(1.5), [50, 60])
    firmware.receive(b'{"3": {"L": 50, "R": 60}}', 1.5)
    firmware.receive(b'{"2": {"L": 50}}', 1.5)
    np.testing.assert_array_equal(firmware.command(1.51), [0, 0])
    firmware.receive(b'{"2": {"L": 20, "R": 10}}', 9.0)
    np.testing.assert_array_equal(firmware.command(9.0), [20, 10])


@pytest.mark.parametrize(
    "payload",
    [
        *(b"", b"\xff\xfe", b"{", b"[]", b"7", b"null", b"[" * 100_000),
        *(b'{"2": 5}', b'{"2": {"L": 1}}', b'{"2": {"L": "1", "R": 2}}', b'{"2": {"L": true, "R": 2}}'),
        *(b'{"2": {"L": NaN, "R": 2}}', b'{"2": {"L": 1e999, "R": 2}}', b'{"2": {"L": null, "R": 2}}'),
    ],
    ids=lambda payload: payload[:30].decode(errors="replace"),
)
def test_nonsense_is_ignored_and_what_held_goes_on(robots, payload):
    firmware = Firmware(robots["mgr"], "2")
    firmware.receive(b'{"2": {"L": 50, "R": 60}}', 1.0)
    assert not firmware.receive(payload, 2.0)
    np.testing.assert_array_equal(firmware.command(2.0), [50, 60])


def test_a_pwm_is_whole_and_has_eight_bits(robots):
    firmware = Firmware(robots["mgr"], "2")
    firmware.receive(b'{"2": {"L": 300, "R": -99999}}', 1.0)
    np.testing.assert_array_equal(firmware.command(1.0), [255, -255])
    firmware.receive(b'{"2": {"L": 80.9, "R": -80.9}}', 1.0)
    np.testing.assert_array_equal(firmware.command(1.0), [80, -80])


@pytest.mark.parametrize("name", ["mgr", "mur", "create"])
def test_it_understands_what_the_host_writes(robots, name):
    robot = robots[name]
    one = MessageFormat(robot)
    firmware = Firmware(robot, "12")
    rng = np.random.default_rng(2)
    drawn = [
        robot.command_low,
        robot.command_high,
        *rng.uniform(robot.command_low, robot.command_high, (50, len(robot.command))),
    ]
    for command in drawn:
        messages = one.messages({"1": robot.command_at_rest, "12": command})
        assert firmware.receive(messages[firmware.topic], 0.0)
        np.testing.assert_allclose(firmware.command(0.0), one.as_sent(command), atol=1e-9)


def test_what_lies_beyond_the_limits_of_a_servo_ends_there(robots):
    firmware = Firmware(robots["mur"], "1")
    firmware.receive(b'{"1": {"angle": 170, "amplitude": -5, "frequency": 0}}', 0.0)
    np.testing.assert_array_equal(firmware.command(0.0), [79, 0, 3])
