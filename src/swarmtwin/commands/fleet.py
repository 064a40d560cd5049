"""`swarmtwin fleet`: emulated robots on a real broker, under an emulated camera, until Ctrl-C."""

import time
from typing import Annotated, Any

from pydantic import BeforeValidator, Field
from rich.console import Console
from rich.live import Live
from rich.text import Text

from swarmtwin.deploy.fleet.fleet import Fleet, FleetSettings
from swarmtwin.deploy.link.broker import BrokerOptions
from swarmtwin.deploy.link.embedded_broker import broker_at
from swarmtwin.robot import Positive, Robot
from swarmtwin.transitions.inputs import as_texts


def as_ids(value: Any) -> Any:
    """Turn a number of vehicles into their ids: 3 → ("1", "2", "3"); ids stay what they are."""
    if isinstance(value, int) and not isinstance(value, bool):
        return tuple(str(number + 1) for number in range(value))
    return as_texts(value)


class Options(FleetSettings):
    """Options of `swarmtwin fleet`; their defaults stand in conf/fleet.yaml."""

    robot: Robot
    vehicles: Annotated[tuple[str, ...], BeforeValidator(as_ids), Field(min_length=1)]
    broker: BrokerOptions
    camera_port: Annotated[int, Field(ge=0, le=65535)]
    duration_s: Positive | None


def run(options: Options) -> dict[str, Any]:
    """Switch the fleet on, show where it is and how it is, and switch it off at the end.

    Raises:
        UserError: the robot cannot be emulated, there is no broker, or an option makes no sense.
    """
    console = Console()
    settings = FleetSettings(**{name: getattr(options, name) for name in FleetSettings.model_fields})
    with (
        broker_at(options.broker.address, options.broker.password_file, options.broker.ca_file) as broker,
        Fleet(options.robot, options.vehicles, broker, options.camera_port, settings) as fleet,
    ):
        for line in (
            f"{len(fleet.vehicles)} × {options.robot.title}: {', '.join(fleet.vehicles)}",
            f"broker    {broker.address}{_about_broker(options.broker.address)}",
            f"camera    {fleet.camera_url}   to look at: {fleet.camera_url.removesuffix('camera')}",
            f"firmware  {_about_firmware(fleet)}",
        ):
            console.print(line, highlight=False, soft_wrap=True)
        try:
            _watch(fleet, console, options.duration_s)
        except KeyboardInterrupt:
            raise KeyboardInterrupt("the emulated robots are switched off") from None
    return {"vehicles": len(fleet.vehicles), "camera": fleet.camera_url, "broker": broker.address}


def _about_broker(asked: str) -> str:
    if asked.partition("://")[0] != "embedded":
        return ""
    return "   (embedded, for a first try: it lets anybody in; for robots that matter, mosquitto)"


def _about_firmware(fleet: Fleet) -> str:
    timeout_s = fleet.firmware_timeout_s
    if timeout_s is None:
        return "as published: a vehicle drives on when commands stop"
    return f"a vehicle stops by itself {timeout_s:g} s after its last command"


def _watch(fleet: Fleet, console: Console, duration_s: float | None) -> None:
    """Show one line of how the fleet is, until the end."""
    began_s = time.monotonic()
    with Live(console=console, refresh_per_second=2, transient=True) as live:
        while duration_s is None or time.monotonic() - began_s < duration_s:
            live.update(Text(fleet.status()))
            time.sleep(min(0.5, duration_s or 0.5))
