"""A session: runs of one or more stand-in vehicles, driven and measured, with what only the stand-in knows of them."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from swarmtwin.errors import UserError, near_miss
from swarmtwin.geometry import wrap_angle
from swarmtwin.robot import Robot
from swarmtwin.standin.active_effects import ActiveEffects
from swarmtwin.standin.character import CharacterName
from swarmtwin.standin.drive_commands import CommandMode, Operator
from swarmtwin.standin.effect import Effect
from swarmtwin.standin.physics import STAND_INS, Period, Physics, advance
from swarmtwin.standin.streams import Streams


@dataclass(frozen=True)
class StandInSession:
    """What is to be recorded.

    Attributes:
        robot: the robot; one that has a stand-in.
        vehicles: ids of the V vehicles that drive in every run, together.
        runs: number of runs R. Fewer runs of the same session are its first ones.
        steps: transitions T in a run.
        seed: all randomness comes from it, except the vehicles' fabrication, which comes from their ids.
        effects: what the stand-in is told to do.
        command_mode: how the operator chooses commands.
        drive: (N, m) commands to play instead, or None.
        lost_poses: probability that the camera misses a marker.
        planned_runs: runs after which the session ends by plan (ageing counts on it); None means `runs`.
        operator: how the operator drives.
        pause_s: from the nominal end of a run to the beginning of the next.
        character: how unruly the vehicles are at all times, effects or not.
        starts_s: what the recording's clock shows when the session begins.
        repeats: how many times over the whole session is driven side by side, each with its own chances.
    """

    robot: Robot
    vehicles: tuple[str, ...]
    runs: int
    steps: int
    seed: int
    effects: Sequence[Effect] = ()
    command_mode: CommandMode = "uniform"
    drive: np.ndarray | None = None
    lost_poses: float = 0.0
    planned_runs: int | None = None
    operator: Operator = field(default_factory=Operator)
    pause_s: float = 5.0
    character: CharacterName = "regular"
    starts_s: float = 0.0
    repeats: int = 1
    conditions: ActiveEffects = field(init=False, repr=False)

    def __post_init__(self) -> None:
        character = None
        if self.character == "unruly":
            character = STAND_INS.plugin_class(self.robot.name).unruly
        object.__setattr__(self, "conditions", ActiveEffects(self.robot, self.effects, character))

    def physics(self, vehicles: Sequence[str], dtype: type = np.float64) -> Physics:
        """Return the physics of some vehicles under this session's conditions."""
        return STAND_INS.plugin_class(self.robot.name).of(vehicles, self.conditions, dtype)

    @property
    def shape(self) -> tuple[int, int, int]:
        """R, T and V of what it yields, all repeats counted."""
        return self.runs * self.repeats, self.steps, len(self.vehicles)

    @property
    def run_length_s(self) -> float:
        """From the beginning of a run to the beginning of the next, nominally."""
        return self.steps * self.robot.period_s + self.pause_s

    @property
    def length_s(self) -> float:
        """Planned length of the whole session."""
        return (self.planned_runs or self.runs) * self.run_length_s

    def progress(self, time_s: np.ndarray) -> np.ndarray:
        """Return the share of the session that has passed, in [0, 1]."""
        return np.clip((time_s - self.starts_s) / self.length_s, 0.0, 1.0)


@dataclass(frozen=True)
class DrivenSession:
    """What a session yields. R runs, T periods, V vehicles.

    Attributes:
        session: what was recorded.
        time_s: (R, T + 1) as the recording's clock shows it.
        command: (R, T, V, m) as sent.
        pose: (R, T + 1, V, 3) as the camera measured it, heading in (−π, π]; NaN where it saw no marker.
        active_command: (m, R, T + 1, V) that really held before each row: what a lost or late command leaves in force.
        state: (states, R, T + 1, V) true physical states.
    """

    session: StandInSession
    time_s: np.ndarray
    command: np.ndarray
    pose: np.ndarray
    active_command: np.ndarray
    state: np.ndarray

    @property
    def duration_s(self) -> np.ndarray:
        """True lengths (R, T) of the periods, which a clock that goes wrong does not show."""
        lengths: np.ndarray = np.diff(self.time_s)
        return lengths / self.session.conditions.clock_rate(self.session.progress(self.time_s[:, :-1]))

    def first_runs(self, runs: int) -> "DrivenSession":
        """Return the first runs alone."""
        return DrivenSession(
            replace(self.session, runs=runs, planned_runs=self.session.planned_runs or self.session.runs),
            self.time_s[:runs],
            self.command[:runs],
            self.pose[:runs],
            self.active_command[:, :runs],
            self.state[:, :runs],
        )


def require_stand_in(robot: Robot) -> None:
    """Refuse a robot without a stand-in.

    Raises:
        UserError: there is none, naming those that have one, or it is driven by other commands.
    """
    if robot.name not in STAND_INS.names():
        raise UserError(f"robot {robot.name!r} has no stand-in: {near_miss(robot.name, STAND_INS.names())}")
    columns = STAND_INS.plugin_class(robot.name).command_columns
    if robot.command_columns != columns:
        raise UserError(
            f"the stand-in of robot {robot.name!r} is driven by {', '.join(columns)}, "
            f"not by {', '.join(robot.command_columns)}: use conf/robot/{robot.name}.yaml, robot={robot.name}"
        )


def drive_session(session: StandInSession, purpose: str = "session") -> DrivenSession:
    """Drive all runs of a session side by side; `purpose` tells apart sessions that share a seed."""
    streams = Streams(session.seed, purpose)
    physics = session.physics(session.vehicles)
    shape = session.shape
    operator = session.operator
    plan = operator.plan(session.robot, shape, session.command_mode, played_commands(session), streams)
    time_s, duration_s = draw_clock(session, streams)
    noise_shape = (*shape[:2], physics.substeps, physics.noises, shape[2])
    noise = streams.of("motion").standard_normal(noise_shape, np.float32)
    character = session.conditions.character
    tail = character.heavy_tail(character.motion_freedom, shape, streams, "motion's tail")
    noise *= tail.astype(np.float32)[:, :, None, None]
    chance = streams.of("link").random(shape)

    state = physics.at_rest(np.moveaxis(plan.start, -1, 0))
    active = np.empty((len(session.robot.command), *state.shape[1:]))
    active[:] = np.reshape(physics.resting_command, (-1, 1, 1))
    states, actives, sent, lost = [state], [active], [], None
    for step in range(session.steps):
        command = operator.steer(session.robot, physics, np.moveaxis(state[:3], 0, -1), plan, step)
        lost = session.conditions.lost(chance[:, step], lost)
        arriving = np.where(lost, active, np.moveaxis(command, -1, 0))
        progress = session.progress(time_s[:, step, None])
        period = Period(arriving, active, duration_s[:, step, None], progress)
        state = advance(physics, state, period, noise[:, step].transpose(1, 2, 0, 3))
        active = arriving
        states.append(state)
        actives.append(active)
        sent.append(command)
    true = np.stack(states, axis=2)
    shown = session.progress(time_s)[:, :, None]
    pose = measured_poses(session, physics, np.moveaxis(true[:3], 0, -1), streams, shown)
    return DrivenSession(session, time_s, np.stack(sent, axis=1), pose, np.stack(actives, axis=2), true)


def measured_poses(
    session: StandInSession, physics: Physics, pose: np.ndarray, streams: Streams, progress: np.ndarray | float = 0.0
) -> np.ndarray:
    """Return true poses (..., V, 3) as the camera measures them: scaled, noisy, some not at all.

    Args:
        session: what is recorded.
        physics: of its vehicles.
        pose: (..., V, 3), such as (R, T + 1, V, 3).
        streams: of the camera's noise.
        progress: share of the session that has passed, broadcasting to (..., V).
    """
    noise = streams.of("camera").standard_normal(pose.shape)
    character = session.conditions.character
    noise *= character.heavy_tail(character.camera_freedom, pose.shape[:-1], streams, "camera's tail")[..., None]
    size = np.array([physics.position_noise_mm, physics.position_noise_mm, physics.heading_noise_rad])
    measured = physics.seen(pose, progress) + size * noise
    measured[..., 2] = wrap_angle(measured[..., 2])
    missed = streams.of("lost poses").random(pose.shape[:-1]) < session.lost_poses
    measured[missed] = np.nan
    return measured


def draw_clock(session: StandInSession, streams: Streams) -> tuple[np.ndarray, np.ndarray]:
    """Return when rows are taken (R, T + 1) and how long periods last (R, T), in s."""
    run_count, step_count, _ = session.shape
    nominal = np.full((run_count, step_count), session.robot.period_s)
    shown_s = session.conditions.durations(nominal, streams.of("clock"))
    since_start = np.concatenate([np.zeros((run_count, 1)), np.cumsum(shown_s, axis=1)], axis=1)
    run_start_s = _run_starts(session, since_start[:, -1].reshape(session.repeats, session.runs))
    time_s = session.starts_s + run_start_s.reshape(-1, 1) + since_start
    return time_s, shown_s / session.conditions.clock_rate(session.progress(time_s[:, :-1]))


def _run_starts(session: StandInSession, length_s: np.ndarray) -> np.ndarray:
    """Return when runs of lengths (repeats, R) begin, in s: as planned, or a period after a run that ended late."""
    start_s = np.tile(np.arange(session.runs) * session.run_length_s, (session.repeats, 1))
    for run in range(1, session.runs):
        earliest_s = start_s[:, run - 1] + length_s[:, run - 1] + session.robot.period_s
        start_s[:, run] = np.maximum(start_s[:, run], earliest_s)
    return start_s


def played_commands(session: StandInSession) -> np.ndarray | None:
    """Return the drive cut into runs (R, T, m), from its beginning again at its end; None if the operator drives."""
    if session.drive is None:
        return None
    rows = np.arange(session.runs * session.steps) % len(session.drive)
    played = session.drive[rows].reshape(session.runs, session.steps, -1)
    return np.tile(played, (session.repeats, 1, 1))
