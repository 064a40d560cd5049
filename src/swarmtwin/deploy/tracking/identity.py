"""Whether a marker that is seen can be the vehicle whose id it bears: doubt until a strange sight persists."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from swarmtwin.geometry import displacement_between
from swarmtwin.robot import Robot


@dataclass(frozen=True)
class IdentitySettings:
    """When a pose is doubted.

    Attributes:
        allowance: motion that is believed, as a multiple of the robot's largest displacement in the time that passed.
        slack_mm: what is believed besides, however short the time: errors of measurement.
        slack_rad: likewise.
        pictures_to_believe: a vehicle that jumped is believed when so many pictures in a row agree.
        exchange_share: two vehicles that each appear nearer to where the other was than this share of the distance
            between them are taken for exchanged.
    """

    allowance: float = 1.5
    slack_mm: float = 5.0
    slack_rad: float = 0.15
    pictures_to_believe: int = 5
    exchange_share: float = 0.3


@dataclass
class _Known:
    """What is known of a vehicle: where it was believed to be last, and where it seems to have jumped to."""

    pose: np.ndarray
    seen_s: float
    elsewhere: np.ndarray | None = None
    elsewhere_s: float = 0.0
    pictures: int = 0


class Identities:
    """Remembers where vehicles were, and doubts those that appear where they cannot be."""

    def __init__(self, robot: Robot, settings: IdentitySettings | None = None) -> None:
        """Know nothing yet.

        Args:
            robot: whose largest displacement says what is believable.
            settings: when a pose is doubted.
        """
        self._robot, self._settings = robot, settings or IdentitySettings()
        self._known: dict[str, _Known] = {}

    def doubts(self, poses: Mapping[str, np.ndarray], at_s: float) -> dict[str, str]:
        """Take in the poses (3,) on one picture, and return which are not believed, and why."""
        strange = self._exchanged(poses)
        for vehicle, pose in poses.items():
            known = self._known.get(vehicle)
            if known is None:
                continue
            if vehicle not in strange and not self._reachable(known.pose, pose, at_s - known.seen_s):
                moved = np.linalg.norm(pose[:2] - known.pose[:2])
                turned = abs(np.rad2deg(displacement_between(known.pose, pose)[2]))
                strange[vehicle] = (
                    f"it jumped by {moved:.0f} mm and {turned:.0f}° within {at_s - known.seen_s:.2f} s, "
                    "more than it can move"
                )
        return {
            vehicle: strange[vehicle]
            for vehicle, pose in poses.items()
            if not self._believe(vehicle, pose, at_s, vehicle in strange)
        }

    def _believe(self, vehicle: str, pose: np.ndarray, at_s: float, is_strange: bool) -> bool:
        known = self._known.get(vehicle)
        if known is None or not is_strange:
            self._known[vehicle] = _Known(pose, at_s)
            return True
        agrees = known.elsewhere is not None and self._reachable(known.elsewhere, pose, at_s - known.elsewhere_s)
        known.pictures = known.pictures + 1 if agrees else 1
        known.elsewhere, known.elsewhere_s = pose, at_s
        if known.pictures >= self._settings.pictures_to_believe:
            self._known[vehicle] = _Known(pose, at_s)
            return True
        return False

    def _reachable(self, start: np.ndarray, end: np.ndarray, elapsed_s: float) -> bool:
        settings = self._settings
        reach = settings.allowance * self._robot.displacement_limit * max(elapsed_s, 0.0) / self._robot.period_s
        moved = displacement_between(start, end)
        far = np.hypot(moved[0], moved[1]) > np.hypot(reach[0], reach[1]) + settings.slack_mm
        return not far and abs(moved[2]) <= reach[2] + settings.slack_rad

    def _exchanged(self, poses: Mapping[str, np.ndarray]) -> dict[str, str]:
        """Return those that appear where another was, which appears where they were."""
        here = [vehicle for vehicle in poses if vehicle in self._known]
        found: dict[str, str] = {}
        for index, one in enumerate(here):
            for other in here[index + 1 :]:
                before = self._known[one].pose[:2], self._known[other].pose[:2]
                near = self._settings.exchange_share * np.linalg.norm(before[0] - before[1])
                crossed = np.linalg.norm(poses[one][:2] - before[1]), np.linalg.norm(poses[other][:2] - before[0])
                if max(crossed) < near:
                    found[one] = f"it appears where vehicle {other} was, and {other} where {one} was"
                    found[other] = f"it appears where vehicle {one} was, and {one} where {other} was"
        return found
