"""Step 4. The simulation extended by what was found, and what runs that nothing was fitted to say of it."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch

from swarmtwin.diagnosis.explanation import Explanation
from swarmtwin.diagnosis.gains import (
    Errors,
    Gains,
    gain_by_loss,
    gains,
    likelihood_gain,
    not_confirmed,
    not_shown_in_open_loop,
    scored_tracks,
)
from swarmtwin.diagnosis.likelihood import SessionLikelihood, arriving, loses_commands
from swarmtwin.diagnosis.measured_session import MeasuredSession
from swarmtwin.diagnosis.own_units import with_own_unit
from swarmtwin.diagnosis.reference import Reference
from swarmtwin.diagnosis.unit_spread import UnitSpread
from swarmtwin.errors import UserError
from swarmtwin.recordings.recording import Recording, Track
from swarmtwin.simulation.mechanisms import noise_change
from swarmtwin.simulation.residual_model import ResidualModel
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.transitions import Transitions


class HeldOutJudgement(NamedTuple):
    """What runs that nothing was fitted to say of an explanation.

    Attributes:
        extended: the simulation with what was found; None where nothing is wrong.
        errors: of that, or of the simulation as it was.
        gain: of the extension.
        objection: why they do not confirm it; None where they do.
        not_shown: why it is not to be registered though they confirm it; None where it is.
    """

    extended: Simulation | None
    errors: Errors
    gain: Gains
    objection: str | None
    not_shown: str | None = None


@dataclass(frozen=True)
class HeldOutRuns:
    """Runs that nothing was fitted to.

    Attributes:
        reference: the reference.
        session: all N transitions that it can speak for.
        measured: the recording of these.
        believable: its transitions that are no outliers.
        seed: of everything random.

    Raises:
        UserError: there are none.
    """

    reference: Reference
    session: MeasuredSession
    measured: Recording
    believable: Transitions
    seed: int

    def __post_init__(self) -> None:
        """Check that there are some."""
        if not self.rows.any():
            every = self.reference.settings.verdict.held_out_every
            raise UserError(
                f"diagnosis.verdict.held_out_every={every} holds out no run of the {self.session.runs} that were "
                "measured: lower it, or record more runs"
            )

    @property
    def rows(self) -> np.ndarray:
        """Which transitions of the session, (N,), are theirs: those of every so many-th run, vehicle by vehicle."""
        every = self.reference.settings.verdict.held_out_every
        theirs: np.ndarray = self.session.folds(every) == every - 1
        return theirs

    @cached_property
    def scored(self) -> Transitions:
        """Their transitions."""
        return self.session.transitions.where(self.rows)

    @cached_property
    def tracks(self) -> list[Track]:
        """What was driven in them, for open loop."""
        return scored_tracks(self.measured, self.believable, self.scored)

    @cached_property
    def simulation(self) -> Simulation:
        """The simulation as it was."""
        return Simulation(self.reference.base, (), self.session.conditions)

    @cached_property
    def errors(self) -> Errors:
        """What the simulation errs in them as it was."""
        return Errors.of(self.simulation, self.scored, self.tracks, self._windows_s)

    @cached_property
    def unfitted(self) -> SessionLikelihood:
        """The likelihood of these runs."""
        return self.reference.likelihood_of(self.session.where(self.rows))

    def judge(self, explained: Explanation) -> HeldOutJudgement:
        """Extend the simulation by what was found, and measure what that gains."""
        settings = self.reference.settings.verdict
        extended = _extended(self.reference, self.simulation, explained, self.seed)
        errors = self._errors_of(extended) if extended else self.errors
        gain = gains(self.errors, errors, self.scored.run, settings.gain_draws, np.random.default_rng(self.seed))
        if not extended:
            return HeldOutJudgement(None, errors, gain, None)
        usual, rng = explained.motion_noise.usual, np.random.default_rng(self.seed)
        only = explained.mechanisms[0] if len(explained.mechanisms) == 1 else None
        if only and loses_commands([type(only)]) and extended.noise_factor == 1.0:
            parts = settings.held_out_every - 1
            likelihood = gain_by_loss(explained.model, self.unfitted, only, parts, settings.gain_draws, rng)
        else:
            likelihood = likelihood_gain(self.unfitted, extended, settings.gain_draws, rng, usual)
        moves = extended.residual is not None or bool(arriving(explained.mechanisms))
        objection = not_confirmed(gain, likelihood, settings.immaterial, moves)
        return HeldOutJudgement(extended, errors, gain, objection, not_shown_in_open_loop(gain, moves))

    @property
    def _windows_s(self) -> tuple[float, ...]:
        return self.reference.settings.verdict.windows_s

    def _errors_of(self, extended: Simulation) -> Errors:
        """Return an extended simulation's errors; delays act to the moment where it is known when each was sent."""
        late = [mechanism for mechanism in extended.mechanisms if mechanism.latency_s() > 0]
        if not self.session.sent or not late or extended.residual:
            return Errors.of(extended, self.scored, self.tracks, self._windows_s)
        late_s = sum(mechanism.latency_s() for mechanism in late)
        others = [mechanism for mechanism in extended.mechanisms if mechanism not in late]
        log = self.session.sent._replace(transitions=self.scored)
        command, previous, earlier = log.late(late_s)
        return Errors.of(
            Simulation(extended.dynamics, others, extended.conditions),
            replace(self.scored, command=command, previous_command=previous, earlier_command=earlier),
            [log.acting_late(track, late_s) for track in self.tracks],
            self._windows_s,
        )


def _extended(reference: Reference, simulation: Simulation, explained: Explanation, seed: int) -> Simulation | None:
    """Return the simulation with what was found, mechanisms or a learned residual; None where nothing is wrong."""
    if explained.verdict == "no_gap":
        return None
    mechanisms = explained.mechanisms
    if mechanisms:
        alone = SessionLikelihood(
            *(reference.base, reference.noise, explained.model.session),
            unit_spread=UnitSpread(0.0),
            discrepancy=reference.discrepancy,
            settings=reference.settings,
        )
        mechanisms = with_own_unit(mechanisms, explained.model, alone)
    if explained.names_motion_noise:
        mechanisms = (*mechanisms, noise_change.Config(factor=explained.motion_noise.factor))
    residual = None
    if explained.verdict == "unexplained":
        model, session = explained.model, explained.model.session
        mechanisms = explained.best.mechanisms if explained.share >= 0.5 else ()
        given = session.situation
        assert given.previous_command is not None
        residual, _ = ResidualModel.learn(
            model.predictor.moment(),
            given.command,
            given.previous_command,
            session.run,
            session.residual_of(model.predictor.most_likely_twist(mechanisms)),
            torch.as_tensor(model.noise.spread(model.motion)),
            seed,
        )
    return Simulation(simulation.dynamics, mechanisms, simulation.conditions, residual)
