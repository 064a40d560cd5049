"""The controller's side of the live view: hands over pictures and words, and never waits for anybody."""

import json
import shutil
import tempfile
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from swarmtwin.deploy.child_process import ChildProcess
from swarmtwin.deploy.control.heartbeat import Heartbeat
from swarmtwin.deploy.live_view.slot import Slot
from swarmtwin.deploy.tracking.sighting import Sighting
from swarmtwin.robot import StrictModel


class Scene(StrictModel):
    """What does not change while a deployment lasts.

    Attributes:
        title: of the page.
        vehicles: ids, in order.
        colours: of each, `#rrggbb`.
        arena_mm: lowest x and y, highest x and y.
        vehicle_size_mm: length, width.
        period_s: of control.
        corners_px: where the arena's corners are in the picture (lower left, lower right, upper right, upper left, at
            the markers' height); null: the picture is not shown.
        camera_px: width and height of the pictures.
        host: that the page is served at.
        port: likewise; 0: any that is free.
        pictures_per_s: at most, to be shown.
    """

    title: str
    vehicles: tuple[str, ...]
    colours: tuple[str, ...]
    arena_mm: tuple[float, float, float, float]
    vehicle_size_mm: tuple[float, float]
    period_s: float
    corners_px: tuple[tuple[float, float], ...] | None = None
    camera_px: tuple[int, int] = (0, 0)
    host: str = "127.0.0.1"
    port: int = 0
    pictures_per_s: float = 15.0


class LiveView:
    """A page that shows a deployment, in a process of its own.

    Attributes:
        heartbeat: through which its red button is heard.
        address: of the page.
        pid: of the process.
    """

    def __init__(self, scene: Scene) -> None:
        """Start it.

        Raises:
            UserError: the page cannot be served there.
        """
        self.scene = scene
        self._folder = Path(tempfile.mkdtemp(prefix="swarmtwin-view-"))
        self.heartbeat = Heartbeat.create(self._folder / "heartbeat")
        width, height = scene.camera_px
        self._state = Slot.create(self._folder / "state", 2**18)
        self._picture = Slot.create(self._folder / "picture", 3 * width * height + 2**14)
        self._shown_s = -np.inf
        told = {"scene": scene.model_dump(mode="json"), "folder": str(self._folder)}
        self._process = ChildProcess("swarmtwin.deploy.live_view.server", told)
        self.pid = self._process.pid
        self.address: str = self._process.wait_until_ready()["address"]

    def publish(self, state: Mapping[str, Any]) -> None:
        """Show how it stands."""
        with suppress(ValueError, TypeError):  # a number that JSON does not know: the page can do without
            self._state.write(json.dumps(state).encode())

    def show_picture(self, image: np.ndarray, sighting: Sighting) -> None:
        """Show a picture and the vehicles on it, unless one was shown just before."""
        now_s = time.monotonic()
        if now_s - self._shown_s < 0.9 / self.scene.pictures_per_s:
            return
        self._shown_s = now_s
        about = {
            "shape": image.shape,
            "captured_s": sighting.captured_s,
            "poses": {vehicle: pose.tolist() for vehicle, pose in sighting.poses.items()},
        }
        head = json.dumps(about).encode()
        self._picture.write(len(head).to_bytes(4, "little"), head, np.ascontiguousarray(image).data.cast("B"))

    def close(self) -> None:
        """End it."""
        self._process.end()
        shutil.rmtree(self._folder, ignore_errors=True)
