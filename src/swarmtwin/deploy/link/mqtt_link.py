"""A link over MQTT 3.1.1: motion at QoS 0, nothing retained, nothing kept for later."""

import functools
import logging
import ssl
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from paho.mqtt.client import Client, ConnectFlags, DisconnectFlags, MQTTErrorCode, MQTTMessage
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode

from swarmtwin.deploy.link.broker import Broker
from swarmtwin.deploy.link.echoes import Echoes, ForeignMessages
from swarmtwin.deploy.link.link import LinkLostError
from swarmtwin.deploy.link.message_format import MessageFormat
from swarmtwin.deploy.link.mqtt_client import make_client
from swarmtwin.errors import UserError
from swarmtwin.robot import Robot

logger = logging.getLogger(__name__)


class MqttLink:
    """A connection to the vehicles of one robot through a broker; it comes back by itself within a second.

    It reads its own messages on the topic of commands. That shows that the broker passes them on, how long they take,
    and whether anybody else commands the same vehicles.

    Attributes:
        robot: what it speaks to.
        broker: through which broker.
        message_format: how commands are written.
        longest_silence_s: where the broker has not passed on a message for so long, only commands at rest are sent on.
    """

    def __init__(
        self,
        client: Client,
        message_format: MessageFormat,
        broker: Broker,
        longest_silence_s: float,
        will_keepers: Sequence[Client] = (),
    ) -> None:
        self.robot = message_format.robot
        self.broker = broker
        self.message_format = message_format
        self.longest_silence_s = longest_silence_s
        self._client = client
        self._will_keepers = tuple(will_keepers)
        self._echoes = Echoes()
        self._announced: dict[str, float] = {}
        self._ready = threading.Event()
        self._answered = threading.Event()  # at the first connection: yes or no
        self._refusal: str | None = None
        self._lost_because = "it was never connected"
        self._closed = False
        self._interruptions = 0
        client.on_connect = _never_raise(self._on_connect)
        client.on_disconnect = _never_raise(self._on_disconnect)
        client.on_subscribe = _never_raise(self._on_subscribe)
        client.on_message = _never_raise(self._on_message)

    @property
    def is_connected(self) -> bool:
        """Whether what is sent now has a way to go."""
        return self._ready.is_set()

    @property
    def interruptions(self) -> int:
        """How often the connection was lost: whoever else was connected may have lost theirs, too."""
        return self._interruptions

    @property
    def announced(self) -> Mapping[str, float]:
        """Ids of vehicles that have said that they are there, and when on the monotonic clock."""
        return MappingProxyType(self._announced)

    @property
    def foreign_messages(self) -> ForeignMessages:
        """What others have sent to the vehicles."""
        return self._echoes.foreign

    @property
    def round_trip_s(self) -> float:
        """Median time of the last messages to the broker and back, about that to a vehicle; NaN before the first."""
        return self._echoes.round_trip_s

    @property
    def unanswered_s(self) -> float:
        """For how long the broker has owed the oldest message sent; 0: it has passed on everything."""
        return self._echoes.unanswered_s

    def send(self, commands: Mapping[str, np.ndarray]) -> float:
        """Send a command (m,), in the robot's units, to each vehicle named; never waits, nothing is kept for later.

        Returns:
            when it was handed to the network, on the monotonic clock.

        Raises:
            LinkLostError: it is not connected, or the broker has been silent for too long and a command is not at rest:
                what a frozen broker is sent, it passes on late.
            ValueError: a command is not finite or beyond the robot's limits: whoever sends bounds first.
        """
        messages = self.message_format.messages(commands)
        if not self.is_connected:
            raise LinkLostError(f"no connection to the broker {self.broker.address}: {self._lost_because}")
        silence_s = self.unanswered_s
        if silence_s > self.longest_silence_s and not _all_at_rest(commands, self.robot.command_at_rest):
            raise LinkLostError(
                f"the broker {self.broker.address} has not passed on a command for {silence_s:.1f} s: it is frozen, "
                f"or does not let {self.broker.user or 'this client'} publish on the topic of commands"
            )
        sent_s = time.monotonic()
        for topic, payload in messages.items():
            sent_s = self._echoes.sent(topic, payload)
            code = self._client.publish(topic, payload, qos=0, retain=False).rc
            if code != MQTTErrorCode.MQTT_ERR_SUCCESS:
                self._echoes.not_sent(topic, payload)
                raise LinkLostError(f"no connection to the broker {self.broker.address}: {code.name}")
        return sent_s

    def close(self) -> None:
        """Disconnect; twice does no harm. It does not stop the vehicles: send zeros before."""
        if self._closed:
            return
        self._closed = True
        for client in (self._client, *self._will_keepers):
            client.disconnect()
        for client in (self._client, *self._will_keepers):
            client.loop_stop()
        self._ready.clear()
        self._lost_because = "it was closed"

    def _open(self) -> None:
        broker = self.broker
        for client in (self._client, *self._will_keepers):
            try:
                client.connect(broker.host, broker.port, keepalive=broker.keepalive_s)
            except OSError as error:
                self.close()
                raise UserError(_why_unreachable(broker, error)) from None
            client.loop_start()
        self._answered.wait(5.0)
        if not self._ready.is_set():
            self.close()
            reason = self._refusal or f"it does not answer as a broker does ({self._lost_because})"
            raise UserError(f"broker {broker.address}: {reason}")

    def _topics(self) -> list[tuple[str, int]]:
        topics = [self.message_format.topic_filter, self.message_format.announce_topic]
        return [(topic, 0) for topic in topics if topic]

    def _on_connect(self, client: Client, _: Any, flags: ConnectFlags, code: ReasonCode, __: Properties | None) -> None:
        if code.is_failure:
            self._refuse(_why_refused(self.broker, str(code)))
            return
        self._echoes.forget()
        client.subscribe(self._topics())

    def _on_subscribe(self, _: Client, __: Any, ___: int, codes: list[ReasonCode], ____: Properties | None) -> None:
        for code, (topic, _qos) in zip(codes, self._topics(), strict=False):
            if code.is_failure:
                self._refuse(f"{self.broker.user or 'this client'} may not read {topic}: allow it in its access list")
                return
        self._refusal = None
        self._ready.set()
        self._answered.set()

    def _on_disconnect(
        self, _: Client, __: Any, ___: DisconnectFlags, code: ReasonCode, ____: Properties | None
    ) -> None:
        was_connected = self._ready.is_set()
        self._ready.clear()
        self._echoes.forget()
        self._lost_because = self._refusal or str(code)
        self._answered.set()
        if was_connected and not self._closed:
            self._interruptions += 1
            logger.warning("connection to the broker %s lost (%s); trying again", self.broker.address, code)

    def _on_message(self, _: Client, __: Any, message: MQTTMessage) -> None:
        topic, payload = message.topic, bytes(message.payload)
        if topic == self.message_format.announce_topic:
            self._note_vehicle(payload)
        elif message.retain or not self._echoes.came_back(topic, payload):
            self._echoes.is_foreign(payload, self._moves(topic, payload), message.retain)

    def _moves(self, topic: str, payload: bytes) -> bool:
        try:
            commands = self.message_format.commands(topic, payload)
        except (ValueError, RecursionError):
            return True
        return not _all_at_rest(commands, self.robot.command_at_rest)

    def _note_vehicle(self, payload: bytes, longest: int = 32, most: int = 1000) -> None:
        vehicle = payload.decode(errors="replace").strip().strip('"')
        if vehicle.isprintable() and 0 < len(vehicle) <= longest and len(self._announced) < most:
            self._announced = {**self._announced, vehicle: time.monotonic()}

    def _refuse(self, reason: str) -> None:
        if self._answered.is_set() and reason != self._refusal:
            logger.warning("broker %s: %s", self.broker.address, reason)
        self._refusal = self._lost_because = reason
        self._ready.clear()
        self._answered.set()


def connect(
    robot: Robot, broker: Broker, name: str, vehicles: Sequence[str] = (), longest_silence_s: float = 0.4
) -> MqttLink:
    """Connect to a broker and wait until it is ready.

    Args:
        robot: whose vehicles are to be spoken to.
        broker: through which broker.
        name: of this client, seen in the broker's log; a random part makes it the only one.
        vehicles: whom the broker tells to stand still when this process dies or freezes: the third line of defence.
            Where each vehicle has a topic of its own, each takes a connection more: a connection has one last will.
        longest_silence_s: see `MqttLink`.

    Raises:
        UserError: the broker cannot be reached, refuses the user, or shows a certificate that is not trusted.
    """
    message_format = MessageFormat(robot)
    client = make_client(broker, name)
    wills = message_format.messages(dict.fromkeys(vehicles, robot.command_at_rest))
    keepers = [make_client(broker, name) for _ in range(len(wills) - 1)]
    for one, (topic, payload) in zip((client, *keepers), wills.items(), strict=False):
        one.will_set(topic, payload, qos=0, retain=False)
    link = MqttLink(client, message_format, broker, longest_silence_s, keepers)
    link._open()
    return link


def _all_at_rest(commands: Mapping[str, np.ndarray], at_rest: np.ndarray) -> bool:
    return all(np.allclose(command, at_rest, rtol=0, atol=1e-9) for command in commands.values())


def _never_raise(callback: Callable[..., None]) -> Callable[..., None]:
    """Keep a defect in a callback from ending the thread that paho calls it from."""

    @functools.wraps(callback)
    def guarded(*arguments: Any) -> None:
        try:
            callback(*arguments)
        except Exception:
            logger.exception("an MQTT callback failed")

    return guarded


def _why_unreachable(broker: Broker, error: OSError) -> str:
    if isinstance(error, ssl.SSLCertVerificationError):
        return (
            f"the certificate of the broker {broker.address} is not trusted ({error.verify_message}): if the broker is "
            "yours, name the certificate that signed it, or the broker's own: broker.ca_file=FILE"
        )
    if isinstance(error, ssl.SSLError):
        return f"the broker {broker.address} does not speak TLS there ({error.reason}): correct the port, or mqtt://"
    reason = error.strerror or str(error) or type(error).__name__
    return f"no broker at {broker.address} ({reason}): start one (`mosquitto`), or correct broker="


def _why_refused(broker: Broker, reason: str) -> str:
    if reason in ("Bad user name or password", "Not authorized"):
        who = f"user {broker.user!r} with this password" if broker.user else "a client without a user"
        return f"it does not let in {who}: correct broker=mqtt://USER@..., broker.password_file=FILE"
    return f"it refuses the connection: {reason}"
