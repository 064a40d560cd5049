"""The link on a real broker that is stopped, frozen, strict, encrypted, and shared with somebody else."""

import json
import logging
import os
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion
from real_broker import free_port, wait_until

from swarmtwin.configuration import config_folder
from swarmtwin.deploy.link.broker import Broker
from swarmtwin.deploy.link.embedded_broker import EmbeddedBroker, broker_at
from swarmtwin.deploy.link.link import LinkLostError
from swarmtwin.deploy.link.mqtt_link import MqttLink
from swarmtwin.errors import UserError

DRIVE = {"1": np.array([40.0, -7.0]), "2": np.array([0.0, 100.0])}
REST = {"1": np.zeros(2), "2": np.zeros(2)}


def _read(payload):
    try:
        return json.loads(payload)
    except ValueError:
        return payload


@pytest.fixture
def listener():
    """Connect a plain client that keeps the commands that come: (arrival on the monotonic clock, content)."""
    clients = []

    def call(port, topic="mkr/command"):
        heard, ready = [], []
        client = Client(CallbackAPIVersion.VERSION2, protocol=4)
        client.reconnect_delay_set(0.05, 0.1)
        client.on_connect = lambda client, *_: client.subscribe(topic, 1)
        client.on_subscribe = lambda *_: ready.append(True)
        client.on_message = lambda _, __, message: heard.append((time.monotonic(), _read(message.payload)))
        client.connect("127.0.0.1", port)
        client.loop_start()
        clients.append(client)
        assert wait_until(lambda: ready)
        return client, heard

    yield call
    for client in clients:
        client.disconnect()
        client.loop_stop()


def test_commands_arrive_and_the_way_is_measured(mosquitto, link_to, listener):
    _, heard = listener(mosquitto.port)
    link = link_to(mosquitto.broker)
    before_s = time.monotonic()
    sent_s = link.send(DRIVE)
    assert before_s <= sent_s <= time.monotonic()
    assert wait_until(lambda: heard and link.unanswered_s == 0)
    assert heard[0][1] == {"1": {"L": 40, "R": -7}, "2": {"L": 0, "R": 100}}
    assert 0 < link.round_trip_s < 0.5
    assert link.foreign_messages.count == 0
    for _ in range(20):
        link.send(DRIVE)
    assert wait_until(lambda: len(heard) == 21)
    assert link.foreign_messages.count == 0


def test_vehicles_that_announce_themselves_are_known(mosquitto, link_to, listener):
    client, _ = listener(mosquitto.port)
    link = link_to(mosquitto.broker)
    for said in (b"3", b'"4"', b"", b"\xff\x00", b"x" * 500, b" 5\n"):
        client.publish("mkr/setup", said)
    assert wait_until(lambda: "5" in link.announced)
    assert set(link.announced) == {"3", "4", "5"}
    assert time.monotonic() - link.announced["5"] < 5


def test_nothing_sent_before_a_broker_was_down_arrives_after_it(mosquitto, link_to, listener):
    """Down for two seconds while commands go on: what arrives was sent after that, or just before its end."""
    _, heard = listener(mosquitto.port)
    link = link_to(mosquitto.broker)
    sent_s, refused, end_s = [], 0, time.monotonic() + 4.2
    stopped = started = False
    while time.monotonic() < end_s:
        left_s = end_s - time.monotonic()
        if left_s < 3.9 and not stopped:
            mosquitto.stop()
            stopped = True
        if left_s < 1.9 and not started:
            began_s = time.monotonic()
            mosquitto.start()
            started = True
        try:
            sent_s.append(link.send({"1": np.array([len(sent_s) % 120, len(sent_s) // 120])}))
        except LinkLostError:
            refused += 1
        time.sleep(0.02)
    assert refused > 80
    arrived = [(at_s, sent_s[int(one["1"]["L"]) + 120 * int(one["1"]["R"])]) for at_s, one in heard]
    assert min(was_sent_s for at_s, was_sent_s in arrived if at_s > began_s) > began_s - 0.5
    assert sum(at_s > end_s - 1 for at_s, _ in arrived) > 10, "it did not come back within a second"
    assert link.is_connected
    assert link.foreign_messages.count == 0


def test_a_frozen_broker_is_noticed_before_it_can_pile_up_commands(mosquitto, link_to, listener):
    """It thaws, passes on what it was sent: at most one period's commands, and stand still as the last word."""
    _, heard = listener(mosquitto.port)
    link = link_to(mosquitto.broker)
    link.send(DRIVE)
    assert wait_until(lambda: heard)
    mosquitto.freeze()
    sent = 0
    while link.unanswered_s < 0.4:
        link.send(DRIVE)
        sent += 1
        time.sleep(0.1)
    assert 1 <= sent <= 5
    with pytest.raises(LinkLostError, match=r"has not passed on a command for 0\.[45] s: it is frozen"):
        link.send(DRIVE)
    link.send(REST)
    mosquitto.thaw()
    assert wait_until(lambda: len(heard) == sent + 2)
    assert heard[-1][1] == {"1": {"L": 0, "R": 0}, "2": {"L": 0, "R": 0}}
    assert wait_until(lambda: link.unanswered_s == 0)
    link.send(DRIVE)


def test_a_second_controller_is_noticed_even_where_it_says_the_same(mosquitto, link_to):
    link, other = link_to(mosquitto.broker), link_to(mosquitto.broker, name="other")
    link.send(REST)
    assert wait_until(lambda: other.foreign_messages.count == 1 and link.unanswered_s == 0)
    assert other.foreign_messages.moving == 0
    assert link.foreign_messages.count == 0
    link.send(DRIVE)
    other.send(DRIVE)
    assert wait_until(lambda: link.foreign_messages.moving == other.foreign_messages.moving == 1)
    assert json.loads(link.foreign_messages.last_payload)["1"] == {"L": 40, "R": -7}
    other.send(REST)
    assert wait_until(lambda: link.foreign_messages.count == 2)
    assert link.foreign_messages.moving == 1
    assert b"40" in link.foreign_messages.last_payload, "what moved is worth more than what stood still"


def test_a_message_that_the_broker_keeps_for_vehicles_is_reported(mosquitto, link_to, listener):
    client, _ = listener(mosquitto.port)
    client.publish("mkr/command", b'{"1": {"L": 50, "R": 50}}', qos=1, retain=True).wait_for_publish(2)
    link = link_to(mosquitto.broker)
    assert wait_until(lambda: link.foreign_messages.retained == 1)
    client.publish("mkr/command", b"not JSON")
    assert wait_until(lambda: link.foreign_messages.moving == 2)


def dying(robot, port):
    """A process that has sent a first command and waits for its end."""
    code = f"""
        import sys, time, numpy as np
        from pathlib import Path
        from swarmtwin.deploy.link.broker import Broker
        from swarmtwin.deploy.link.mqtt_link import connect
        from swarmtwin.robot import Robot
        robot = Robot.load(Path({str(config_folder())!r}) / "robot" / "{robot}.yaml")
        link = connect(robot, Broker(host="127.0.0.1", port={port}), "dying", ["1", "2"])
        link.send({{"1": robot.command_high}})
        sys.stdin.read()
        link.close()
    """
    return subprocess.Popen([sys.executable, "-c", textwrap.dedent(code)], stdin=subprocess.PIPE)


@pytest.mark.parametrize("sign", ["SIGKILL", "clean"])
def test_the_last_will_tells_all_to_stand_still_unless_the_end_was_clean(mosquitto, link_to, listener, sign):
    _, heard = listener(mosquitto.port)
    process = dying("mgr", mosquitto.port)
    assert wait_until(lambda: heard, 20)
    if sign == "clean":
        process.communicate(timeout=10)
        time.sleep(0.2)
        assert len(heard) == 1
        return
    os.kill(process.pid, signal.SIGKILL)
    killed_s = time.monotonic()
    process.communicate()
    assert wait_until(lambda: len(heard) == 2)
    assert heard[1][1] == {"1": {"L": 0, "R": 0}, "2": {"L": 0, "R": 0}}
    assert heard[1][0] - killed_s < 0.5


def test_the_last_will_reaches_vehicles_with_topics_of_their_own(mosquitto, link_to, listener):
    _, heard = listener(mosquitto.port, "create/+/command")
    process = dying("create", mosquitto.port)
    assert wait_until(lambda: heard, 20)
    process.kill()
    process.communicate()
    assert wait_until(lambda: len(heard) == 3)
    assert [said for _, said in heard[1:]] == [{"v": 0.0, "w": 0.0}] * 2


def test_a_broker_that_wants_a_password(start_mosquitto, link_to, tmp_path, monkeypatch):
    passwords = tmp_path / "passwords"
    subprocess.run(["mosquitto_passwd", "-b", "-c", passwords, "robots", "correct"], check=True)
    mosquitto = start_mosquitto("allow_anonymous false", f"password_file {passwords}")
    address = mosquitto.address.replace("//", "//robots@")
    (tmp_path / "password").write_text("correct\n")
    good = Broker.at(address, password_file=tmp_path / "password")
    link = link_to(good)
    link.send(DRIVE)
    assert "correct" not in repr(good) + good.model_dump_json() + good.address
    monkeypatch.setenv("SWARMTWIN_MQTT_PASSWORD", "correct")
    assert link_to(Broker.at(address)).is_connected
    monkeypatch.setenv("SWARMTWIN_MQTT_PASSWORD", "wrong")
    with pytest.raises(UserError, match="does not let in user 'robots' with this password: correct broker=") as error:
        link_to(Broker.at(address))
    assert "wrong" not in str(error.value)
    with pytest.raises(UserError, match="does not let in a client without a user"):
        link_to(mosquitto.broker)


def test_a_broker_that_lets_nobody_command_is_noticed(start_mosquitto, link_to, tmp_path):
    (tmp_path / "list").write_text("topic read mkr/#\n")
    link = link_to(start_mosquitto(f"acl_file {tmp_path / 'list'}").broker)
    link.send(DRIVE)
    time.sleep(0.5)
    with pytest.raises(LinkLostError, match="does not let this client publish"):
        link.send(DRIVE)


@pytest.fixture
def certificates(tmp_path):
    """A certificate of one's own authority for `localhost`, made by openssl."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed")
    key, certificate = tmp_path / "broker.key", tmp_path / "broker.pem"
    subject = ["-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost"]
    command = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", *subject]
    subprocess.run([*command, "-keyout", key, "-out", certificate], check=True, capture_output=True)
    return key, certificate


def test_an_encrypted_broker(start_mosquitto, link_to, certificates):
    key, certificate = certificates
    mosquitto = start_mosquitto(f"certfile {certificate}", f"keyfile {key}")
    address = f"mqtts://localhost:{mosquitto.port}"
    link = link_to(Broker.at(address, ca_file=certificate))
    link.send(DRIVE)
    assert wait_until(lambda: link.round_trip_s > 0)
    with pytest.raises(UserError, match=r"certificate of the broker .* is not trusted \(self.signed.*ca_file=FILE"):
        link_to(Broker.at(address))
    with pytest.raises(UserError, match=r"is not trusted \(.*mismatch.*127.0.0.1"):
        link_to(Broker.at(f"mqtts://127.0.0.1:{mosquitto.port}", ca_file=certificate))
    with pytest.raises(UserError, match="holds no certificate"):
        link_to(Broker.at(address, ca_file=key))
    with pytest.raises(UserError, match=r"no broker at|does not answer as a broker does"):
        link_to(Broker.at(f"mqtt://localhost:{mosquitto.port}"))


def test_what_is_no_broker_is_said(mosquitto, link_to):
    with pytest.raises(UserError, match=r"no broker at mqtt://127.0.0.1:\d+ \(Connection refused\): start one"):
        link_to(Broker(host="127.0.0.1", port=free_port()))
    with pytest.raises(UserError, match=r"does not speak TLS there|no broker at mqtts"):
        link_to(Broker.at(f"mqtts://127.0.0.1:{mosquitto.port}"))
    with pytest.raises(UserError, match=r"no broker at mqtt://no\.such\.host\.invalid:1883"):
        link_to(Broker.at("mqtt://no.such.host.invalid"))


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("127.0.0.1:1883", "is no address of a broker: mqtt://host:1883"),
        ("http://host", "is no address of a broker"),
        ("mqtt://host:99999", "is no address of a broker"),
        ("mqtt://host/topic", "is no address of a broker"),
        ("mqtt://me:secret@host", "no password in an address"),
        ("embedded://host:x", "write embedded://127.0.0.1:1883"),
    ],
)
def test_an_address_that_is_none(address, message):
    with pytest.raises(UserError, match=message) as error, broker_at(address):
        pass
    assert "secret" not in str(error.value)


def test_addresses():
    assert Broker.at("mqtts://me@lab.local").address == "mqtts://me@lab.local:8883"
    assert Broker.at("mqtt://[::1]").address == "mqtt://[::1]:1883"
    with pytest.raises(UserError, match="write mqtts://"):
        Broker.at("mqtt://host", ca_file=Path(__file__))


def test_a_defect_in_a_callback_does_not_end_the_connection(mosquitto, link_to, listener, monkeypatch, caplog):
    client, _ = listener(mosquitto.port)

    def fail(*_):
        raise RuntimeError("planted")

    monkeypatch.setattr(MqttLink, "_note_vehicle", fail)
    link = link_to(mosquitto.broker)
    with caplog.at_level(logging.ERROR):
        client.publish("mkr/setup", b"1")
        assert wait_until(lambda: "planted" in caplog.text)
    link.send(DRIVE)
    assert wait_until(lambda: link.round_trip_s > 0)


def test_a_closed_link_sends_nothing(mosquitto, link_to):
    link = link_to(mosquitto.broker)
    link.close()
    link.close()
    with pytest.raises(LinkLostError, match="it was closed"):
        link.send(REST)


def test_the_embedded_broker_carries_commands_and_says_where_it_cannot_listen(link_to):
    with EmbeddedBroker(port=0) as embedded:
        link = link_to(embedded.broker)
        link.send(DRIVE)
        assert wait_until(lambda: link.round_trip_s > 0)
        with pytest.raises(UserError, match=r"cannot listen at 127.0.0.1:\d+ .*broker=mqtt://127.0.0.1"):
            EmbeddedBroker(port=embedded.broker.port)
    assert wait_until(lambda: not link.is_connected)
    assert not embedded.process.is_running
