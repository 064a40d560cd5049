"""Takes the pictures of an emulated camera, at its pace, and hands them on with what goes wrong."""

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from swarmtwin.deploy.fleet.fleet_memory import FleetMemory
from swarmtwin.deploy.fleet.orders import CameraFaults
from swarmtwin.robot import Robot
from swarmtwin.standin.active_effects import ActiveEffects
from swarmtwin.standin.effect import Effect
from swarmtwin.standin.overhead_camera import CameraConditions, OverheadCamera
from swarmtwin.standin.streams import Streams


@dataclass(frozen=True)
class Picture:
    """A picture that leaves the camera.

    Attributes:
        stamp_s: when it was taken, by the camera's clock, in seconds since 1970.
        jpeg: it, compressed.
    """

    stamp_s: float
    jpeg: bytes


class Shutter:
    """A thread that takes pictures as long as somebody looks.

    Attributes:
        size: width and height of the pictures.
        fps: pictures in a second.
        quality: of the compression, up to 100.
        is_watched: whether pictures are wanted.
        taken: how many were taken.
        late: how many could not be taken in time.
    """

    def __init__(
        self,
        robot: Robot,
        vehicles: Sequence[str],
        effects: Sequence[Sequence[Effect]],
        conditions: CameraConditions,
        memory: FleetMemory,
        seed: int,
        fps: float,
        publish: Callable[[Picture, float], None],
        rays_per_side: int,
        obstacles: Sequence[Sequence[float]] = (),
        quality: int = 92,
    ) -> None:
        """Hang the camera up.

        Args:
            robot: whose vehicles it sees.
            vehicles: their ids.
            effects: on each vehicle; those of marker and camera show in the pictures.
            conditions: how it hangs.
            memory: where the vehicles are.
            seed: of the pictures' noise and of the chance of faults.
            fps: pictures in a second.
            publish: is handed each picture, and how much later it is to arrive, in s.
            rays_per_side: see `OverheadCamera`.
            obstacles: see `OverheadCamera`.
            quality: of the compression.

        Raises:
            UserError: a vehicle's marker cannot be rendered.
        """
        self._camera = OverheadCamera(robot, vehicles, conditions, rays_per_side=rays_per_side, obstacles=obstacles)
        self.size = self._camera.size
        self.fps, self.quality = fps, quality
        self.is_watched = threading.Event()
        self.taken = self.late = 0
        self._conditions = [ActiveEffects(robot, one) for one in effects]
        self._memory, self._publish = memory, publish
        self._rng = Streams(seed, "fleet/camera").of("pictures")
        self._faults = CameraFaults()
        self._orders_number = -1
        self._last: bytes | None = None

    def run(self) -> None:
        """Take pictures for ever."""
        next_s = time.monotonic()
        while True:
            if not self.is_watched.wait(0.5):
                continue
            now_s = time.monotonic()
            if now_s - next_s > 1 / self.fps:
                self.late += int((now_s - next_s) * self.fps) if self.taken else 0
                next_s = now_s
            time.sleep(max(0.0, next_s - now_s))
            self._take()
            next_s += 1 / self.fps

    def _take(self) -> None:
        taken_s, stamp_s = time.monotonic(), time.time()
        self._look_at_orders()
        faults = self._faults
        if faults.silent or self._rng.random() < faults.drop:
            return
        if not faults.frozen or self._last is None:
            self._last = self._picture(taken_s)
        self.taken += 1
        self._publish(Picture(stamp_s + faults.clock_s, self._last), faults.delay_s)

    def _picture(self, time_s: float) -> bytes:
        pose, velocity = self._memory.poses(time_s), self._memory.velocities(time_s)
        wears = self._worn_markers()
        seen = np.array([conditions.seen(one) for conditions, one in zip(self._conditions, pose, strict=True)])
        image = self._camera.render(seen[wears], self._rng, self._faults.hidden, velocity[wears])
        if any(self._faults.shift_px):
            shift = np.array([[1, 0, self._faults.shift_px[0]], [0, 1, self._faults.shift_px[1]]], np.float32)
            image = cv2.warpAffine(image, shift, self.size, borderMode=cv2.BORDER_REPLICATE)
        _, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, self.quality])
        return np.asarray(jpeg).tobytes()

    def _worn_markers(self) -> list[int]:
        """Return for each marker (V,) the index of the vehicle that wears it."""
        names = list(self._camera.vehicles)
        for one, other in self._faults.swapped:
            here, there = names.index(one), names.index(other)
            names[here], names[there] = names[there], names[here]
        return [self._camera.vehicles.index(name) for name in names]

    def _look_at_orders(self) -> None:
        number = self._memory.orders_number
        if number != self._orders_number and (orders := self._memory.orders()) is not None:
            self._orders_number, self._faults = number, orders.camera
