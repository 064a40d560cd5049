"""An MQTT client as all our processes use it."""

import secrets
import socket
import ssl
from typing import Any

from paho.mqtt.client import Client, MQTTv311
from paho.mqtt.enums import CallbackAPIVersion

from swarmtwin.deploy.link.broker import Broker
from swarmtwin.errors import UserError


def make_client(broker: Broker, name: str) -> Client:
    """Return a client that may connect to a broker: MQTT 3.1.1, a session of its own, what it writes goes out at once.

    Args:
        broker: which.
        name: of this client, seen in the broker's log; a random part makes it the only one.

    Raises:
        UserError: the broker's ca_file holds no certificate.
    """
    client_id = f"{name[:16]}-{secrets.token_hex(3)}"  # 23 characters, which every broker takes
    client = Client(CallbackAPIVersion.VERSION2, client_id, protocol=MQTTv311)
    client.connect_timeout = 2.0
    client.reconnect_delay_set(min_delay=0.1, max_delay=1)  # type: ignore[arg-type]
    client.on_socket_open = _send_at_once
    if broker.user is not None:
        client.username_pw_set(broker.user, broker.password.get_secret_value() if broker.password else None)
    if broker.tls:
        client.tls_set_context(_tls_context(broker))
    return client


def _send_at_once(_: Client, __: Any, opened: Any) -> None:
    opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


def _tls_context(broker: Broker) -> ssl.SSLContext:
    try:
        return ssl.create_default_context(cafile=None if broker.ca_file is None else str(broker.ca_file))
    except (ssl.SSLError, OSError) as error:
        raise UserError(f"broker.ca_file {broker.ca_file} holds no certificate (PEM): {error}") from None
