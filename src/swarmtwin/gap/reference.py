"""What a measured session is compared with: a simulation, its own noise, and how sure it is of itself."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.spatial import cKDTree
from torch import Tensor

from swarmtwin.dynamics.base import Dynamics
from swarmtwin.errors import UserError
from swarmtwin.gap.base import (
    KNOWN_PARTS,
    AnyBase,
    Columns,
    CrossFitted,
    LearnedBase,
    SimulationBase,
    Trial,
    learned_own_lag,
    learned_track_mm,
)
from swarmtwin.gap.ensemble import folds_of, learn
from swarmtwin.gap.motion import Base
from swarmtwin.gap.noise import Noise, residual_of
from swarmtwin.gap.session import Session
from swarmtwin.gap.surroundings import Surroundings
from swarmtwin.robot import Arena, Robot, SituationPart
from swarmtwin.transitions import Transitions

FOLDS = 6
FEWEST_RUNS = 8
FEWEST_TRANSITIONS = 400
KNOWN_NEIGHBOURS = 10
FARTHEST = 4.0


@dataclass(frozen=True)
class Reference:
    """A simulation and its noise, learned where nothing is wrong.

    Attributes:
        base: the simulation, in ways along an arc.
        noise: of residuals that the simulation was not fitted to.
        surroundings: of the reference.
        vehicles: ids of the vehicles it was learned from; empty where they are not known.
        session: the reference's own transitions.
        unseen: what answers them without having seen them.
        forgives: whether what the simulation gets wrong on the reference as well counts as known, and is no gap.
    """

    base: AnyBase
    noise: Noise
    surroundings: Surroundings
    vehicles: tuple[str, ...]
    session: Session
    unseen: Base
    forgives: bool = True

    @property
    def robot(self) -> Robot:
        """The robot."""
        return self.base.robot

    @classmethod
    def learn(
        cls,
        transitions: Transitions,
        arena: Arena,
        seed: int,
        parts: tuple[SituationPart, ...] | None = None,
    ) -> Self:
        """Learn the simulation from a recording's transitions, cross-fitted over runs.

        Args:
            transitions: of the reference recording.
            arena: where it was made.
            seed: of everything random.
            parts: what the simulation is given; None: what the robot's models are given, and the previous command.
                Where they are named, nothing is forgiven: what it gets wrong of the reference is a gap as well.

        Raises:
            UserError: too few runs or transitions, or constant commands.
        """
        robot = transitions.robot
        forgives = parts is None
        if parts is None:
            parts = tuple(part for part in KNOWN_PARTS if part in (*robot.situation, "previous_command"))
        surroundings = surroundings_of(transitions, arena)
        session = Session.of(transitions, surroundings)
        require_enough(session, "reference")
        fold = folds_of(session.run, FOLDS)
        base = _learned_base(session, parts, session.way, fold, seed)
        return replace(cls._with_noise(base, session, fold, seed), forgives=forgives)

    @classmethod
    def of_simulation(cls, dynamics: Dynamics, evidence: Transitions, arena: Arena, seed: int) -> Self:
        """Take a trained simulation, and learn from transitions that it was not fitted to what it gets wrong already.

        Args:
            dynamics: the simulation.
            evidence: of the recording it was learned from, or of another one in which nothing is wrong.
            arena: where that was made.
            seed: of everything random.

        Raises:
            UserError: the simulation looks at what a diagnosis cannot give it, or there is too little evidence.
        """
        if strange := [part for part in dynamics.parts if part not in KNOWN_PARTS]:
            raise UserError(
                f"the simulation looks at {strange[0]}: a diagnosis works on simulations of {', '.join(KNOWN_PARTS)}; "
                "diagnose with the recording it was learned from instead, reference=DIR"
            )
        session = Session.of(evidence, surroundings_of(evidence, arena))
        require_enough(session, "simulation's evidence: the held-out part of its")
        drive = session.drive
        alone = SimulationBase(dynamics, None).way(drive.command, drive.previous_command, drive.pose)
        fold = folds_of(session.run, FOLDS)
        parts = tuple(part for part in KNOWN_PARTS if part in (*dynamics.parts, "previous_command"))
        correction = _learned_base(session, parts, residual_of(session, alone), fold, seed)
        return cls._with_noise(SimulationBase(dynamics, correction), session, fold, seed)

    @classmethod
    def _with_noise(cls, base: AnyBase, session: Session, fold: np.ndarray, seed: int) -> Self:
        session = session.within(_learned(session.drive.surroundings, base, seed))
        unseen = CrossFitted(base, fold)
        drive = session.drive
        way = unseen.way(drive.command, drive.previous_command, drive.pose)
        noise = Noise.learn(residual_of(session, way), way, session)
        transitions = session.transitions
        vehicles = tuple(transitions.vehicles[index] for index in np.unique(transitions.vehicle))
        return cls(base, noise, drive.surroundings, vehicles, session, unseen)

    def surroundings_for(self, transitions: Transitions, arena: Arena) -> Surroundings:
        """Return the surroundings of another session of this robot."""
        known = {"track_mm": self.surroundings.track_mm, "own_lag": self.surroundings.own_lag}
        return surroundings_of(transitions, arena).model_copy(update=known)

    def covered(self, commands: np.ndarray) -> np.ndarray:
        """Say which commands (N, m) the reference covers: it has enough others about as near as its own are."""
        known = self.session.transitions.command
        spread = np.maximum(known.std(axis=0), 1e-9)
        tree = cKDTree(known / spread)
        count = min(KNOWN_NEIGHBOURS, len(known) - 1)
        own = tree.query(known[:: max(1, len(known) // 2000)] / spread, k=[count + 1])[0]
        asked = tree.query(commands / spread, k=[count])[0][:, 0]
        covered: np.ndarray = asked <= FARTHEST * np.median(own) + 1e-9
        return covered


def _learned_base(
    session: Session, parts: tuple[SituationPart, ...], way: Tensor, fold: np.ndarray, seed: int
) -> LearnedBase:
    """Learn ways (N, 3) from the parts of a session's situations."""
    drive = session.drive
    columns = Columns(drive.robot, parts, drive.surroundings)
    inputs = columns.of(drive.command, drive.previous_command, drive.pose).numpy()
    ensemble = learn(columns.groups(), inputs, way.numpy(), fold, seed)
    return LearnedBase(drive.robot, parts, drive.surroundings, ensemble)


def _learned(surroundings: Surroundings, base: AnyBase, seed: int) -> Surroundings:
    trial = Trial.draw(base.robot, seed)
    known = {"track_mm": learned_track_mm(base, trial), "own_lag": learned_own_lag(base, trial)}
    return surroundings.model_copy(update=known)


def surroundings_of(transitions: Transitions, arena: Arena) -> Surroundings:
    """Return where and how long transitions were measured."""
    lasted_s = float((transitions.time_s + transitions.duration_s).max()) if len(transitions) else 1.0
    return Surroundings(arena_mm=arena, session_s=max(lasted_s, transitions.robot.period_s))


def require_enough(session: Session, what: str, remark: str = "") -> None:
    """Refuse a session from which nothing can be concluded.

    Raises:
        UserError: too few runs or transitions, or commands that never change.
    """
    found = (
        f"the {what} recording{remark} has {session.runs} runs with {len(session)} transitions that follow another one"
    )
    if session.runs < FEWEST_RUNS or len(session) < FEWEST_TRANSITIONS:
        raise UserError(
            f"{found}: too few to conclude anything; record at least {FEWEST_RUNS} runs and {FEWEST_TRANSITIONS} such "
            "transitions (150 runs of 40 steps are comfortable)"
        )
    constant = np.ptp(session.transitions.command, axis=0) <= 1e-9
    if constant.all():
        raise UserError(
            f"the {what} recording has one constant command throughout: nothing can be told apart; vary the commands"
        )
