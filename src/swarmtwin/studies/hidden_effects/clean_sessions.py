"""Sessions with nothing wrong, which differ from the reference in all that is no gap."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from swarmtwin.geometry import wrap_angle
from swarmtwin.recordings.recording import Recording
from swarmtwin.recordings.writing import HEADING_DECIMALS, POSITION_DECIMALS
from swarmtwin.robot import Arena, Bounds, Robot
from swarmtwin.standin.session import StandInSession

BOTH = ("mgr", "mur")

VARIETIES: dict[str, tuple[str, ...]] = {
    "plain": BOTH,
    "uniform": BOTH,
    "gentle": BOTH,
    "held": BOTH,
    "waypoints": BOTH,
    "smooth": BOTH,
    "short_runs": BOTH,
    "long_runs": BOTH,
    "few_transitions": BOTH,
    "many_transitions": BOTH,
    "other_vehicle": BOTH,
    "group": BOTH,
    "other_arena": ("mgr",),  # another pool has its walls, which the MUR's simulation knows by place, elsewhere
    "camera_noise": BOTH,
    "lost_poses": BOTH,
    "time_of_day": BOTH,
    "mixed": BOTH,
}
"""Kinds of sessions with nothing wrong, and the robots that have them; `mixed` differs in everything at once."""


@dataclass(frozen=True)
class CleanSession:
    """A session with nothing wrong.

    Attributes:
        session: what is driven.
        pose_noise: the camera's noise over the usual one.
    """

    session: StandInSession
    pose_noise: float = 1.0


def clean_session(variety: str, usual: StandInSession, rng: np.random.Generator) -> CleanSession:
    """Return a session that differs from the usual one as its variety says.

    Args:
        variety: one of `VARIETIES`.
        usual: what it would be otherwise.
        rng: of all that is left to chance.
    """
    if variety != "mixed":
        changes = _changes(variety, usual, rng)
    else:
        changes = {}
        for one in ("commands", "lengths", "group", "other_arena", "lost_poses", "time_of_day"):
            if one != "other_arena" or usual.robot.name in VARIETIES["other_arena"]:
                changes |= _changes(one, replace(usual, **changes), rng) if rng.random() < 0.6 else {}
    noisy = variety == "camera_noise" or (variety == "mixed" and rng.random() < 0.5)
    return CleanSession(replace(usual, **changes), round(float(rng.uniform(1.5, 3.0)), 3) if noisy else 1.0)


def _changes(variety: str, usual: StandInSession, rng: np.random.Generator) -> dict[str, Any]:
    """Return the fields of the session that differ."""
    transitions = usual.runs * usual.steps
    match variety:
        case "uniform" | "gentle" | "held" | "waypoints" | "smooth":
            return {"command_mode": variety}
        case "commands":
            return {"command_mode": str(rng.choice(["uniform", "gentle", "held", "waypoints", "smooth"]))}
        case "short_runs":
            return _lasting(transitions, 10)
        case "long_runs":
            return _lasting(transitions, 100)
        case "few_transitions":
            return _lasting(0.15 * transitions, usual.steps)
        case "many_transitions":
            return _lasting(2.5 * transitions, usual.steps)
        case "lengths":
            steps = round(float(np.exp(rng.uniform(np.log(10), np.log(100)))))
            return _lasting(transitions * float(np.exp(rng.uniform(np.log(0.15), np.log(2.5)))), steps)
        case "group":
            vehicles = (*usual.vehicles, *_others(usual, rng)[: int(rng.integers(1, 3))])
            return {"vehicles": vehicles, "runs": max(8, usual.runs // len(vehicles))}
        case "other_arena":
            return {"robot": _elsewhere(usual.robot, rng)}
        case "lost_poses":
            return {"lost_poses": round(float(rng.uniform(0.02, 0.1)), 4)}
        case "time_of_day":
            return {"starts_s": round(float(rng.uniform(1800.0, 36_000.0)), 1)}
    return {}


def _lasting(transitions: float, steps: int) -> dict[str, int]:
    return {"runs": max(8, round(transitions / steps)), "steps": steps}


def _others(usual: StandInSession, rng: np.random.Generator, units: int = 9) -> list[str]:
    """Return the ids of other units, in an order that is drawn."""
    return [str(unit) for unit in rng.permutation(np.arange(1, units + 1)) if str(unit) not in usual.vehicles]


def _elsewhere(robot: Robot, rng: np.random.Generator) -> Robot:
    """Return the robot in another arena, with another corner as its frame's origin."""

    def side(usual: Bounds) -> Bounds:
        start_mm, length_mm = float(rng.uniform(-800, 800)), (usual[1] - usual[0]) * float(rng.uniform(0.7, 1.5))
        return round(start_mm, 1), round(start_mm + length_mm, 1)

    return robot.model_copy(update={"arena_mm": Arena(x=side(robot.arena_mm.x), y=side(robot.arena_mm.y))})


def blurred(recording: Recording, session: StandInSession, pose_noise: float, rng: np.random.Generator) -> Recording:
    """Add to the camera's noise until it is `pose_noise` times as large."""
    physics = session.physics(session.vehicles)
    usual = np.array([physics.position_noise_mm, physics.position_noise_mm, physics.heading_noise_rad])
    size = usual * np.sqrt(pose_noise**2 - 1.0)
    tracks = []
    for track in recording.tracks:
        pose = track.pose + size * rng.standard_normal(track.pose.shape)
        pose[:, :2] = pose[:, :2].round(POSITION_DECIMALS)
        pose[:, 2] = wrap_angle(pose[:, 2]).round(HEADING_DECIMALS)
        tracks.append(replace(track, pose=pose))
    return replace(recording, tracks=tuple(tracks))
