"""The reasons to stop all vehicles at once, each a question that can be asked at any moment."""

from collections.abc import Mapping, Sequence

import numpy as np

from swarmtwin.deploy.control.heartbeat import Heartbeat
from swarmtwin.deploy.control.observer import Observer, SeenPose
from swarmtwin.deploy.control.settings import SafetySettings
from swarmtwin.deploy.link.link import Link
from swarmtwin.robot import Arena, Robot


class StopConditions:
    """Judges what is seen and heard; each method returns a reason in words, or None."""

    def __init__(
        self,
        robot: Robot,
        arena: Arena,
        vehicles: Sequence[str],
        settings: SafetySettings,
        too_near_mm: float,
        obstacles: np.ndarray | None = None,
    ) -> None:
        """Prepare.

        Args:
            robot: what is driven.
            arena: whose border is the fence.
            vehicles: their ids.
            settings: limits.
            too_near_mm: two centres nearer than this stop all.
            obstacles: (O, 3) x_mm, y_mm, radius_mm; None: there are none.
        """
        self._robot, self._arena, self._settings = robot, arena, settings
        self._vehicles = tuple(vehicles)
        self._too_near_mm = too_near_mm
        self._obstacles = np.empty((0, 3)) if obstacles is None else obstacles
        self._interruptions_at_start: int | None = None
        self._foreign_at_start: int | None = None
        self._standing_since_s = dict.fromkeys(vehicles, np.inf)

    def of_pictures(self, now_s: float, observer: Observer) -> str | None:
        """Ask whether pictures come."""
        if observer.failure:
            return observer.failure
        age_s = now_s - observer.last_captured_s
        if age_s > self._settings.picture_age_s:
            return f"{observer.camera.source}: no picture for {age_s:.2f} s"
        return None

    def of_poses(self, now_s: float, seen: Mapping[str, SeenPose], doubts: Mapping[str, str]) -> str | None:
        """Ask whether all vehicles are seen, within the fence and apart."""
        for vehicle in self._vehicles:
            age_s = now_s - seen[vehicle].captured_s if vehicle in seen else np.inf
            if age_s > self._settings.pose_age_s:
                because = f" ({doubts[vehicle]})" if vehicle in doubts else ""
                return f"vehicle {vehicle} has not been seen for {age_s:.2f} s{because}"
        position = np.array([seen[vehicle].pose[:2] for vehicle in self._vehicles])
        return self.of_positions(position)

    def of_positions(self, position: np.ndarray) -> str | None:
        """Ask whether vehicles at (V, 2) are within the fence, apart, and beside the obstacles."""
        beyond = np.maximum(self._arena.low_mm - position, position - self._arena.high_mm).max(axis=1)
        if (farthest := int(np.argmax(beyond))) >= 0 and beyond[farthest] > self._settings.outside_mm:
            return f"vehicle {self._vehicles[farthest]} is {beyond[farthest]:.0f} mm beyond the fence"
        for x_mm, y_mm, radius_mm in self._obstacles:
            away = np.hypot(*(position - (x_mm, y_mm)).T)
            if away[nearest := int(np.argmin(away))] < radius_mm + 0.9 * min(self._robot.vehicle_size_mm) / 2:
                return f"vehicle {self._vehicles[nearest]} is in the obstacle at x {x_mm:.0f}, y {y_mm:.0f} mm"
        apart = np.sqrt(((position[:, None] - position[None]) ** 2).sum(axis=-1))
        np.fill_diagonal(apart, np.inf)
        one, other = np.unravel_index(np.argmin(apart), apart.shape)
        if apart[one, other] < self._too_near_mm:
            names = f"{self._vehicles[one]} and {self._vehicles[other]}"
            return f"vehicles {names} are too near each other, {apart[one, other]:.0f} mm"
        return None

    def of_link(self, link: Link) -> str | None:
        """Ask whether commands have a way to go, and whether anybody else gives some.

        A link that was lost and is back is no better than one that is lost: a broker that was started anew has lost the
        vehicles, too, which may take seconds to come back and drive on until then.
        """
        if not link.is_connected:
            return "the link to the vehicles is lost"
        interruptions = getattr(link, "interruptions", 0)
        if self._interruptions_at_start is None:
            self._interruptions_at_start = interruptions
        if interruptions > self._interruptions_at_start:
            return "the link to the vehicles was lost for a moment: some may still be without one"
        foreign = getattr(link, "foreign_messages", None)
        if foreign is None:
            return None
        if self._foreign_at_start is None:
            self._foreign_at_start = foreign.moving
        if foreign.moving > self._foreign_at_start:
            return f"somebody else commands the vehicles: {foreign.last_payload.decode(errors='replace')}"
        return None

    def of_supervisor(self, now_s: float, heartbeat: Heartbeat, is_alive: bool) -> str | None:
        """Ask whether the supervisor watches, and has not stopped the vehicles."""
        if reason := heartbeat.latched:
            return f"the supervisor has stopped the vehicles: {reason}"
        if not is_alive:
            return "the supervisor died"
        silence_s = now_s - heartbeat.read("supervisor_beat_s")
        if silence_s > 1.5 * self._settings.heartbeat_limit_s(self._robot):
            return f"the supervisor has been silent for {silence_s:.2f} s"
        return None

    def of_decision(self, requested: np.ndarray, took_s: float) -> str | None:
        """Ask whether the policy's commands (V, m) are numbers, and came in time."""
        broken = np.flatnonzero(~np.isfinite(requested).all(axis=1))
        if len(broken):
            return f"the policy gives vehicle {self._vehicles[broken[0]]} a command that is not finite"
        if took_s > self._settings.decision_s:
            return f"the policy was late: it took {took_s * 1000:.0f} ms"
        return None

    def note_sent(self, now_s: float, command: np.ndarray) -> None:
        """Take notice of commands (V, m) sent."""
        at_rest = np.all(np.abs(command - self._robot.command_at_rest) < 1e-9, axis=1)
        for vehicle, stands in zip(self._vehicles, at_rest, strict=True):
            since_s = self._standing_since_s[vehicle]
            self._standing_since_s[vehicle] = min(since_s, now_s) if stands else np.inf

    def of_obedience(self, now_s: float, observer: Observer) -> str | None:
        """Ask whether vehicles stand that have been told to for two periods."""
        period_s = self._robot.period_s
        for vehicle in self._vehicles:
            if now_s - self._standing_since_s[vehicle] < 3 * period_s:
                continue
            seen = observer.since(vehicle, now_s - period_s)
            if len(seen) < 2:
                continue
            moved_mm = float(np.hypot(*(seen[-1].pose - seen[0].pose)[:2]))
            if moved_mm > self._settings.standing_moves_mm:
                return f"vehicle {vehicle} does not obey: it is told to stand and moved {moved_mm:.0f} mm"
        return None


def standing(seen: Sequence[SeenPose], settings: SafetySettings) -> bool:
    """Return whether a vehicle's poses over the last while show that it stands."""
    if len(seen) < 3 or seen[-1].captured_s - seen[0].captured_s < 0.7 * settings.standstill_s:
        return False
    position = np.array([one.pose[:2] for one in seen])
    return bool(np.hypot(*(position - position[-1]).T).max() <= settings.standstill_mm)


def all_standing(
    observer: Observer, vehicles: Sequence[str], settings: SafetySettings, now_s: float, begun_s: float
) -> bool:
    """Return whether all vehicles are seen to stand, by what was seen since a stop began."""
    if now_s - begun_s < settings.standstill_s:
        return False
    from_s = max(now_s - settings.standstill_s - 0.1, begun_s)
    return all(standing(observer.since(vehicle, from_s), settings) for vehicle in vehicles)
