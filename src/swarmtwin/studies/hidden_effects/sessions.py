"""The recording of a case, and what only its stand-in knows: its clean twin, and the least error there can be."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from swarmtwin.geometry import wrap_angle
from swarmtwin.recordings.recording import Recording
from swarmtwin.recordings.writing import HEADING_DECIMALS, POSITION_DECIMALS
from swarmtwin.robot import Robot
from swarmtwin.standin.effect import Effect
from swarmtwin.standin.effects import parse_effects
from swarmtwin.standin.exact_means import mean_given_state
from swarmtwin.standin.session import DrivenSession, StandInSession
from swarmtwin.studies.hidden_effects.cases import Case
from swarmtwin.studies.hidden_effects.outside_effects import EFFECTS
from swarmtwin.studies.stand_in_recording import record
from swarmtwin.transitions import Transitions, from_recording


@dataclass(frozen=True)
class HiddenSession:
    """A case's session, in which the camera misses one pose in a thousand.

    Attributes:
        footage: with all that the stand-in knows.
        recording: what a laboratory would have.
        transitions: of the recording.
    """

    footage: DrivenSession
    recording: Recording
    transitions: Transitions

    def least_displacement(self, transitions: Transitions) -> np.ndarray:
        """Return the exact mean displacements (N, 3) of transitions of this recording, given the true states."""
        away_s = np.abs(self.footage.time_s[transitions.run] - transitions.time_s[:, None])
        vehicles = np.array([self.footage.session.vehicles.index(vehicle) for vehicle in transitions.vehicles])
        expected: np.ndarray = mean_given_state(self.footage)
        return expected[transitions.run, away_s.argmin(axis=1), vehicles[transitions.vehicle]].astype(float)


def effects_of(case: Case, robot: Robot) -> tuple[Effect, ...]:
    """Return the effects that a case hides."""
    if case.kind != "outside":
        return parse_effects(case.effects, robot, len(case.vehicles))
    return tuple(
        EFFECTS[effect["name"]].parse({key: value for key, value in effect.items() if key != "name"}, effect["name"])
        for effect in case.effects
    )


def measure(case: Case, robot: Robot) -> HiddenSession:
    """Drive and film a case."""
    return _filmed(case, robot, effects_of(case, robot))


def clean_twin(case: Case, robot: Robot) -> HiddenSession:
    """Drive the same session again, with the same chances, but with nothing hidden in it."""
    return _filmed(case, robot, ())


def reference_session(robot: Robot, runs: int, steps: int, seed: int) -> HiddenSession:
    """Drive vehicle 1 as it was when the simulation was learned."""
    case = Case(kind="clean", variety="plain", robot=robot.name, effects=(), runs=runs, steps=steps, seed=seed)
    return clean_twin(case, robot)


def _filmed(case: Case, robot: Robot, effects: Sequence[Effect]) -> HiddenSession:
    session = StandInSession(
        robot=robot,
        vehicles=case.vehicles,
        runs=case.runs,
        steps=case.steps,
        seed=case.seed,
        effects=effects,
        command_mode=case.manner,
        lost_poses=0.001,
    )
    footage, recording = record(session)
    if case.pose_noise > 1.0:
        recording = _blurred(recording, footage, case)
    transitions, _ = from_recording(recording)
    return HiddenSession(footage, recording, transitions)


def _blurred(recording: Recording, footage: DrivenSession, case: Case) -> Recording:
    """Add to the camera's noise until it is `case.pose_noise` times as large."""
    physics = footage.session.physics(case.vehicles)
    usual = np.array([physics.position_noise_mm, physics.position_noise_mm, physics.heading_noise_rad])
    size = usual * np.sqrt(case.pose_noise**2 - 1.0)
    rng = np.random.default_rng([case.seed, 1])
    tracks = []
    for track in recording.tracks:
        pose = track.pose + size * rng.standard_normal(track.pose.shape)
        pose[:, :2] = pose[:, :2].round(POSITION_DECIMALS)
        pose[:, 2] = wrap_angle(pose[:, 2]).round(HEADING_DECIMALS)
        tracks.append(replace(track, pose=pose))
    return replace(recording, tracks=tuple(tracks))
