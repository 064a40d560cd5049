"""Which broker, and how to be let in."""

import os
from pathlib import Path
from typing import Annotated, Any, Self
from urllib.parse import urlsplit

from pydantic import Field, SecretStr

from swarmtwin.errors import UserError
from swarmtwin.strict_model import StrictModel


class Broker(StrictModel):
    """An MQTT broker. Its password never stands in an address, a command line or what is kept of a configuration.

    Attributes:
        host: its name or address.
        port: usually 1883, with TLS 8883.
        tls: whether the connection is encrypted and the broker's certificate checked.
        user: who connects; None: anybody may.
        password: of that user.
        ca_file: certificate of the authority that signed the broker's, or the broker's own; None: those of the system.
        keepalive_s: the broker sends a last will after one and a half times that without a sign of life.
    """

    host: Annotated[str, Field(min_length=1)]
    port: Annotated[int, Field(ge=1, le=65535)] = 1883
    tls: bool = False
    user: str | None = None
    password: Annotated[SecretStr | None, Field(exclude=True)] = None
    ca_file: Path | None = None
    keepalive_s: Annotated[int, Field(ge=1, le=60)] = 2

    @property
    def address(self) -> str:
        """Where it is, in words that may be shown: never with a password."""
        user = f"{self.user}@" if self.user else ""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'mqtts' if self.tls else 'mqtt'}://{user}{host}:{self.port}"

    def told_to_child(self) -> dict[str, Any]:
        """Return all of it as JSON can hold it, password included: for a pipe to a process of our own alone."""
        password = None if self.password is None else self.password.get_secret_value()
        return {**self.model_dump(mode="json"), "password": password}

    @classmethod
    def at(
        cls,
        address: str,
        password_file: Path | None = None,
        ca_file: Path | None = None,
        password_variable: str = "SWARMTWIN_MQTT_PASSWORD",
    ) -> Self:
        """Return the broker at `mqtt://user@host:port`, or `mqtts://` where the connection is to be encrypted.

        Args:
            address: user and port may be left out.
            password_file: a file whose first line is the user's password; None: it stands in an environment variable.
            ca_file: as the attribute.
            password_variable: that environment variable.

        Raises:
            UserError: the address is none, or a file cannot be read.
        """
        parts = urlsplit(address)
        shown = parts._replace(netloc=parts.netloc.rpartition("@")[2]).geturl()
        try:
            port = parts.port
        except ValueError:
            port = 0
        if parts.scheme not in ("mqtt", "mqtts") or not parts.hostname or port == 0 or parts.path.strip("/"):
            raise UserError(f"broker={shown} is no address of a broker: mqtt://host:1883, mqtts://user@host:8883")
        if parts.password is not None:
            raise UserError(
                f"broker={shown}: no password in an address, which others see: put it into "
                f"a file and name that as broker.password_file=FILE, or into the variable {password_variable}"
            )
        tls = parts.scheme == "mqtts"
        if ca_file is not None and not ca_file.is_file():
            raise UserError(f"broker.ca_file {ca_file} is missing: name the certificate of the broker's authority")
        if ca_file is not None and not tls:
            raise UserError(f"broker={address} is not encrypted, broker.ca_file would not be used: write mqtts://")
        password = _password(password_file, password_variable) if parts.username else None
        return cls(
            host=parts.hostname,
            port=port or (8883 if tls else 1883),
            tls=tls,
            user=parts.username or None,
            password=password,
            ca_file=ca_file,
        )


class BrokerOptions(StrictModel):
    """A broker as a user names it to a command.

    Attributes:
        address: see `Broker.at`.
        password_file: likewise.
        ca_file: likewise.
    """

    address: str
    password_file: Path | None = None
    ca_file: Path | None = None


def _password(file: Path | None, variable: str) -> SecretStr | None:
    if file is None:
        found = os.environ.get(variable)
        return None if found is None else SecretStr(found)
    try:
        return SecretStr(file.read_text().partition("\n")[0].rstrip("\r"))
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"broker.password_file {file} cannot be read: {error}") from None
