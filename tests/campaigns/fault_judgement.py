"""What became of each fault: whether it was answered in time or survived, by what a witness saw of all vehicles."""

import collections
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from fault_kinds import KINDS, FaultKind
from fault_scene import Scene, Witness

from swarmtwin.deploy.control.recovery import left_by_a_kill, recover
from swarmtwin.robot import Robot


class Brought(NamedTuple):
    """A fault that was brought in: when, when it was taken away, and when the drive was seen to go on or to end."""

    name: str
    began_s: float
    away_s: float
    settled_s: float
    went_on: bool


class Fault(NamedTuple):
    """What became of a fault.

    Attributes:
        name: its kind.
        came_of_it: "survived", "answered" or, where the drive had come to its end meanwhile, "over".
        answer_s: from the fault until all vehicles were told to stand; None: it was survived.
        beyond_mm: how far a vehicle's centre was beyond the fence at most until all was settled; negative: inside.
        wrong: what must not be; "": nothing.
    """

    name: str
    came_of_it: str
    answer_s: float | None
    beyond_mm: float
    wrong: str


class Seen(NamedTuple):
    """What a witness saw, as arrays over M moments.

    Attributes:
        moments: (M,) in s.
        position: (M, V, 2) in mm.
        told_to_move: (M,) whether any vehicle was.
        heard: (when, commands by vehicle) of each message that the campaign has not sent itself.
    """

    moments: np.ndarray
    position: np.ndarray
    told_to_move: np.ndarray
    heard: Sequence[tuple[float, dict[str, np.ndarray]]]

    @classmethod
    def by(cls, witness: Witness) -> "Seen":
        """Take over what a witness saw, which is no longer looking."""
        poses, told = np.array(witness.poses), np.array(witness.told)
        heard = [(when_s, witness.scene.commands(payload)) for when_s, payload in witness.messages]
        return cls(np.array(witness.moments), poses[..., :2], (told != 0).any(axis=(1, 2)), heard)

    def stop_s(self, since_s: float) -> float:
        """Return when the message came from which on no message moves a vehicle; `since_s` where none came later."""
        moving = [when_s for when_s, commands in self.heard if any(one.any() for one in commands.values())]
        last_s = max([since_s, *moving])
        return min((when_s for when_s, commands in self.heard if when_s > last_s and commands), default=since_s)

    def beyond_mm(self, robot: Robot, from_s: float, until_s: float) -> float:
        """Return how far a centre was beyond the fence at most between two moments; negative: all were inside."""
        position = self.position[(self.moments >= from_s) & (self.moments <= until_s)]
        if not len(position):
            return -np.inf
        arena = robot.arena_mm
        return float(np.maximum(arena.low_mm - position, position - arena.high_mm).max())

    def beyond_limits(self, robot: Robot, from_s: float, until_s: float) -> list[str]:
        """Return the first command beyond the robot's limits that was heard between two moments, in words."""
        for when_s, commands in self.heard:
            if from_s <= when_s <= until_s:
                for vehicle, command in commands.items():
                    if (command < robot.command_low).any() or (command > robot.command_high).any():
                        return [f"vehicle {vehicle} was sent {command.tolist()}"]
        return []

    def moved_mm(self, after_s: float) -> float:
        """Return how far a vehicle moved at most after a moment."""
        later = self.position[self.moments > after_s]
        return float(np.linalg.norm(later - later[:1], axis=-1).max()) if len(later) else 0.0

    @property
    def nearest_mm(self) -> float:
        """The least distance of two centres."""
        apart = np.linalg.norm(self.position[:, :, None] - self.position[:, None], axis=-1)
        return float((apart + 1e9 * np.eye(apart.shape[1])).min())


def judged(brought: Brought, seen: Seen, scene: Scene, status: int | None) -> Fault:
    """Return what became of one fault.

    One that the host can answer must find all vehicles told to stand a period later, and standing as soon as wheels
    have run out. One that may be survived is judged in the same way where the drive was stopped, from the first zeros
    that were sent, and from when a robot could hear them.
    """
    kind, robot = KINDS[brought.name], scene.robot
    is_adrift = kind.only_by_firmware and scene.firmware == "published"  # no host could have stopped the vehicles
    beyond_mm = seen.beyond_mm(robot, brought.began_s, brought.settled_s)
    wrong, answer_s = [], None
    if not brought.went_on and status != 0:
        answer_s = until_rest(seen.moments, seen.told_to_move, brought.began_s) - brought.began_s
    if answer_s is not None and not is_adrift:
        latest_s = _latest_s(kind, brought, seen, robot) - brought.began_s
        if answer_s > latest_s:
            wrong.append(f"told to move for {answer_s:.2f} s, at most {latest_s:.2f} s")
        moved_mm = seen.moved_mm(brought.began_s + latest_s + 0.2)  # wheels run out for 0.2 s
        if moved_mm > 3.0:
            wrong.append(f"moved by {moved_mm:.0f} mm later than that")
    if kind.must_be_answered and brought.went_on:
        wrong.append("not answered")
    if beyond_mm > robot.largest_displacement.forward_mm and not is_adrift:
        wrong.append(f"{beyond_mm:.0f} mm beyond the fence")
    wrong += seen.beyond_limits(robot, brought.began_s, brought.settled_s)
    came_of_it = "survived" if brought.went_on else "over" if status == 0 else "answered"
    return Fault(brought.name, came_of_it, answer_s, round(beyond_mm, 1), "; ".join(wrong))


def _latest_s(kind: FaultKind, brought: Brought, seen: Seen, robot: Robot) -> float:
    """Return until when all vehicles must have been told to stand."""
    looks_s = 0.03  # the witness looks every 0.01 s
    if kind.must_be_answered:
        return brought.began_s + robot.period_s * (2 if kind.only_by_firmware else 1) + looks_s
    heard_s = max(seen.stop_s(brought.began_s), brought.away_s if kind.hinders else 0.0)
    return heard_s + robot.period_s + kind.delays_s + looks_s


def until_rest(moments: np.ndarray, told_to_move: np.ndarray, since_s: float, for_s: float = 0.05) -> float:
    """Return the moment from which vehicles are first told to stand for a while.

    What comes later for a shorter time is a command that a frozen broker had kept, with the zeros behind it.
    """
    ends_s = since_s
    for at_s, moves in zip(moments, told_to_move, strict=True):
        if at_s > since_s and moves:
            if at_s - ends_s > for_s:
                return ends_s
            ends_s = at_s
    return ends_s


def lost_rows(scene: Scene, seen: Seen) -> list[str]:
    """Compare the moving commands that the witness saw with those of the recording.

    Where the disk was full the recording is made now that it is not: from the journal, whose space was reserved.
    """
    told = _counted((vehicle, *command) for _, commands in seen.heard for vehicle, command in commands.items())
    if not told:
        return []
    output = scene.project / "out"
    if scene.was_full and left_by_a_kill(output):
        scene.free_disk()
        recover(output)
    table = output / "sent.parquet"
    if not table.exists():
        return ["no recording of a drive"]
    columns = pd.read_parquet(table)[["vehicle", *scene.robot.command_columns]]
    missing = told - _counted(columns.itertuples(index=False, name=None))
    return [f"{missing.total()} commands are not in the recording"] if missing else []


def _counted(rows: Any) -> collections.Counter[tuple[Any, ...]]:
    """Count the rows (vehicle, left, right) that move a vehicle."""
    plain = ((vehicle, *np.round(np.array(command, float), 3).tolist()) for vehicle, *command in rows)
    return collections.Counter(row for row in plain if any(row[1:]))


def complaints(place: Path, status: int | None, is_answered: bool) -> tuple[list[str], str]:
    """Return what is wrong with how a command ended, and its last line."""
    error, shown = ((place / name).read_text(errors="replace") for name in ("error", "shown"))
    wrong = []
    if "Traceback" in error or status in (None, 1):
        wrong.append(f"status {status}: {error[-400:]}")
    elif is_answered and status not in (0, 3, 130, -9):
        wrong.append(f"status {status} after a fault that was to be answered")
    lines = [line for line in (error or shown).splitlines() if line.strip()]
    return wrong, lines[-1][-300:] if lines else ""
