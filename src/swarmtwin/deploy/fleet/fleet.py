"""A fleet: processes of emulated robots and of their camera, started, told and ended together."""

import time
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field

from swarmtwin.deploy.child_process import ChildProcess
from swarmtwin.deploy.fleet.fleet_memory import FleetMemory
from swarmtwin.deploy.fleet.orders import CameraFaults, RobotFaults
from swarmtwin.deploy.link.broker import Broker
from swarmtwin.deploy.link.mqtt_link import connect
from swarmtwin.errors import UserError
from swarmtwin.geometry import wrap_angle
from swarmtwin.robot import Positive, Robot, Seed, StrictModel
from swarmtwin.standin.effects import parse_effects
from swarmtwin.standin.session import require_stand_in
from swarmtwin.world.scenario import draw_apart, inner_room, room_for

Pose = tuple[float, float, float]


class FleetSettings(StrictModel):
    """What a fleet is like.

    Attributes:
        effects: what the stand-ins are told to do: `[{name: battery_sag, loss: 0.3}]`.
        effects_of: and what single vehicles are told besides, by vehicle.
        seed: of all chance, but not of the units' fabrication.
        fps: pictures in a second.
        rays_per_side: of the square of rays that a pixel averages over; 4 costs twice as much as 2, and five vehicles
            are tracked no better (0.30 and 0.28 mm at the 99th percentile).
        firmware_timeout_s: vehicles stop by themselves when no command has come for so long; None: as the robot's file
            says, where that says nothing they drive on.
        session_s: length of a session, for effects by which vehicles age; it begins when the fleet does.
        start_share: of the arena's sides: vehicles stand within that inner part at first.
        wall_mm: so far outside of the arena are the walls that stop a vehicle.
        obstacles: round ones that stand in the arena, (x_mm, y_mm, radius_mm) each: vehicles cannot pass, and the
            camera sees them as discs on the floor.
        camera: how the camera hangs and sees, see `CameraConditions`.
        camera_host: where the camera listens.
    """

    effects: tuple[dict[str, Any], ...] = ()
    effects_of: Mapping[str, tuple[dict[str, Any], ...]] = Field(default_factory=dict)
    seed: Seed = 1
    fps: Annotated[float, Field(gt=0, le=200)] = 30.0
    rays_per_side: Annotated[int, Field(ge=1, le=8)] = 2
    firmware_timeout_s: Positive | None = None
    session_s: Positive = 600.0
    start_share: Annotated[float, Field(gt=0, le=1)] = 0.8
    wall_mm: Annotated[float, Field(ge=0)] = 150.0
    obstacles: tuple[tuple[float, float, Positive], ...] = ()
    camera: Mapping[str, Any] = Field(default_factory=dict)
    camera_host: str = "127.0.0.1"


class Fleet:
    """Emulated robots, one process each, that speak MQTT and nothing else, and their camera, another process.

    Attributes:
        robot: what they are.
        vehicles: their ids.
        settings: what they are like.
        robots: the processes by vehicle.
        camera: the camera's process.
        camera_url: where its pictures are.
        camera_size: width and height of the pictures.
    """

    robots: dict[str, ChildProcess]
    camera: ChildProcess
    camera_url: str
    camera_size: tuple[int, int]

    def __init__(
        self,
        robot: Robot,
        vehicles: Sequence[str],
        broker: Broker,
        camera_port: int = 8090,
        settings: FleetSettings | None = None,
        start: Mapping[str, Pose] | None = None,
    ) -> None:
        """Start all processes and wait until they are ready.

        Args:
            robot: one with a stand-in.
            vehicles: ids of its units.
            broker: to which the robots connect.
            camera_port: 0 takes a free one.
            settings: what they are like; None: as the defaults say.
            start: true poses at the start; None: drawn, apart from each other.

        Raises:
            UserError: the robot has no stand-in, link or marker, an effect makes no sense, too many vehicles for the
                arena, no broker, or the port is taken.
        """
        self.robot, self.vehicles, self.settings = robot, tuple(vehicles), settings or FleetSettings()
        self._broker = broker
        self._check()
        start = dict(start or self.draw_start(self.settings.seed))
        connect(robot, broker, "fleet").close()
        self._memory = FleetMemory(self.vehicles)
        self._began_s = time.monotonic()
        for index, vehicle in enumerate(self.vehicles):
            stands = self._began_s, np.array(start[vehicle], float)
            self._memory.write(index, stands, stands, robot.command_at_rest, 0, 0.0, 0)
        self._camera_port = camera_port
        self.robots = {}
        try:
            for vehicle in self.vehicles:
                self.robots[vehicle] = self._start_robot(vehicle, start[vehicle])
            for process in self.robots.values():
                process.wait_until_ready()
            self.restart_camera()
        except BaseException:
            self.close()
            raise

    def restart_robot(self, vehicle: str) -> None:
        """Switch a robot on again where it stands, its process killed or not."""
        self.robots[vehicle].end()
        pose = self._memory.poses(time.monotonic())[self.vehicles.index(vehicle)]
        self.robots[vehicle] = self._start_robot(vehicle, (float(pose[0]), float(pose[1]), float(pose[2])))
        self.robots[vehicle].wait_until_ready()

    def restart_camera(self) -> None:
        """Switch the camera on, likewise."""
        if hasattr(self, "camera"):
            self.camera.end()
        told = {
            **self._told(),
            "effects": [self._effects(vehicle) for vehicle in self.vehicles],
            "camera": dict(self.settings.camera),
            "fps": self.settings.fps,
            "rays_per_side": self.settings.rays_per_side,
            "host": self.settings.camera_host,
            "port": self._camera_port,
        }
        self.camera = ChildProcess("swarmtwin.deploy.fleet.camera_process", told, (self._memory.descriptor,))
        ready = self.camera.wait_until_ready()
        self._camera_port = ready["port"]
        self.camera_size = (ready["size"][0], ready["size"][1])
        host = "127.0.0.1" if self.settings.camera_host == "0.0.0.0" else self.settings.camera_host
        self.camera_url = f"http://{host}:{self._camera_port}/camera"

    def place(self, poses: Mapping[str, Pose], timeout_s: float = 2.0) -> None:
        """Put vehicles to true poses, where they stand, switched on anew.

        Raises:
            UserError: there is no such vehicle.
            TimeoutError: a robot did not notice: it is frozen or dead.
        """
        orders = self._memory.change_orders(lambda before: before.with_placed(poses))
        end_s = time.monotonic() + timeout_s
        while not self._memory.have_placed(orders, poses):
            if time.monotonic() > end_s:
                raise TimeoutError("a robot that was to be placed does not run")
            time.sleep(0.005)

    def set_faults(self, robots: Mapping[str, RobotFaults] | None = None, camera: CameraFaults | None = None) -> None:
        """Let things go wrong from now on; what is not given stays as it is.

        Raises:
            UserError: they are of a vehicle that there is not.
        """
        self._memory.change_orders(lambda before: before.with_faults(robots, camera))

    def draw_start(self, seed: int) -> dict[str, Pose]:
        """Draw poses apart from each other in the arena's inner part.

        Raises:
            UserError: there are too many vehicles for the arena.
        """
        low, high = self.robot.arena_mm.low_mm, self.robot.arena_mm.high_mm
        room, taken = inner_room(low, high, self.settings.start_share), self._room_of_obstacles()
        count, size_mm = len(self.vehicles), max(self.robot.vehicle_size_mm)
        apart_mm = 2.2 * size_mm
        while room_for(count, room, apart_mm, taken) < count:
            apart_mm *= 0.9
            if apart_mm < 1.1 * size_mm:
                raise UserError(f"vehicles: {count} of {self.robot.name!r} do not fit into the arena: give fewer")
        rng = np.random.default_rng(seed)
        places = draw_apart(rng, count, room, apart_mm, taken[None])[0]
        headings = rng.uniform(-np.pi, np.pi, count)
        return {
            vehicle: (float(x_mm), float(y_mm), float(heading_rad))
            for vehicle, (x_mm, y_mm), heading_rad in zip(self.vehicles, places, headings, strict=True)
        }

    def true_poses(self, time_s: float | None = None) -> dict[str, np.ndarray]:
        """Return the true poses (3,) now, or at a monotonic time just past: for tests and studies alone."""
        poses = self._memory.poses(time.monotonic() if time_s is None else time_s)
        poses[:, 2] = wrap_angle(poses[:, 2])
        return dict(zip(self.vehicles, poses, strict=True))

    def true_commands(self) -> dict[str, np.ndarray]:
        """Return what the vehicles' actuators are told now, (m,): for tests and studies alone."""
        return dict(zip(self.vehicles, self._memory.commands(len(self.robot.command)), strict=True))

    def status(self) -> str:
        """Return one line of how it is."""
        gone = [vehicle for vehicle, process in self.robots.items() if not process.is_running]
        gone += [] if self.camera.is_running else ["the camera"]
        moving = int((self._memory.velocities(time.monotonic()) != 0).any(axis=1).sum())
        heard = int(self._memory.heard().sum())
        line = f"{time.monotonic() - self._began_s:.0f} s: {heard} commands heard, {moving} vehicles moving"
        if (stood_s := float(self._memory.skipped_s().max())) > 0:
            line += f"; frozen for {stood_s:.1f} s in all (stopped, or the machine is too busy)"
        return f"{line}; gone: {', '.join(gone)}" if gone else line

    @property
    def firmware_timeout_s(self) -> float | None:
        """For how long vehicles drive on without a command; None: for ever."""
        if self.settings.firmware_timeout_s is None and self.robot.link is not None:
            return self.robot.link.firmware_timeout_s
        return self.settings.firmware_timeout_s

    def close(self) -> None:
        """End all processes; twice does no harm."""
        for process in [*self.robots.values(), *([self.camera] if hasattr(self, "camera") else [])]:
            process.end()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _check(self) -> None:
        require_stand_in(self.robot)
        if twice := sorted({vehicle for vehicle in self.vehicles if self.vehicles.count(vehicle) > 1}):
            raise UserError(f"vehicle {twice[0]!r} is named twice: give each id once")
        if strangers := sorted(set(self.settings.effects_of) - set(self.vehicles)):
            raise UserError(f"effects_of: there is no vehicle {strangers[0]!r}: {', '.join(self.vehicles)}")
        for vehicle in self.vehicles:
            entries = self._effects(vehicle)
            parse_effects(entries, self.robot, len(self.vehicles))
            if any(entry["name"] == "timing_jitter" for entry in entries):
                raise UserError("effect 'timing_jitter' is the host's clock: a fleet has none; load the host instead")

    def _effects(self, vehicle: str) -> list[dict[str, Any]]:
        return [*self.settings.effects, *self.settings.effects_of.get(vehicle, ())]

    def _room_of_obstacles(self) -> np.ndarray:
        """Return the circles (O, 3) in which no vehicle's centre can start."""
        reach_mm = np.array([0.0, 0.0, 1.1 * max(self.robot.vehicle_size_mm)])
        return np.array(self.settings.obstacles, float).reshape(-1, 3) + reach_mm

    def _told(self) -> dict[str, Any]:
        robot, hardware = self.robot.model_dump(mode="json"), {}
        for name in ("link", "marker"):
            part = getattr(self.robot, name)
            hardware[name] = None if part is None else part.model_dump(mode="json")
        return {
            "robot": {**robot, **hardware},
            "vehicles": list(self.vehicles),
            "memory": self._memory.descriptor,
            "seed": self.settings.seed,
            "obstacles": self.settings.obstacles,
        }

    def _start_robot(self, vehicle: str, pose: Pose) -> ChildProcess:
        orders = self._memory.orders()
        told = {
            **self._told(),
            "effects": self._effects(vehicle),
            "vehicle": vehicle,
            "pose": pose,
            "placed": orders.placement_number(vehicle) if orders else 0,
            "broker": self._broker.told_to_child(),
            "firmware_timeout_s": self.firmware_timeout_s,
            "session_began_s": self._began_s,
            "session_s": self.settings.session_s,
            "wall_mm": self.settings.wall_mm,
        }
        return ChildProcess("swarmtwin.deploy.fleet.robot_process", told, (self._memory.descriptor,))
