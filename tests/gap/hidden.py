"""Sessions with freshly drawn effects: what a diagnosis is tried on, never twice the same."""

from typing import NamedTuple

import numpy as np

from swarmtwin.commands.experiments.hidden_effects_cases import Case, Plan, clean, one_effect, several_effects
from swarmtwin.commands.experiments.hidden_effects_sessions import Measured, measure, reference_session
from swarmtwin.gap.reference import Reference
from swarmtwin.robot import Robot

RUNS, STEPS = 100, 40
REFERENCE_RUNS = 150


def fresh_plan() -> Plan:
    """A plan with a seed that nobody has seen; a failing test shows it."""
    seed = int(np.random.SeedSequence().generate_state(1)[0])
    return Plan(seed=seed, runs=RUNS, steps=STEPS, references=1)


def learned(robot: Robot, seed: int) -> Reference:
    """The simulation of vehicle 1, learned from a session with nothing wrong."""
    recorded = reference_session(robot, REFERENCE_RUNS, STEPS, seed)
    return Reference.learn(recorded.transitions, recorded.recording.header.arena_mm, seed)


class Hidden(NamedTuple):
    """A session, and what is hidden in it."""

    case: Case
    measured: Measured

    @property
    def about(self) -> str:
        """All that is needed to see it again."""
        return f"{self.case.robot}, seed {self.case.seed}: {list(self.case.effects) or self.case.variety}"


def one(robot: Robot, plan: Plan, name: str, share: float) -> Hidden:
    """A session with one effect, of the catalogue or outside it, `share` of the way from faint to clear."""
    case = one_effect(robot, plan, name, share, 0)
    return Hidden(case, measure(case, robot))


def several(robot: Robot, plan: Plan, kind: str) -> Hidden:
    """A session with a `pair` or a `triple` of effects."""
    case = several_effects(robot, plan, kind, 0)
    return Hidden(case, measure(case, robot))


def nothing(robot: Robot, plan: Plan, variety: str) -> Hidden:
    """A session with nothing wrong, unlike the reference as its variety says."""
    case = clean(robot, plan, variety, 0)
    return Hidden(case, measure(case, robot))
