"""A broker that comes with swarmtwin, for a first try where none is at hand: amqtt, in a process of its own.

Its limits: it lets anybody in and knows no encryption; it takes about three times as long as mosquitto; a client that
freezes it never declares dead, so that no last will is sent for it. Robots that matter deserve mosquitto.
"""

import asyncio
import contextlib
import logging
import socket
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Self
from urllib.parse import urlsplit

from swarmtwin.deploy.child_process import ChildProcess, say_mistake, say_ready, told_by_parent
from swarmtwin.deploy.link.broker import Broker
from swarmtwin.errors import UserError


class EmbeddedBroker:
    """The embedded broker, running.

    Attributes:
        broker: how to connect to it.
        process: which it runs in.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 1883) -> None:
        """Start it.

        Args:
            host: where it listens; 0.0.0.0: for robots on the network, too.
            port: 0 takes a free one.

        Raises:
            UserError: it cannot listen there.
        """
        self.process = ChildProcess(__name__, {"host": host, "port": port})
        port = self.process.wait_until_ready()["port"]
        self.broker = Broker(host="127.0.0.1" if host in ("0.0.0.0", "::") else host, port=port)

    def close(self) -> None:
        """Stop it."""
        self.process.end()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


@contextlib.contextmanager
def broker_at(address: str, password_file: Path | None = None, ca_file: Path | None = None) -> Iterator[Broker]:
    """Yield the broker at an address as a user gives it; `embedded` or `embedded://host:port` starts one for the while.

    Raises:
        UserError: see `Broker.at` and `EmbeddedBroker`.
    """
    if address.partition("://")[0] != "embedded":
        yield Broker.at(address, password_file, ca_file)
        return
    parts = urlsplit(address)
    try:
        port = 1883 if parts.port is None else parts.port
    except ValueError:
        raise UserError(f"broker={address}: the port is none: write embedded://127.0.0.1:1883") from None
    with EmbeddedBroker(parts.hostname or "127.0.0.1", port) as embedded:
        yield embedded.broker


def _listening_port(host: str, port: int) -> int:
    """Return the port to listen at, after a try.

    Raises:
        UserError: nobody can listen there.
    """
    with socket.socket() as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind((host, port))
        except OSError as error:
            raise UserError(
                f"the embedded broker cannot listen at {host}:{port} ({error.strerror}): if another broker runs there, "
                f"use it, broker=mqtt://{host}:{port}"
            ) from None
        return int(trial.getsockname()[1])


async def _serve(host: str, port: int) -> None:
    from amqtt.broker import Broker as Amqtt

    anonymous = "amqtt.plugins.authentication.AnonymousAuthPlugin"
    broker = Amqtt(
        {
            "listeners": {"default": {"type": "tcp", "bind": f"{host}:{port}"}},
            "plugins": {anonymous: {"allow_anonymous": True}},
        }
    )
    await broker.start()
    say_ready(port=port)
    await asyncio.Event().wait()


def main() -> None:
    """Serve until the parent ends."""
    told = told_by_parent()
    logging.basicConfig(level=logging.CRITICAL)
    try:
        port = _listening_port(told["host"], told["port"])
    except UserError as error:
        say_mistake(error)
        return
    asyncio.run(_serve(told["host"], port))


if __name__ == "__main__":
    main()
