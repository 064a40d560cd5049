"""The recording of a case, and what only its stand-in knows: its clean twin, and the least error there can be."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from swarmtwin.geometry import orientation_error_rad, position_error_mm, wrap_angle
from swarmtwin.recordings.recording import Recording, Track
from swarmtwin.recordings.writing import HEADING_DECIMALS, POSITION_DECIMALS
from swarmtwin.robot import Robot
from swarmtwin.standin.effect import Effect
from swarmtwin.standin.effects import parse_effects
from swarmtwin.standin.exact_means import mean_given_state
from swarmtwin.standin.session import DrivenSession, StandInSession
from swarmtwin.studies.hidden_effects.cases import Case
from swarmtwin.studies.hidden_effects.outside_catalogue import OUTSIDE
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
        step = [
            int(np.argmin(np.abs(self.footage.time_s[run] - time_s)))
            for run, time_s in zip(transitions.run, transitions.time_s, strict=True)
        ]
        vehicles = np.array([self.footage.session.vehicles.index(vehicle) for vehicle in transitions.vehicles])
        expected: np.ndarray = mean_given_state(self.footage)
        return expected[transitions.run, step, vehicles[transitions.vehicle]].astype(float)


@dataclass(frozen=True)
class MeanErrors:
    """Mean one-step errors over some transitions."""

    position_mm: float
    orientation_deg: float

    @classmethod
    def of(cls, predicted: np.ndarray, measured: np.ndarray) -> "MeanErrors":
        """Compare displacements (N, 3)."""
        return cls(
            float(position_error_mm(predicted, measured).mean()),
            float(np.rad2deg(orientation_error_rad(predicted, measured)).mean()),
        )

    def rise_percent(self, clean: "MeanErrors") -> float:
        """Return by how much these errors are larger than those of the clean twin: the larger of both rises."""
        position = self.position_mm / clean.position_mm
        orientation = self.orientation_deg / clean.orientation_deg
        return 100.0 * (max(position, orientation) - 1.0)


def effects_of(case: Case, robot: Robot) -> tuple[Effect, ...]:
    """Return the effects that a case hides."""
    if case.kind != "outside":
        return parse_effects(case.effects, robot, len(case.vehicles))
    return tuple(
        OUTSIDE[effect["name"]].parse({key: value for key, value in effect.items() if key != "name"}, effect["name"])
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
    kind: Any = {"kind": "clean", "variety": "plain", "effects": ()}
    return _filmed(Case(robot=robot.name, runs=runs, steps=steps, seed=seed, **kind), robot, ())


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

    def blurred(track: Track) -> Track:
        pose = track.pose + size * rng.standard_normal(track.pose.shape)
        pose[:, :2] = pose[:, :2].round(POSITION_DECIMALS)
        pose[:, 2] = wrap_angle(pose[:, 2]).round(HEADING_DECIMALS)
        return replace(track, pose=pose)

    return replace(recording, tracks=tuple(blurred(track) for track in recording.tracks))
