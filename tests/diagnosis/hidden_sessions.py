"""Sessions with effects hidden in stand-ins: what a diagnosis is tried on, drawn by one documented seed."""

from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

from swarmtwin.diagnosis.reference import Reference
from swarmtwin.recordings.recording import Recording
from swarmtwin.robot import Robot
from swarmtwin.standin.session import StandInSession
from swarmtwin.studies.hidden_effects.cases import Case
from swarmtwin.studies.hidden_effects.clean_sessions import blurred, clean_session
from swarmtwin.studies.hidden_effects.effect_sizes import CATALOGUE
from swarmtwin.studies.hidden_effects.error_rise import PlainSimulation
from swarmtwin.studies.hidden_effects.hideable_effects import made_effects
from swarmtwin.studies.hidden_effects.sessions import sized_effect
from swarmtwin.studies.stand_in_recording import record
from swarmtwin.transitions import Transitions, from_recording

SEED = 20261122
"""Of all that is drawn: the day it was chosen, before any result was seen."""


def usual(robot: Robot, runs: int = 45, seed: int = SEED + 1) -> StandInSession:
    """A session of vehicle 1 with nothing wrong."""
    return StandInSession(robot, ("1",), runs, 40, seed, lost_poses=0.001)


@cache
def reference_transitions(robot: Robot) -> Transitions:
    """What the simulation of vehicle 1 is learned from."""
    return from_recording(record(usual(robot, 100, SEED))[1])[0]


def learned(robot: Robot) -> Reference:
    """The simulation of vehicle 1, learned from a session with nothing wrong."""
    return Reference.learn(reference_transitions(robot), SEED)


class DrawnSession(NamedTuple):
    """A session, and what is hidden in it."""

    case: Case
    effects: tuple[dict[str, Any], ...]
    recording: Recording

    @property
    def about(self) -> str:
        """All that is needed to see it again."""
        return f"{self.case.robot}, seed {self.case.seed}: {list(self.effects) or self.case.variety}"


def hidden(robot: Robot, name: str, rise_percent: float) -> DrawnSession:
    """A session with one effect, of the catalogue or outside it, that raises the error by so much."""
    kind = "one" if name in CATALOGUE else "outside"
    case = Case(family="formulas", kind=kind, robot=robot.name, names=[name], rises_percent=[rise_percent], seed=SEED)
    session = usual(robot)
    if name == "neighbour_interaction":
        session = replace(session, vehicles=("1", "2"), runs=session.runs // 2)
    simulation = PlainSimulation.learn(reference_transitions(robot))
    effect = sized_effect(name, rise_percent, case, session, simulation)
    return with_effects(case, session, (effect,))


def with_effects(case: Case, session: StandInSession, effects: tuple[dict[str, Any], ...]) -> DrawnSession:
    """A session with effects, given as `record` takes them."""
    made = made_effects(effects, session)
    return DrawnSession(case, effects, record(replace(session, effects=made))[1])


def nothing_hidden(robot: Robot, variety: str, index: int = 0) -> DrawnSession:
    """A session with nothing wrong, unlike the reference as its variety says."""
    case = Case(family="formulas", kind="clean", robot=robot.name, variety=variety, seed=SEED + index)
    rng = case.rng("measured")
    plan = clean_session(variety, usual(robot, seed=SEED + 1 + index), rng)
    recording = replace(record(plan.session)[1], robot=robot)
    if plan.pose_noise > 1.0:
        recording = blurred(recording, plan.session, plan.pose_noise, rng)
    return DrawnSession(case, (), recording)
