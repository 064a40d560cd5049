"""All poses on all pictures of a source that ends, and what was not seen or not believed."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from swarmtwin.deploy.camera.camera import Camera
from swarmtwin.deploy.tracking.sighting import Sighting
from swarmtwin.deploy.tracking.tracker import Tracker


@dataclass
class TrackedPictures:
    """What a tracker made of all pictures of a source.

    Attributes:
        vehicles: those that were looked for.
        sightings: one a picture, in order of time.
        strangers: on how many pictures each marker is seen that belongs to nobody.
    """

    vehicles: tuple[str, ...]
    sightings: list[Sighting] = field(default_factory=list)
    strangers: Counter[int] = field(default_factory=Counter)

    def poses(self, began_s: float = 0.0) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Return for each vehicle that was ever seen its times (S,), counted from `began_s` on, and poses (S, 3)."""
        found = {}
        for vehicle in self.vehicles:
            seen = [(one.captured_s, one.poses[vehicle]) for one in self.sightings if vehicle in one.poses]
            if seen:
                times_s, poses = zip(*seen, strict=True)
                found[vehicle] = began_s + np.array(times_s), np.array(poses)
        return found

    def seen(self, vehicle: str) -> int:
        """Return on how many pictures a vehicle is seen and believed."""
        return sum(vehicle in one.poses for one in self.sightings)

    def doubts(self, vehicle: str) -> Counter[str]:
        """Return on how many pictures a vehicle is doubted, by the reason's beginning."""
        return Counter(_kind(one.doubts[vehicle]) for one in self.sightings if vehicle in one.doubts)


def track_all(
    camera: Camera, tracker: Tracker, vehicles: Sequence[str], on_picture: Callable[[], None] = lambda: None
) -> TrackedPictures:
    """Look at all pictures of a source that ends, calling `on_picture` after each."""
    tracked = TrackedPictures(tuple(vehicles))
    number = -1
    while (frame := camera.next_frame(number)) is not None:
        number = frame.number
        sighting = tracker.track(frame)
        tracked.sightings.append(sighting)
        tracked.strangers.update(sighting.strangers)
        on_picture()
    return tracked


def _kind(reason: str) -> str:
    """Return a reason without its figures, so that like ones can be counted together."""
    return reason.partition(":")[0] if not reason.startswith("it jumped") else "it jumped farther than it can move"
