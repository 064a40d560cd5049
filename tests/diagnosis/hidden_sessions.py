"""Sessions with effects hidden in stand-ins: what a diagnosis is tried on, drawn by one documented seed."""

from typing import NamedTuple

from swarmtwin.diagnosis.reference import Reference
from swarmtwin.robot import Robot
from swarmtwin.studies.hidden_effects.cases import Case, Plan, clean, one_effect
from swarmtwin.studies.hidden_effects.sessions import HiddenSession, measure, reference_session

SEED = 20261122
"""Of all that is drawn: the day it was chosen, before any result was seen."""
PLAN = Plan(seed=SEED, runs=45, steps=40, references=1)


def learned(robot: Robot) -> Reference:
    """The simulation of vehicle 1, learned from a session with nothing wrong."""
    return Reference.learn(reference_session(robot, 100, 40, SEED).transitions, SEED)


class DrawnSession(NamedTuple):
    """A session, and what is hidden in it."""

    case: Case
    measured: HiddenSession

    @property
    def about(self) -> str:
        """All that is needed to see it again."""
        return f"{self.case.robot}, seed {self.case.seed}: {list(self.case.effects) or self.case.variety}"


def hidden(robot: Robot, name: str, share: float) -> DrawnSession:
    """A session with one effect, of the catalogue or outside it, `share` of the way from faint to clear."""
    case = one_effect(robot, PLAN, name, share, 0)
    return DrawnSession(case, measure(case, robot))


def nothing_hidden(robot: Robot, variety: str, index: int = 0) -> DrawnSession:
    """A session with nothing wrong, unlike the reference as its variety says."""
    case = clean(robot, PLAN, variety, index)
    return DrawnSession(case, measure(case, robot))
