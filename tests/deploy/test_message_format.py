"""Commands become the messages that firmware reads, and come back as what was sent."""

import json

import numpy as np
import pytest

from swarmtwin.deploy.link.message_format import MessageFormat
from swarmtwin.errors import UserError

SERVO = {
    "command_topic": "boats/{vehicle}/servo",
    "fields": {
        "left": {"key": "p1", "factor": -2.5, "offset": 1500, "decimals": 0},
        "right": {"key": "p2", "factor": 0.001, "offset": 0.5, "decimals": 4},
    },
}


def with_link(robot, link):
    return type(robot).parse({**robot.model_dump(), "link": link}, "test")


@pytest.fixture
def formats(robots):
    """The shipped robots' formats, and that of a robot of one's own: reversed, shifted, a topic a vehicle."""
    return {name: MessageFormat(robot) for name, robot in robots.items() if robot.link} | {
        "own": MessageFormat(with_link(robots["mgr"], SERVO))
    }


@pytest.mark.parametrize("name", ["mgr", "mur", "create", "own"])
def test_a_message_read_back_is_the_command_as_sent(formats, name):
    one = formats[name]
    low, high = one.robot.command_low, one.robot.command_high
    rng = np.random.default_rng(1)
    coarsest = [1 / abs(f.factor) / 10**f.decimals for f in one.robot.link.fields.values()]
    drawn = [low, high, one.robot.command_at_rest, *rng.uniform(low, high, (200, len(low)))]
    for command in drawn:
        commands = {"1": command, "7": one.robot.command_at_rest}
        back = {}
        for topic, payload in one.messages(commands).items():
            back |= one.commands(topic, payload)
        assert back.keys() == commands.keys()
        np.testing.assert_allclose(back["1"], one.as_sent(command), atol=1e-9)
        assert np.all((back["1"] >= low - 1e-9) & (back["1"] <= high + 1e-9))
        assert np.all(np.abs(back["1"] - command) <= np.array(coarsest) * 0.5001)
        np.testing.assert_allclose(back["7"], one.robot.command_at_rest, atol=1e-12)


def test_the_published_firmware_s_own_message(formats):
    [(topic, payload)] = formats["mgr"].messages({"1": np.array([-80, 95]), "2": np.array([0.4, -0.4])}).items()
    assert (topic, payload) == ("mkr/command", b'{"1":{"L":-80,"R":95},"2":{"L":0,"R":0}}')


def test_a_topic_of_its_own_holds_the_vehicle_s_object_alone(formats):
    messages = formats["create"].messages({"4": np.array([100.0, -0.6]), "5": np.array([0, 0])})
    assert list(messages) == ["create/4/command", "create/5/command"]
    assert json.loads(messages["create/4/command"]) == {"v": 0.1, "w": -0.6}
    assert formats["create"].topic_filter == "create/+/command"
    with pytest.raises(UserError, match=r"'a/b' cannot stand in a topic"):
        formats["create"].messages({"a/b": np.array([0, 0])})


def test_rounding_never_leads_beyond_the_limits(robots):
    tight = robots["mgr"].model_dump()
    tight["command"]["left"] |= {"low": -120.7, "high": 120.7}
    robot = with_link(type(robots["mgr"]).parse(tight, "test"), robots["mgr"].link.model_dump())
    np.testing.assert_array_equal(MessageFormat(robot).as_sent(np.array([120.7, 120])), [120, 120])
    np.testing.assert_array_equal(MessageFormat(robot).as_sent(np.array([-120.7, 120])), [-120, 120])


@pytest.mark.parametrize("command", [[np.nan, 0], [np.inf, 0], [120.1, 0], [0, -121], [0], [0, 0, 0]])
def test_what_no_vehicle_may_be_told_is_refused(formats, command):
    with pytest.raises(ValueError, match="vehicle '1'"):
        formats["mgr"].messages({"1": np.array(command, float)})


@pytest.mark.parametrize(
    "payload", [b"", b"\xff", b"{", b"[1]", b'{"1": 3}', b'{"1": {"L": 3}}', b'{"1":{"L":"3","R":1}}']
)
def test_what_is_no_message_is_a_value_error(formats, payload):
    with pytest.raises(ValueError, match=r"\w"):
        formats["mgr"].commands("mkr/command", payload)


def test_numbers_too_coarse_to_stand_still_are_refused(robots):
    link = {**SERVO, "fields": {**SERVO["fields"], "left": {"key": "p1", "offset": 1500.4}}}
    with pytest.raises(UserError, match=r"'mgr': link\.fields cannot say 'stand still' exactly"):
        MessageFormat(with_link(robots["mgr"], link))
    with pytest.raises(UserError, match="'mgr' cannot be spoken to"):
        MessageFormat(robots["mgr"].model_copy(update={"link": None}))
