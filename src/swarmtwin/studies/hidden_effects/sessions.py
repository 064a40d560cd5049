"""The recordings of a case, and what only its stand-in knows: what hides, its clean twin, the least error there is."""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from swarmtwin.configuration import config_folder
from swarmtwin.recordings.blocks import run_of
from swarmtwin.recordings.joining import joined
from swarmtwin.recordings.recording import Recording
from swarmtwin.robot import Robot
from swarmtwin.standin.active_effects import ActiveEffects
from swarmtwin.standin.effect import Effect
from swarmtwin.standin.exact_means import mean_given_state
from swarmtwin.standin.session import DrivenSession, StandInSession
from swarmtwin.studies.hidden_effects.cases import Case
from swarmtwin.studies.hidden_effects.clean_sessions import CleanSession, blurred, clean_session
from swarmtwin.studies.hidden_effects.effect_sizes import Draw
from swarmtwin.studies.hidden_effects.error_rise import PlainSimulation, rise_percent, size_that_raises
from swarmtwin.studies.hidden_effects.hideable_effects import drawn_parameters, made_effects, sizes_of
from swarmtwin.studies.stand_in_families import Family, driver_of, session_options
from swarmtwin.studies.stand_in_recording import record
from swarmtwin.transitions import Transitions, from_recording


@dataclass(frozen=True)
class FilmedSession:
    """A session, driven and filmed.

    Attributes:
        family: whose physics moved the vehicles.
        footage: with all that the stand-in knows.
        recording: what a laboratory would have.
        transitions: of the recording.
    """

    family: Family
    footage: DrivenSession
    recording: Recording
    transitions: Transitions

    def least_displacement(self, transitions: Transitions) -> np.ndarray | None:
        """Return the exact mean displacements (N, 3) of transitions of this recording, given the true states.

        Its long runs may have been cut into blocks. None where an engine moved the vehicles: only formulas tell them.
        """
        if self.family == "rigid_body":
            return None
        runs = np.array([self.transitions.runs.index(run_of(name)) for name in transitions.runs])[transitions.run]
        away_s = np.abs(self.footage.time_s[runs] - transitions.time_s[:, None])
        vehicles = np.array([self.footage.session.vehicles.index(vehicle) for vehicle in transitions.vehicles])
        expected: np.ndarray = mean_given_state(self.footage)
        return expected[runs, away_s.argmin(axis=1), vehicles[transitions.vehicle]].astype(float)


@dataclass(frozen=True)
class Truth:
    """What a diagnosis is judged by, and never sees.

    Attributes:
        case: what was asked for.
        effects: what is hidden, as `record` takes it: names and parameters.
        rise_percent: by how much all of them together raise the one-step error of a simulation that learned the
            reference, position or orientation, whichever more, over that of the same session without them; 0 where
            nothing is hidden.
        same_vehicle: whether the vehicle is the one that the reference was recorded of.
        measured: the session, with all that the stand-in knows.
        twin: the same session with the same chances and nothing hidden in it.
    """

    case: Case
    effects: tuple[dict[str, Any], ...]
    rise_percent: float
    same_vehicle: bool
    measured: FilmedSession
    twin: FilmedSession

    @cached_property
    def causes(self) -> dict[str, dict[str, float]]:
        """The causes that are to be named, by whoever names none of the camera: see `causes_beside`."""
        return self.causes_beside(())

    def causes_beside(self, named: Collection[str]) -> dict[str, dict[str, float]]:
        """Return the causes that are to be named, with their parameters; none where the catalogue has no name.

        What acts by another law than its mechanism has no parameters of it.

        A clock that is never steady shows its usual spread and what was hidden together; where a patch is, is told as
        the camera shows it, but for what is `named` as wrong with the camera, which is taken out of what it shows.
        """
        if self.case.kind in ("outside", "misspecified"):
            return {name: {} for name in self.case.true_names}
        causes = {effect["name"]: {key: one for key, one in effect.items() if key != "name"} for effect in self.effects}
        if "timing_jitter" in causes:
            usual = self.measured.footage.session.conditions.character.jitter
            causes["timing_jitter"]["spread"] = math.hypot(causes["timing_jitter"]["spread"], usual)
        if "surface_patch" in causes:
            session = self.measured.footage.session
            unknown = tuple(effect for effect in self.effects if effect["name"] not in named)
            camera = replace(session, effects=made_effects(unknown, session))
            causes["surface_patch"] |= as_seen(causes["surface_patch"], camera)
        return causes


def as_seen(patch: Mapping[str, float], session: StandInSession, points: int = 32) -> dict[str, float]:
    """Return where a patch of the floor is, as a session's camera shows it, with the mean distance of its edge."""
    shown = [effect for effect in session.effects if type(effect).magnification is not Effect.magnification]
    centre, angle = np.array([patch["x_mm"], patch["y_mm"]]), np.linspace(0, 2 * np.pi, points, endpoint=False)
    edge = centre + patch["radius_mm"] * np.column_stack([np.cos(angle), np.sin(angle)])
    places = np.column_stack([np.vstack([centre, edge]), np.zeros(1 + points)])
    seen = ActiveEffects(session.robot, shown).seen(places)[:, :2]
    radius_mm = float(np.linalg.norm(seen[1:] - seen[0], axis=1).mean())
    return {"x_mm": float(seen[0, 0]), "y_mm": float(seen[0, 1]), "radius_mm": radius_mm}


class RecordedSession(NamedTuple):
    """All of a case: the recording that the simulation is learned from, the one in question, and the truth about it."""

    reference: Recording
    measured: Recording
    truth: Truth


def record_session(case: Case) -> RecordedSession:
    """Record a case, the same each time: its reference, and the session that something may hide in."""
    robot = robot_of(case)
    reference = _film_reference(case, robot)
    plan = measured_session(case, robot)
    twin = _film(plan, robot, case)
    if not case.names:
        truth = Truth(case, (), 0.0, is_of_known_vehicle(case), twin, twin)
        return RecordedSession(reference.recording, twin.recording, truth)
    simulation = PlainSimulation.learn(reference.transitions)
    effects, measured = _film_with_effects(plan, robot, case, simulation)
    rise = rise_percent(simulation.error(measured.transitions), simulation.error(twin.transitions))
    truth = Truth(case, effects, rise, is_of_known_vehicle(case), measured, twin)
    return RecordedSession(reference.recording, measured.recording, truth)


def robot_of(case: Case) -> Robot:
    """Return the robot of a case, as its file describes it."""
    return Robot.load(config_folder() / "robot" / f"{case.robot}.yaml")


def is_of_known_vehicle(case: Case) -> bool:
    """Return whether the vehicle that is measured is the one, or the first one, that the reference is recorded of."""
    robot = robot_of(case)
    return reference_session(case, robot).vehicles[0] == measured_session(case, robot).session.vehicles[0]


def _film_reference(case: Case, robot: Robot) -> FilmedSession:
    """Drive and film what the simulation is learned from; of several vehicles each drives as many of the runs."""
    whole = reference_session(case, robot)
    if case.reference_vehicles == 1:
        return _film(CleanSession(whole), robot, case)
    rng = case.rng("further vehicles of the reference")
    taken = {*whole.vehicles, *measured_session(case, robot).session.vehicles}
    further = [str(number) for number in rng.permutation(np.arange(1, 10)) if str(number) not in taken]
    vehicles = (*whole.vehicles, *further[: case.reference_vehicles - 1])
    share = replace(whole, runs=max(1, whole.runs // len(vehicles)))
    seeds = [whole.seed, *(int(seed) for seed in rng.integers(2**31, size=len(vehicles) - 1))]
    filmed = [
        _film(CleanSession(replace(share, vehicles=(vehicle,), seed=seed)), robot, case)
        for vehicle, seed in zip(vehicles, seeds, strict=True)
    ]
    recording = joined(
        {Path(f"vehicle_{vehicle}"): one.recording for vehicle, one in zip(vehicles, filmed, strict=True)}
    )
    return replace(filmed[0], recording=recording, transitions=from_recording(recording)[0])


def reference_session(case: Case, robot: Robot) -> StandInSession:
    """Return what the simulation is learned from, were it of one vehicle: any unit of the robot, with nothing wrong."""
    rng = case.rng("reference")
    unit, seed = str(rng.integers(1, 10)), int(rng.integers(2**31))
    return _usual(case, robot, (unit,), case.reference_runs, seed)


def _usual(case: Case, robot: Robot, vehicles: tuple[str, ...], runs: int, seed: int) -> StandInSession:
    options = session_options(case.family)
    return StandInSession(robot, vehicles, runs, case.steps, seed, lost_poses=0.001, **options)


def measured_session(case: Case, robot: Robot, same_vehicle: float = 0.6) -> CleanSession:
    """Return what is measured, without what hides in it: of the reference's vehicle, or else another."""
    rng = case.rng("measured")
    unit = reference_session(case, robot).vehicles[0]
    others = [str(number) for number in rng.permutation(np.arange(1, 10)) if str(number) != unit]
    seed = int(rng.integers(2**31))
    vehicles: tuple[str, ...] = (unit,) if rng.random() < same_vehicle else (others[0],)
    if case.kind == "clean":
        if case.variety == "other_vehicle":
            vehicles = (others[0],)
        return clean_session(case.variety, _usual(case, robot, vehicles, case.runs, seed), rng)
    if "neighbour_interaction" in case.true_names:
        vehicles = (*vehicles, others[1])
    return CleanSession(_usual(case, robot, vehicles, max(8, case.runs // len(vehicles)), seed))


def _film_with_effects(
    plan: CleanSession, robot: Robot, case: Case, simulation: PlainSimulation
) -> tuple[tuple[dict[str, Any], ...], FilmedSession]:
    """Drive and film a session with the effects of a case, each as large as asked for; return them and what was filmed.

    Where they make the rigid body unstable, each raises the error by half as much, and is half as large at most.
    """
    share = 1.0
    while True:
        effects = _sized_effects(case, plan.session, simulation, share)
        session = replace(plan.session, effects=made_effects(effects, plan.session))
        try:
            return effects, _film(CleanSession(session), robot, case)
        except ArithmeticError:
            share /= 2
            if share < 0.1:
                raise


def _sized_effects(
    case: Case, session: StandInSession, simulation: PlainSimulation, share: float
) -> tuple[dict[str, Any], ...]:
    """Return the effects of a case, each so large that alone it raises the error by that share of what is asked for."""
    return tuple(
        sized_effect(name, share * rise, case, session, simulation, share)
        for name, rise in zip(case.names, case.rises_percent, strict=True)
    )


def sized_effect(
    name: str,
    wanted_percent: float,
    case: Case,
    session: StandInSession,
    simulation: PlainSimulation,
    largest: float = 1.0,
    runs: int = 30,
) -> dict[str, Any]:
    """Return one effect, whose size is found on a shorter session of its own, at most a share of the largest one."""
    trial = replace(session, runs=min(runs, session.runs), seed=int(case.rng("trial").integers(2**31)))
    drive = driver_of(case.family)
    usual = simulation.error(from_recording(record(trial, drive=drive)[1])[0])

    def rise(size: float) -> float:
        hidden = made_effects((sized_entry(name, size, case, trial),), trial)
        try:
            transitions, _ = from_recording(record(replace(trial, effects=hidden), drive=drive)[1])
        except ArithmeticError:  # a fin that jumps that far makes the rigid body unstable
            return math.inf
        return rise_percent(simulation.error(transitions), usual)

    low, high = sizes_of(name, case.robot)
    sizes = low, max(low, largest * high)
    return sized_entry(name, size_that_raises(wanted_percent, sizes, rise), case, session)


def sized_entry(name: str, size: float, case: Case, session: StandInSession) -> dict[str, Any]:
    """Return an effect of some size as `record` takes it; what else is left to chance is the same for every size."""
    drawn = Draw(size, session.robot, session.run_length_s, session.length_s, case.rng(f"effect {name}"))
    parameters = drawn_parameters(name, drawn)
    rounded = {key: round(one, 5) if isinstance(one, float) else one for key, one in parameters.items()}
    return {"name": name, **rounded}


def _film(plan: CleanSession, robot: Robot, case: Case) -> FilmedSession:
    """Drive and film a session; the recording is of the robot as its file describes it, in its own arena."""
    footage, recording = record(plan.session, drive=driver_of(case.family))
    recording = replace(recording, robot=robot)
    if plan.pose_noise > 1.0:
        recording = blurred(recording, plan.session, plan.pose_noise, case.rng("blur"))
    transitions, _ = from_recording(recording)
    return FilmedSession(case.family, footage, recording, transitions)
