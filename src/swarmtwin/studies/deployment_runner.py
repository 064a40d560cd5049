"""A policy or a planned drive on real vehicles: what is opened for it, and what comes of it."""

import importlib.metadata
import logging
import platform
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from swarmtwin import __version__
from swarmtwin.deploy.camera.camera import Camera
from swarmtwin.deploy.camera.opening import open_camera
from swarmtwin.deploy.control.deployment import Deployment
from swarmtwin.deploy.control.deployment_recording import write_about, write_deployment
from swarmtwin.deploy.control.observer import Tracks
from swarmtwin.deploy.control.outcome import Outcome
from swarmtwin.deploy.control.plan import Plan
from swarmtwin.deploy.control.settings import SafetySettings, TimingSettings
from swarmtwin.deploy.control.timing import median_and_p99
from swarmtwin.deploy.link.broker import Broker, BrokerOptions
from swarmtwin.deploy.link.link import Link
from swarmtwin.deploy.link.mqtt_link import connect
from swarmtwin.deploy.live_view.view_process import LiveView, Scene
from swarmtwin.deploy.tracking.calibration import Calibration
from swarmtwin.deploy.tracking.calibration_fit import MeasuredByHand, loaded_or_fitted
from swarmtwin.deploy.tracking.calibration_pictures import take_pictures
from swarmtwin.deploy.tracking.tracker import Tracker
from swarmtwin.errors import UserError
from swarmtwin.files import CHECKPOINTS
from swarmtwin.markers import marker_of
from swarmtwin.recordings.recording import Header
from swarmtwin.robot import Arena, Positive, Robot, Seed, StrictModel
from swarmtwin.world.rendering.canvas import COLOURS

log = logging.getLogger(__name__)


class PageOptions(StrictModel):
    """The live view: whether it is served, and where."""

    show: bool
    host: str
    port: int


class DrivingOptions(StrictModel):
    """Options of every command that drives real vehicles.

    Attributes:
        robot: what is driven.
        broker: through which commands travel.
        camera: a number, or the address of an MJPEG stream.
        calibration: the file that `calibrate` made; None: the arena's markers calibrate.
        camera_height_mm: of the lens above the floor, measured by hand; None: nobody has.
        camera_above_mm: the point of the floor below the lens, likewise.
        safety: limits and margins.
        timing: when the controller acts.
        page: the live view.
        seed: of all chance.
        recover: the output of a deployment that was killed, whose recording is to be finished instead of driving.
        output: folder of the recording; None: the next number.
        overwrite: whether a folder that swarmtwin made is replaced.
    """

    robot: Robot
    broker: BrokerOptions
    camera: str
    calibration: Path | None
    camera_height_mm: Positive | None
    camera_above_mm: tuple[float, float] | None
    safety: SafetySettings
    timing: TimingSettings
    page: PageOptions
    seed: Seed
    recover: Path | None
    output: Path | None
    overwrite: bool

    @property
    def by_hand(self) -> MeasuredByHand:
        """Where the camera hangs, as far as somebody has measured it."""
        return MeasuredByHand(self.camera_height_mm, self.camera_above_mm)


class Eyes(NamedTuple):
    """A camera, what finds vehicles on its pictures, and where the arena's corners are on them (4, 2), if known."""

    camera: Camera
    tracker: Tracks
    corners_px: np.ndarray | None
    about: Mapping[str, Any]


def open_link(robot: Robot, broker: BrokerOptions, vehicles: Sequence[str], name: str) -> tuple[Link, dict[str, Any]]:
    """Connect to the vehicles; return the link, and how a supervisor gets one of its own.

    Raises:
        UserError: the robot's file does not say how, or the broker cannot be used.
    """
    if robot.link is None:
        raise UserError(f"robot {robot.name!r} cannot be spoken to: its file in conf/robot/ has no `link:`")
    link = connect(robot, Broker.at(broker.address, broker.password_file, broker.ca_file), name, vehicles)
    told = robot.model_dump(mode="json") | {"link": robot.link.model_dump(mode="json")}
    return link, {
        "factory": "swarmtwin.deploy.control.supervisor:mqtt_link",
        "robot": told,
        "broker": broker.model_dump(mode="json"),
    }


def open_eyes(
    robot: Robot,
    vehicles: Sequence[str],
    arena: Arena,
    camera: str,
    calibration: Path | None,
    by_hand: MeasuredByHand,
) -> Eyes:
    """Open a camera, calibrate it where nobody has, and prepare to find the vehicles on its pictures.

    Raises:
        UserError: there is no such camera, its pictures show no arena, or the calibration is for others.
    """
    eyes = open_camera(camera)
    try:
        pictures = take_pictures(eyes)
        found = loaded_or_fitted(calibration, lambda: pictures, robot, by_hand)
        _check_arena(found, arena)
        tracker = Tracker(found, robot, vehicles)
        tracker.check(pictures[-1])
    except BaseException:
        eyes.close()
        raise
    height_mm = marker_of(robot).height_mm
    (low_x, low_y), (high_x, high_y) = arena.low_mm, arena.high_mm
    corners = [
        (low_x, low_y, height_mm),
        (high_x, low_y, height_mm),
        (high_x, high_y, height_mm),
        (low_x, high_y, height_mm),
    ]
    about = {"source": eyes.source, "calibration": found.model_dump(mode="json")}
    return Eyes(eyes, tracker, found.to_pixels(np.array(corners)), about)


def _check_arena(calibration: Calibration, arena: Arena) -> None:
    """Check that a camera was calibrated for the arena that vehicles are to drive in, or for a larger one."""
    known = calibration.arena_mm
    if (arena.low_mm < known.low_mm).any() or (arena.high_mm > known.high_mm).any():
        raise UserError(
            f"the calibration is for an arena of x {list(known.x)}, y {list(known.y)} mm, and vehicles are to drive "
            f"in x {list(arena.x)}, y {list(arena.y)}: calibrate anew, for that arena"
        )


def say_what_cannot_be_stopped(robot: Robot) -> None:
    """Say once, before anything moves, what no host can do about a link that is lost."""
    if robot.link and robot.link.firmware_timeout_s is None:
        log.warning(
            "these vehicles have no time-out of their own: if Wi-Fi or the broker fails they drive on with their last "
            "command, and nothing here can stop them; stay within reach, or give them firmware with a time-out "
            "(link.firmware_timeout_s)"
        )


def open_view(
    title: str, robot: Robot, vehicles: Sequence[str], arena: Arena, eyes: Eyes, page: PageOptions
) -> LiveView:
    """Serve the live view.

    Raises:
        UserError: its port is taken.
    """
    corners = eyes.corners_px
    view = LiveView(
        Scene(
            title=title,
            vehicles=tuple(vehicles),
            colours=tuple(COLOURS.vehicle(index) for index in range(len(vehicles))),
            arena_mm=(*arena.low_mm.tolist(), *arena.high_mm.tolist()),
            vehicle_size_mm=robot.vehicle_size_mm,
            period_s=robot.period_s,
            corners_px=None if corners is None else tuple((float(x), float(y)) for x, y in corners),
            camera_px=eyes.camera.size,
            host=page.host,
            port=page.port,
        )
    )
    log.info("live view with a stop button: %s", view.address)
    return view


def about_deployment(plan: Plan, header: Header, settings: Mapping[str, Any], eyes: Eyes) -> dict[str, Any]:
    """Return what `deployment.yaml` says from the beginning, so that a killed deployment can be finished from it."""
    packages = ("numpy", "torch", "opencv-python-headless", "paho-mqtt")
    return {
        "swarmtwin": __version__,
        "python": platform.python_version(),
        "packages": {name: importlib.metadata.version(name) for name in packages},
        "robot": plan.robot.model_dump(mode="json"),
        "recording": header.model_dump(mode="json", exclude_none=True),
        "vehicles": list(plan.vehicles),
        "separation_mm": plan.separation_mm,
        "too_near_mm": plan.too_near_mm,
        "camera": dict(eyes.about),
        "settings": dict(settings),
    }


def header_of(plan: Plan, source: str) -> Header:
    """Return the header of a recording that begins now."""
    return Header(
        robot=plan.robot.name,
        period_s=plan.robot.period_s,
        arena_mm=plan.arena,
        source=source,
        vehicles=plan.vehicles,
        started_at=datetime.now(UTC).isoformat(timespec="seconds"),
    )


def finish_recording(folder: Path, plan: Plan, header: Header, about: dict[str, Any]) -> None:
    """Turn the journal of a deployment that has ended into its recording, in `folder`."""
    for file in (folder / CHECKPOINTS).iterdir():
        file.replace(folder / file.name)
    write_deployment(folder, plan.robot, header)
    write_about(folder, about)


def counted(deployment: Deployment, outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Return the figures of control over one or several drives, as plain data."""
    joined = {
        name: [1000 * value for one in outcomes for value in getattr(one, f"{name}_s")]
        for name in ("lateness", "camera_to_command", "decision", "filter", "motion_delay")
    }
    times = {
        f"{name}_ms": dict(zip(("median", "p99"), median_and_p99(values), strict=True))
        for name, values in joined.items()
    }
    watch = deployment.expectation
    alarms = {} if watch is None else dict(zip(deployment.plan.vehicles, watch.rung.tolist(), strict=True))
    return {
        "periods": sum(one.periods for one in outcomes),
        "interventions": deployment.interventions,
        "deadlocks": deployment.deadlocks,
        **times,
        "alarms": alarms,
        "ending": outcomes[-1].ending,
        "reason": outcomes[-1].reason,
        "is_standing": outcomes[-1].is_standing,
    }
