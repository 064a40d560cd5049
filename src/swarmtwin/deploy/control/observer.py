"""A thread that takes pictures and finds the vehicles on them, so that the newest poses are always at hand."""

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from swarmtwin.deploy.camera.camera import Camera, Frame
from swarmtwin.deploy.tracking.sighting import Sighting


class Tracks(Protocol):
    """What finds vehicles on pictures: `tracking/tracker.py`."""

    def track(self, frame: Frame) -> Sighting:
        """Return where the vehicles are on a picture."""


@dataclass(frozen=True)
class SeenPose:
    """A vehicle's pose and when it had it.

    Attributes:
        pose: (3,) x_mm, y_mm, heading_rad as measured.
        captured_s: when its picture was taken, on the monotonic clock.
        known_s: when the pose was known here.
    """

    pose: np.ndarray
    captured_s: float
    known_s: float


class Observer:
    """Takes every picture that it has time for.

    Attributes:
        camera: where the pictures come from.
        failure: why there will be no more pictures; None: there will.
        frame: the newest picture, for people to look at.
        last_captured_s: when the newest picture was taken.
        last_known_s: when the newest picture's poses were known.
    """

    def __init__(
        self,
        camera: Camera,
        tracker: Tracks,
        vehicles: Sequence[str],
        on_sighting: Callable[[Sighting, Frame], None] = lambda sighting, frame: None,
        remembered_s: float = 10.0,
        picture_timeout_s: float = 1.0,
    ) -> None:
        """Prepare; `start` begins.

        Args:
            camera: where the pictures come from.
            tracker: finds the vehicles.
            vehicles: ids of those that are looked for.
            on_sighting: called with each sighting and its picture, in the observer's thread.
            remembered_s: for how long poses are kept.
            picture_timeout_s: without a picture for so long the camera is lost.
        """
        self.camera = camera
        self.failure: str | None = None
        self.frame: Frame | None = None
        self.last_captured_s = -np.inf
        self.last_known_s = -np.inf
        self._tracker = tracker
        self._vehicles = tuple(vehicles)
        self._on_sighting = on_sighting
        self._remembered_s = remembered_s
        self._picture_timeout_s = picture_timeout_s
        self._seen: dict[str, deque[SeenPose]] = {vehicle: deque() for vehicle in vehicles}
        self._known_s: deque[float] = deque(maxlen=64)
        self._doubts: Mapping[str, str] = {}
        self._changed = threading.Condition()
        self._ends = threading.Event()
        self._may_look = threading.Event()
        self._may_look.set()
        self._thread = threading.Thread(target=self._run, name="observer", daemon=True)

    def start(self) -> None:
        """Begin to take pictures."""
        self._thread.start()

    def close(self) -> None:
        """Take no more pictures, and let go of the camera."""
        self._ends.set()
        if self._thread.ident is not None:
            self._thread.join(2 * self._picture_timeout_s)
        self.camera.close()

    @contextlib.contextmanager
    def quiet(self) -> Iterator[None]:
        """Begin with no further picture for now: two threads that compute at once take several times as long.

        A picture that comes meanwhile is looked at afterwards, unless there is a newer one by then.
        """
        self._may_look.clear()
        try:
            yield
        finally:
            self._may_look.set()

    def newest(self) -> dict[str, SeenPose]:
        """Return the newest pose of each vehicle that was ever seen."""
        with self._changed:
            return {vehicle: seen[-1] for vehicle, seen in self._seen.items() if seen}

    def since(self, vehicle: str, from_s: float) -> list[SeenPose]:
        """Return a vehicle's poses on pictures taken after a moment, in order."""
        with self._changed:
            return [one for one in self._seen[vehicle] if one.captured_s > from_s]

    def known_around(self, at_s: float) -> float | None:
        """Return when a picture's poses were known, of all pictures nearest to a moment; None: there were none."""
        with self._changed:
            return min(self._known_s, key=lambda known_s: abs(known_s - at_s), default=None)

    @property
    def doubts(self) -> Mapping[str, str]:
        """Vehicles whose marker was seen on the newest picture and not believed, and why."""
        return self._doubts

    def wait_for_picture(self, after_s: float, timeout_s: float) -> bool:
        """Wait until poses of a picture are known that were not at a moment; return whether they are."""
        with self._changed:
            return self._changed.wait_for(lambda: self.last_known_s > after_s or self.failure is not None, timeout_s)

    def _run(self) -> None:
        number = -1
        try:
            while not self._ends.is_set():
                frame = self.camera.next_frame(number, self._picture_timeout_s)
                if frame is None:
                    self._fail("its pictures have come to an end")
                    return
                number = frame.number
                self._may_look.wait(self._picture_timeout_s)
                self._take_in(self._tracker.track(frame), frame)
        except Exception as error:  # whatever it is, the controller must know, and stop
            self._fail(" ".join(str(error).split()) or type(error).__name__)

    def _take_in(self, sighting: Sighting, frame: Frame) -> None:
        now_s = time.monotonic()
        with self._changed:
            for vehicle, pose in sighting.poses.items():
                seen = self._seen.get(vehicle)
                if seen is not None and np.isfinite(pose).all():
                    seen.append(SeenPose(np.asarray(pose, float), sighting.captured_s, now_s))
                    while seen[0].captured_s < sighting.captured_s - self._remembered_s:
                        seen.popleft()
            self._doubts = sighting.doubts
            self.frame = frame
            self.last_captured_s = sighting.captured_s
            self.last_known_s = now_s
            self._known_s.append(now_s)
            self._changed.notify_all()
        self._on_sighting(sighting, frame)

    def _fail(self, reason: str) -> None:
        if self._ends.is_set():
            return
        with self._changed:
            self.failure = f"{self.camera.source}: {reason}"
            self._changed.notify_all()
