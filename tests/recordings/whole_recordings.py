"""Recordings of three robots to be judged as a whole: with a mistake each, and unusual ones that are sound."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import yaml

from swarmtwin.recordings.recording import SENT_FILE, Header, Recording, Track
from swarmtwin.recordings.sent_commands import write_sent_commands
from swarmtwin.robot import Arena, Robot
from swarmtwin.standin.drive_commands import Operator
from swarmtwin.standin.session import StandInSession
from swarmtwin.studies.hidden_effects.cases import Case
from swarmtwin.studies.hidden_effects.effect_sizes import CATALOGUE
from swarmtwin.studies.hidden_effects.hideable_effects import made_effects
from swarmtwin.studies.hidden_effects.sessions import sized_entry
from swarmtwin.studies.stand_in_recording import record

SEED = 20261122
TIMED = ("time_s", "command")
ROBOTS = {name: Robot.load(Path(__file__).parents[2] / f"conf/robot/{name}.yaml") for name in ("mgr", "mur", "create")}
Edit = Callable[[Recording], Recording]


@cache
def sound(robot: str, mode: str = "uniform", seed: int = 1, vehicles: int = 1, lost: float = 0.0) -> Recording:
    """Three runs of 120 periods: of the stand-ins, and for the Create of a unicycle that lags and slips a little."""
    ids = tuple(str(number + 1) for number in range(vehicles))
    if robot == "create":
        return unicycle(ROBOTS[robot], mode, seed, ids, lost)
    session = StandInSession(ROBOTS[robot], ids, 3, 120, seed, command_mode=mode, lost_poses=lost, operator=Operator())
    return record(session)[1]


def unicycle(robot: Robot, mode: str, seed: int, ids: Sequence[str], lost: float) -> Recording:
    rng = np.random.default_rng([SEED, seed])
    low, high = robot.command_low, robot.command_high
    if mode == "gentle":
        low, high = low + (high - low) / 4, high - (high - low) / 4
    tracks = []
    for run in range(3):
        for vehicle in ids:
            commands = rng.uniform(low, high, (121, 2))
            if mode in ("held", "waypoints"):
                commands = commands[np.arange(121) // (4 if mode == "held" else 12)]
            poses = driven(robot, commands, rng)
            commands[-1] = np.nan
            poses[rng.random(121) < lost] = np.nan
            tracks.append(Track(f"run_{run:03d}", vehicle, np.arange(121) * robot.period_s + 60 * run, commands, poses))
    header = Header(robot=robot.name, period_s=robot.period_s, arena_mm=robot.arena_mm, source="a unicycle")
    return Recording(robot, header, tuple(tracks))


def driven(robot: Robot, commands: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Poses (T, 3) of a unicycle of which a fifth of each speed is still the one before."""
    at = np.array([*rng.uniform(0, 3000, 2), rng.uniform(-np.pi, np.pi)])
    poses, speed = [at], np.zeros(2)
    for command in commands[:-1]:
        speed = 0.2 * speed + 0.8 * command * rng.normal(1, 0.03, 2)
        turn = speed[1] * robot.period_s
        way, along = speed[0] * robot.period_s, at[2] + turn / 2
        at = at + np.array([way * np.cos(along), way * np.sin(along), turn])
        poses.append(at)
    noisy = np.array(poses) + rng.normal(0, [0.3, 0.3, 0.002], (len(poses), 3))
    noisy[:, 2] = np.angle(np.exp(1j * noisy[:, 2]))
    return noisy


def write(recording: Recording, folder: Path) -> Path:
    """Write a recording as it is, with all digits, headings unwrapped or in degrees as they may be."""
    (folder / "runs").mkdir(parents=True)
    header = recording.header.model_dump(mode="json", exclude_none=True)
    (folder / "recording.yaml").write_text(yaml.safe_dump(header))
    columns = (*recording.robot.command_columns, "x_mm", "y_mm", "heading_rad")
    for run in recording.runs:
        tracks = [track for track in recording.tracks if track.run == run]
        tables = [
            pd.DataFrame(np.column_stack([track.command, track.pose]), columns=columns).assign(
                time_s=track.time_s, vehicle=track.vehicle
            )
            for track in tracks
        ]
        pd.concat(tables).sort_values("time_s", kind="stable").to_parquet(folder / "runs" / f"{run}.parquet")
    if recording.sent:
        write_sent_commands(folder / SENT_FILE, recording.robot, recording.sent)
    return folder


def logged(ahead_s: float) -> Edit:
    """Keep a log of the commands, at the times they were sent by a clock that is so far ahead."""

    def apply(recording: Recording) -> Recording:
        sent = {}
        for vehicle in recording.vehicles:
            tracks = [track for track in recording.tracks if track.vehicle == vehicle]
            time_s, command = (np.concatenate([getattr(track, name) for track in tracks]) for name in TIMED)
            given = np.isfinite(command).all(axis=1)
            sent[vehicle] = time_s[given] + ahead_s, command[given]
        return replace(recording, sent=sent)

    return apply


def posed(change: Callable[[np.ndarray], np.ndarray]) -> Edit:
    """Edit all poses (T, 3)."""
    return tracked(lambda track: replace(track, pose=np.asarray(change(track.pose), dtype=float)))


def commanded(change: Callable[[np.ndarray], np.ndarray]) -> Edit:
    """Edit all commands (T, m)."""
    return tracked(lambda track: replace(track, command=np.asarray(change(track.command), dtype=float)))


def timed(change: Callable[[np.ndarray], np.ndarray]) -> Edit:
    """Edit all times (T,)."""
    return tracked(lambda track: replace(track, time_s=np.asarray(change(track.time_s), dtype=float)))


def tracked(change: Callable[[Track], Track]) -> Edit:
    return lambda recording: replace(recording, tracks=tuple(change(track) for track in recording.tracks))


def both(*edits: Edit) -> Edit:
    def apply(recording: Recording) -> Recording:
        for edit in edits:
            recording = edit(recording)
        return recording

    return apply


def scaled(factor: float) -> Edit:
    return posed(lambda pose: pose * [factor, factor, 1])


def headed(factor: float, offset: float = 0.0) -> Edit:
    """Headings times a factor, in (−π, π] before that."""
    return posed(lambda pose: np.column_stack([pose[:, :2], np.angle(np.exp(1j * (pose[:, 2] * factor + offset)))]))


def in_unit(factor: float) -> Edit:
    """Headings in another unit than rad."""
    return posed(lambda pose: pose * [1, 1, factor])


def with_column(index: int, change: Callable[[np.ndarray], np.ndarray]) -> Edit:
    def edit(command: np.ndarray) -> np.ndarray:
        changed = command.copy()
        changed[:, index] = change(command[:, index])
        return changed

    return commanded(edit)


def late(rows: int) -> Edit:
    """Commands so many rows below their own."""
    return commanded(
        lambda command: np.roll(np.vstack([command, np.full((abs(rows), command.shape[1]), np.nan)]), rows, axis=0)[
            : len(command)
        ]
    )


def frozen_for(share: float) -> Edit:
    """Poses that stay from a share of each run on."""

    def edit(pose: np.ndarray) -> np.ndarray:
        kept = int(len(pose) * share)
        return np.vstack([pose[:kept], np.tile(pose[kept], (len(pose) - kept, 1))])

    return posed(edit)


def mirrored_y(recording: Recording) -> Recording:
    """Y downwards from the upper edge, headings as they are."""
    low, high = recording.header.arena_mm.y
    return posed(lambda pose: np.column_stack([pose[:, 0], low + high - pose[:, 1], pose[:, 2]]))(recording)


def mirrored_x(recording: Recording) -> Recording:
    low, high = recording.header.arena_mm.x
    return posed(lambda pose: np.column_stack([low + high - pose[:, 0], pose[:, 1:]]))(recording)


def from_the_middle(recording: Recording) -> Recording:
    arena = recording.header.arena_mm
    middle = np.append((arena.low_mm + arena.high_mm) / 2, 0)
    size = np.append(arena.high_mm - arena.low_mm, 0)
    if np.all(np.abs(middle[:2]) < 0.2 * size[:2]):  # it is there anyway: count from a far corner instead
        return posed(lambda pose: pose + 2 * size)(recording)
    return posed(lambda pose: pose - middle)(recording)


def shares_of_limits(factor: float) -> Edit:
    def edit(recording: Recording) -> Recording:
        largest = np.maximum(np.abs(recording.robot.command_low), np.abs(recording.robot.command_high))
        return commanded(lambda command: command / largest * factor)(recording)

    return edit


def shuffled(recording: Recording) -> Recording:
    """Commands of another run beside each run's poses."""
    commands = [track.command for track in recording.tracks]
    others = [*commands[1:], commands[0]]
    tracks = [replace(track, command=command) for track, command in zip(recording.tracks, others, strict=True)]
    return replace(recording, tracks=tuple(tracks))


DEGREES = 180 / np.pi
MISTAKES: dict[str, Edit] = {
    "positions in m": scaled(0.001),
    "positions in cm": scaled(0.1),
    "positions in inches": scaled(1 / 25.4),
    "positions in feet": scaled(1 / 304.8),
    "positions in tenths of a mm": scaled(10),
    "positions in µm": scaled(1000),
    "positions in px, 0.62 a mm": scaled(0.62),
    "positions in px, 0.47 a mm": scaled(0.47),
    "positions in px, 1.9 a mm": scaled(1.9),
    "headings in degrees": in_unit(DEGREES),
    "headings in degrees from 0 to 360": posed(lambda pose: np.column_stack([pose[:, :2], pose[:, 2] * DEGREES % 360])),
    "headings in turns": in_unit(1 / (2 * np.pi)),
    "headings in degrees, clockwise": both(headed(-1), in_unit(DEGREES)),
    "headings clockwise": headed(-1),
    "headings of a compass": headed(-1, np.pi / 2),
    "headings of a compass in degrees": both(headed(-1, np.pi / 2), in_unit(DEGREES)),
    "markers turned by 90°": headed(1, np.pi / 2),
    "markers turned by −90°": headed(1, -np.pi / 2),
    "markers turned by 180°": headed(1, np.pi),
    "y downwards": mirrored_y,
    "y negative": posed(lambda pose: pose * [1, -1, 1]),
    "y downwards, headings too": both(mirrored_y, headed(-1)),
    "x to the left": mirrored_x,
    "x and y exchanged": posed(lambda pose: pose[:, [1, 0, 2]]),
    "x and y exchanged, headings too": both(posed(lambda pose: pose[:, [1, 0, 2]]), headed(-1, np.pi / 2)),
    "counted from another origin": from_the_middle,
    "no commands, 0 written": commanded(np.zeros_like),
    "commands in percent": shares_of_limits(100),
    "commands as shares": shares_of_limits(1),
    "commands as bytes around 127": shares_of_limits(127),
    "commands negated": commanded(np.negative),
    "first and second command exchanged": commanded(lambda command: np.hstack([command[:, 1::-1], command[:, 2:]])),
    "last command a copy of the first": commanded(lambda command: np.column_stack([command[:, :-1], command[:, 0]])),
    "first command missing, 0 written": with_column(0, lambda values: values * 0),
    "second command missing, 0 written": with_column(1, lambda values: values * 0),
    "first command in another unit": with_column(0, lambda values: values / 1000),
    "second command in another unit": with_column(1, lambda values: values * DEGREES),
    "second command a thousandth": with_column(1, lambda values: values / 1000),
    "second command negated": with_column(1, np.negative),
    "commands of another run": shuffled,
    "commands in reverse order": commanded(lambda command: command[::-1]),
    "times in ms": timed(lambda time_s: time_s * 1e3),
    "times in µs": timed(lambda time_s: time_s * 1e6),
    "times in minutes": timed(lambda time_s: time_s / 60),
    "times in hours": timed(lambda time_s: time_s / 3600),
    "numbers of rows as times": timed(lambda time_s: np.arange(len(time_s)) + 1000.0 * round(time_s[0])),
    "twice the period": timed(lambda time_s: time_s * 2),
    "a third of the period": timed(lambda time_s: time_s / 3),
    "commands one row late": late(1),
    "commands two rows late": late(2),
    "commands three rows late": late(3),
    "commands one row early": late(-1),
    "commands two rows early": late(-2),
    "commands three rows early": late(-3),
    "camera frozen": frozen_for(0),
    "camera frozen after a third": frozen_for(0.33),
    "camera at half the rate": posed(lambda pose: pose[np.arange(len(pose)) // 2 * 2]),
    "heading frozen": posed(lambda pose: pose * [1, 1, 0]),
    "x frozen": posed(lambda pose: pose * [0, 1, 1] + [300, 0, 0]),
    "y a copy of x": posed(lambda pose: pose[:, [0, 0, 2]]),
    "metres and degrees": both(scaled(0.001), in_unit(DEGREES)),
    "cm and a compass": both(scaled(0.1), headed(-1, np.pi / 2)),
    "px and y downwards, headings too": both(mirrored_y, headed(-1), scaled(0.62)),
    "degrees and y downwards": both(mirrored_y, in_unit(DEGREES)),
    "metres and milliseconds": both(scaled(0.001), timed(lambda time_s: time_s * 1e3)),
    "inches, commands as shares": both(scaled(1 / 25.4), shares_of_limits(1)),
    "clockwise, one row late": both(headed(-1), late(1)),
}


class Judged(NamedTuple):
    """A recording to be judged, and what it is."""

    about: str
    recording: Recording


def mistaken(mode: str = "uniform") -> Iterator[Judged]:
    """Yield every mistake with every robot."""
    for robot in ROBOTS:
        for mistake, edit in MISTAKES.items():
            yield Judged(f"{robot}: {mistake}", edit(sound(robot, mode, seed=2)))


def unwrapped(recording: Recording) -> Recording:
    """Headings that count turns."""
    return posed(lambda pose: np.column_stack([pose[:, :2], np.unwrap(pose[:, 2])]))(recording)


def moved_arena(recording: Recording) -> Recording:
    """An arena whose frame begins elsewhere, and that is half as long again."""
    arena = recording.header.arena_mm
    larger = {"x": (arena.x[0] - 3000, arena.x[1] * 1.5 - 3000), "y": (arena.y[0] + 500, arena.y[1] * 1.5 + 500)}
    moved = posed(lambda pose: pose + np.array([-3000, 500, 0]))(recording)
    return replace(moved, header=recording.header.model_copy(update={"arena_mm": Arena(**larger)}))


def with_gaps(recording: Recording) -> Recording:
    """Of each track a fifth of the rows are missing."""
    rng = np.random.default_rng(SEED)

    def thinned(track: Track) -> Track:
        kept = rng.random(len(track)) > 0.2
        return replace(track, time_s=track.time_s[kept], command=track.command[kept], pose=track.pose[kept])

    return tracked(thinned)(recording)


def parked(recording: Recording) -> Recording:
    """After its drive each vehicle stands for twice as long, seen by a camera that is free of noise."""

    longest_s = max(track.time_s[-1] - track.time_s[0] for track in recording.tracks) + recording.robot.period_s

    def stands(track: Track) -> Track:
        count, period_s = 2 * len(track), recording.robot.period_s
        time_s = track.time_s[-1] + period_s * np.arange(1, count + 1)
        return replace(
            track,
            time_s=np.append(track.time_s, time_s) + 2 * longest_s * recording.runs.index(track.run),
            command=np.vstack([track.command, np.zeros((count, track.command.shape[1]))]),
            pose=np.vstack([track.pose, np.tile(track.pose[-1], (count, 1))]),
        )

    return tracked(stands)(recording)


def in_whole_mm(recording: Recording) -> Recording:
    return posed(lambda pose: np.column_stack([pose[:, :2].round(), pose[:, 2].round(2)]))(recording)


def late_clock(recording: Recording) -> Recording:
    """Times from a computer that has run for days, with jitter."""
    rng = np.random.default_rng(SEED)
    period_s = recording.robot.period_s
    return timed(lambda time_s: time_s + 4e5 + rng.uniform(-0.05, 0.05, len(time_s)) * period_s)(recording)


def noisy(recording: Recording) -> Recording:
    rng = np.random.default_rng(SEED)
    return posed(lambda pose: pose + rng.normal(0, [2, 2, 0.02], pose.shape))(recording)


def in_larger_arena(recording: Recording) -> Recording:
    arena = recording.header.arena_mm
    larger = Arena(x=(arena.x[0], arena.x[1] * 1.2), y=(arena.y[0], arena.y[1] * 1.2))
    return replace(recording, header=recording.header.model_copy(update={"arena_mm": larger}))


ODDITIES: dict[str, Edit] = {
    "as it is": lambda recording: recording,
    "headings that count turns": unwrapped,
    "another arena": moved_arena,
    "gaps": with_gaps,
    "parked afterwards": parked,
    "whole millimetres": in_whole_mm,
    "a clock far from 0 that jitters": late_clock,
    "one run alone": lambda recording: recording.where(lambda track: track.run == recording.runs[0]),
    "a camera that errs by 2 mm": noisy,
    "markers turned by 8°": headed(1, 0.14),
    "a scale wrong by 5 %": scaled(1.05),
    "an arena stated too large": in_larger_arena,
    "commands in tens": commanded(lambda command: np.where(np.abs(command) > 10, command.round(-1), command)),
}


def played(robot: str, kind: str) -> Recording:
    """A drive of one kind of command all the time, such as an operator may play."""
    rng = np.random.default_rng([SEED, len(kind)])
    of = ROBOTS[robot]
    drive = rng.uniform(of.command_low, of.command_high, (360, len(of.command_columns)))
    if robot == "mgr":
        one = drive[:, :1]
        drive = {
            "straight": np.hstack([one, one]),
            "on the spot": np.hstack([one, -one]),
            "backwards": -np.abs(drive),
            "slow": drive * 0.25,
            "few values": np.round(drive / 60) * 60,
            "one command": np.tile([40.0, 60.0], (360, 1)),
            "forwards": np.abs(drive),
            "left turns": np.sort(drive, axis=1),
        }[kind]
    else:
        full = drive.copy()
        full[:, 1:] = of.command_high[1:]
        drive = {
            "straight": drive * [0, 1, 1],
            "on the spot": full * [1, 0.5, 1],
            "backwards": np.column_stack([np.abs(drive[:, 0]), drive[:, 1:]]),
            "slow": np.column_stack([drive[:, 0], drive[:, 1] * 0.4, drive[:, 2]]),
            "few values": np.column_stack([np.round(drive[:, 0] / 40) * 39, drive[:, 1:].round(-1).clip(3, 9)]),
            "one command": np.tile([20.0, 40.0, 6.0], (360, 1)),
            "forwards": drive * [0.3, 1, 1] + [0, 0, 0],
            "left turns": full * [-1, 1, 1],
        }[kind]
    return record(StandInSession(of, ("1",), 3, 120, 5, drive=drive.clip(of.command_low, of.command_high)))[1]


def clear(robot: str, name: str, sizes: tuple[float, float]) -> Recording:
    """A session with an effect a little nearer to its largest than to its smallest size, on a logarithmic scale."""
    case = Case(family="formulas", kind="one", robot=robot, names=(name,), rises_percent=(30.0,), seed=SEED)
    vehicles = ("1", "2") if name == "neighbour_interaction" else ("1",)
    session = StandInSession(ROBOTS[robot], vehicles, 6 // len(vehicles), 40, SEED, lost_poses=0.001)
    size = float(np.exp(0.4 * np.log(sizes[0]) + 0.6 * np.log(sizes[1])))
    effects = made_effects((sized_entry(name, size, case, session),), session)
    return record(replace(session, effects=effects))[1]


PLAYED = ("straight", "on the spot", "backwards", "slow", "few values", "one command", "forwards", "left turns")


def unusual() -> Iterator[Judged]:
    """Yield sound recordings of all kinds, those with clear effects of the catalogue included."""
    number = 0
    for robot in ROBOTS:
        for mode, lost, vehicles in (("uniform", 0.3, 1), ("gentle", 0.0, 3), ("held", 0.05, 2), ("waypoints", 0.0, 1)):
            for oddity, edit in ODDITIES.items():
                number += 1
                about = f"{robot}: {mode}, {vehicles} vehicles, {lost:.0%} unseen, {oddity}"
                yield Judged(about, edit(sound(robot, mode, 10 + number % 3, vehicles, lost)))
    for robot in ("mgr", "mur"):
        for kind in PLAYED:
            yield Judged(f"{robot}: {kind}", played(robot, kind))
        for name, sizes in CATALOGUE.items():
            if robot in sizes:
                yield Judged(f"{robot}: a clear {name}", clear(robot, name, sizes[robot]))
