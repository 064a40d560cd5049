"""Step 3, its ground: how likely a measured session is, given the simulation, its noise and mechanisms.

The errors of a session are whitened once, since the noise depends on how vehicles really moved and not on what is said
to be the cause. What nobody knows exactly, and is no gap, is integrated out as normal random effects: what the
reference leaves open of the simulation, how units differ, smooth discrepancies, and for each mechanism its form.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from swarmtwin.diagnosis.discrepancy import Discrepancy
from swarmtwin.diagnosis.lost_commands import LostCommands, likeliest_errors
from swarmtwin.diagnosis.measured_session import MeasuredSession
from swarmtwin.diagnosis.noise import Noise, log_density
from swarmtwin.diagnosis.random_effects import (
    RandomEffects,
    form_effects,
    likeliest_unit_errors,
    member_disagreement,
    unit_effects,
    unit_effects_of_outcomes,
)
from swarmtwin.diagnosis.session_errors import SessionErrors
from swarmtwin.diagnosis.session_prediction import arrival_probability
from swarmtwin.diagnosis.settings import DiagnosisSettings
from swarmtwin.diagnosis.unit_spread import UnitSpread
from swarmtwin.dynamics.predictor import DynamicsModel
from swarmtwin.simulation.ensemble_dynamics import CrossFitted
from swarmtwin.simulation.mechanism import Mechanism, Parameter

MechanismClass = type[Mechanism]


@dataclass(frozen=True)
class FittedMechanisms:
    """Mechanisms with values, and how likely they make a session of N transitions.

    Attributes:
        mechanisms: with their values.
        log_likelihood: (N,) of each transition, nats, random effects at their likeliest; 0 of vehicles in contact.
        whitened: (N, 3) errors, independent and of unit variance where nothing is wrong.
        residual: (N, 3) the same, freed of random effects.
        scale: (3,) how much wider these spread than the reference's.
        penalty: nats that the random effects' size costs.
        effect_errors: (N, 3) what random effects make of the errors.
        courses: (N,) each transition's likeliest course, by which commands arrived, as in `lost_commands`: 0 all.
    """

    mechanisms: tuple[Mechanism, ...]
    log_likelihood: np.ndarray
    whitened: np.ndarray
    residual: np.ndarray
    scale: np.ndarray
    penalty: float
    effect_errors: np.ndarray
    courses: np.ndarray

    @property
    def is_lost(self) -> np.ndarray:
        """(N,) transitions in which a command seems to have been lost, now or before."""
        lost: np.ndarray = self.courses > 0
        return lost

    @property
    def total(self) -> float:
        """Log-likelihood of the whole session, nats, random effects at their likeliest."""
        return float(self.log_likelihood.sum()) - self.penalty

    @property
    def kinds(self) -> tuple[MechanismClass, ...]:
        """The classes of its mechanisms."""
        return tuple(type(mechanism) for mechanism in self.mechanisms)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of its mechanisms."""
        return tuple(mechanism.name for mechanism in self.mechanisms)


class SessionLikelihood(SessionErrors):
    """A session, the simulation and its noise: says how likely what was measured is, given mechanisms.

    Args:
        base: the simulation.
        noise: of errors that it was not fitted to.
        session: of N transitions.
        known_vehicles: ids of the vehicles that the simulation knows by itself; None: all of the session.
        unit_spread: by how much other vehicles are expected to differ; None: by the settings' prior.
        discrepancy: what the simulation gets wrong of its own reference as well; None: nothing is known of that.
        settings: of the diagnosis; None: the defaults.
        explained: mechanisms that are known to be there, so that the noise is that of what they leave.
        quick: answers nearly as the simulation, in a fraction of its time, where only differences are asked; None: it
            answers itself.
    """

    def __init__(
        self,
        base: DynamicsModel,
        noise: Noise,
        session: MeasuredSession,
        known_vehicles: tuple[str, ...] | None = None,
        unit_spread: UnitSpread | None = None,
        discrepancy: Discrepancy | None = None,
        settings: DiagnosisSettings | None = None,
        explained: Sequence[Mechanism] = (),
        quick: DynamicsModel | None = None,
    ) -> None:
        super().__init__(base, noise, session, known_vehicles, unit_spread, settings, explained, quick)
        self._discrepancy = discrepancy
        self.clock_s = session.transitions.duration_s
        """How long the periods are of the session that this is part of, by its clock."""

    @cached_property
    def discrepancy(self) -> tuple[np.ndarray, np.ndarray]:
        """Errors (N, 3) of the simulation that are expected, and directions (N, 3, q) of their uncertainty."""
        if self._discrepancy is None:
            count = len(self.session)
            return np.zeros((count, 3)), np.zeros((count, 3, 0))
        return self._discrepancy.expected(self)

    @cached_property
    def disagreement(self) -> np.ndarray:
        """(N, 3, M) how the simulation's M members disagree."""
        return member_disagreement(self)

    @cached_property
    def correction(self) -> np.ndarray:
        """(N, 3) errors that the simulation is known to make, of its own reference as well."""
        return self.discrepancy[0]

    @cached_property
    def unit_directions(self) -> np.ndarray:
        """(N, 3, K) what unknown vehicles may do otherwise."""
        return np.stack([np.zeros((len(self.session), 3)), *unit_effects(self)], axis=-1)[..., 1:]

    def unit_errors(self, errors: np.ndarray) -> np.ndarray:
        """Return (N, 3) what of errors (N, 3) unknown vehicles make by fabrication."""
        return likeliest_unit_errors(self, self.unit_directions, errors)

    def errors_left(self, mechanisms: Sequence[Mechanism]) -> np.ndarray:
        """Return the errors (N, 3) that mechanisms leave, of the likeliest course where commands may be lost."""
        lossy = arrival_probability(mechanisms) < 1.0
        return likeliest_errors(self, mechanisms) if lossy else self.errors(mechanisms)

    @cached_property
    def effects(self) -> RandomEffects:
        """Random effects without any mechanism: of units first."""
        return self._own_effects(self.disagreement)

    @cached_property
    def effects_of_certain_simulation(self) -> RandomEffects:
        """Likewise, but for how the simulation's members disagree."""
        return self._own_effects(self.disagreement[..., :0])

    def _own_effects(self, disagreement: np.ndarray) -> RandomEffects:
        together = np.concatenate([self.unit_directions, disagreement], axis=-1)
        return RandomEffects.of(self._whitened(together), self.weight).extended(self._whitened(self.discrepancy[1]))

    def disagreement_with(self, mechanisms: Sequence[Mechanism]) -> np.ndarray:
        """Return (3 N, M) how the simulation's M members disagree with mechanisms in place, whitened."""
        return self._whitened(member_disagreement(self, arriving(mechanisms)))

    @cached_property
    def _unit_effects_where_lost(self) -> np.ndarray:
        """(N, 3, 4, K) by what the first K of these differ where commands are lost, by which of them arrived."""
        outcomes = unit_effects_of_outcomes(self)
        return outcomes - outcomes[:, :, :1]

    def whitened(self, mechanisms: Sequence[Mechanism]) -> np.ndarray:
        """Return the errors (N, 3) with mechanisms, independent and of unit variance, where every command arrives."""
        return self.filter(self.errors(mechanisms)[..., None])[..., 0]

    def whitened_near(self, mechanisms: Sequence[Mechanism], near: Sequence[Mechanism]) -> np.ndarray:
        """Return likewise (N, 3), nearly, as `errors_near`."""
        return self.filter(self.errors_near(mechanisms, near)[..., None])[..., 0]

    def effects_with(self, mechanisms: Sequence[Mechanism], near: Sequence[Mechanism] | None = None) -> RandomEffects:
        """Return the random effects, and those of the form of mechanisms.

        What looks like another value of a parameter is no other form: forms are orthogonal to what parameters change,
        so that a parameter is the one that fits best (Plumlee, 2017). Where others are `near`, as `errors_near` has it.
        """
        forms = self._forms(mechanisms, near)
        if not forms.shape[-1]:
            return self.effects
        slopes = self._error_slopes(mechanisms, mechanisms if near is None else near)
        weight = np.repeat(self.weight, 3)[:, None]
        along, across = self._whitened(slopes), self._whitened(forms)
        share = np.linalg.lstsq((along * weight).T @ along, (along * weight).T @ across, rcond=1e-10)[0]
        return self.effects.extended(across - along @ share)

    def effects_with_any_form(
        self, mechanisms: Sequence[Mechanism], near: Sequence[Mechanism] | None = None
    ) -> RandomEffects:
        """Return the random effects with forms that may look like another value of a parameter: for its interval.

        There they are larger: an interval must hold the truth, while a cause must not be taken for another one's form.
        """
        forms = self.any_forms(mechanisms, near)
        return self.effects.extended(forms) if forms.shape[-1] else self.effects

    def any_forms(self, mechanisms: Sequence[Mechanism], near: Sequence[Mechanism] | None = None) -> np.ndarray:
        """Return (3 N, q) what other forms of mechanisms would change, whitened, as large as intervals allow for."""
        larger = self.settings.estimation.form / self.settings.likelihood.form
        return self._whitened(self._forms(mechanisms, near, of_values=True) * larger)

    def _whitened(self, directions: np.ndarray) -> np.ndarray:
        """Return directions (N, 3, k) of errors as columns (3 N, k)."""
        return self.filter(directions).reshape(3 * len(directions), directions.shape[-1])

    def _forms(
        self, mechanisms: Sequence[Mechanism], near: Sequence[Mechanism] | None, of_values: bool = False
    ) -> np.ndarray:
        """Return (N, 3, q) what other forms of mechanisms would change."""
        columns = list(form_effects(self, mechanisms, near, of_values)) if mechanisms else []
        return np.stack(columns, axis=-1) if columns else np.zeros((len(self.session), 3, 0))

    def _error_slopes(self, mechanisms: Sequence[Mechanism], near: Sequence[Mechanism]) -> np.ndarray:
        """Return (N, 3, P) how errors change with the parameters of mechanisms, by differences to one side."""
        kinds = [type(one) for one in mechanisms]
        values, here = self.values(mechanisms), self.errors_near(mechanisms, near)
        columns = []
        for index, (_, _, parameter) in enumerate(self.parameters(kinds)):
            moved = values.copy()
            moved[index] = parameter.stepped_from(values[index])
            change = self.errors_near(self.assembled(kinds, moved), near) - here
            columns.append(change / (moved[index] - values[index]))
        return np.stack(columns, axis=-1) if columns else np.zeros((*here.shape, 0))

    def evaluate(
        self,
        mechanisms: Sequence[Mechanism],
        effects: RandomEffects | None = None,
        near: LostCommands | None = None,
        is_quick: bool = False,
    ) -> FittedMechanisms:
        """Return how likely the session is with mechanisms as they are.

        Args:
            mechanisms: some of which may lose commands.
            effects: what is unknown beside them; None: what is without any mechanism.
            near: where commands may be lost, what `lost_commands` says of nearly the same mechanisms; None: all is
                looked for anew, and the likeliest courses change by jumps with the mechanisms.
            is_quick: whether how much they differ from these is asked of one member alone.
        """
        effects = effects or self.effects
        freedom, volume = self.noise.degrees_of_freedom, self.filter.log_volume
        is_lossy = arrival_probability(mechanisms) < 1.0
        lost = self.lost_commands(mechanisms, effects, near, is_quick) if is_lossy else None
        whitened = lost.whitened if lost else self.whitened(mechanisms)
        sizes = effects.sizes(whitened)
        shift = effects.of_sizes(sizes)
        residual = whitened - shift
        scale = self._scale(residual)
        density = lost.log_density(shift, scale) if lost else log_density(residual / scale, freedom)
        taken = lost.likeliest if lost else np.zeros(len(self.session), int)
        log_likelihood = np.where(self.in_contact, 0.0, density - volume - np.log(scale).sum())
        penalty = float(sizes @ sizes) / 2 + self._scale_penalty(scale)
        effect_errors = self.filter.inverse(shift)
        return FittedMechanisms(
            tuple(mechanisms), log_likelihood, whitened, residual, scale, penalty, effect_errors, taken
        )

    def lost_commands(
        self,
        mechanisms: Sequence[Mechanism],
        effects: RandomEffects | None = None,
        near: LostCommands | None = None,
        is_quick: bool = False,
    ) -> LostCommands:
        """Return which commands arrived, where random effects make errors as well; arguments are as in `evaluate`."""
        effects = effects or self.effects
        lost, where_lost = LostCommands(self, mechanisms, near, is_quick), self._unit_effects_where_lost
        for _ in range(2):
            sizes = effects.sizes(lost.whitened)
            effect_errors = self.filter.inverse(effects.of_sizes(sizes))
            lost.expect(effect_errors, where_lost @ sizes[: where_lost.shape[-1]])
        return lost

    def log_likelihood_with_motion_noise(self, mechanisms: Sequence[Mechanism], factor: float) -> np.ndarray:
        """Return (N,) the log-likelihood of each transition where the motion is `factor` times as random.

        That is, as the reference's, on its standard deviation; the camera's noise is that of the session.
        """
        left = self.errors_left(mechanisms) - self.evaluate(mechanisms).effect_errors
        scales = replace(self.noise_scales, motion=factor**2)
        prepared = self.reference_noise.scaled(scales).filter(self.motion, self.session)
        density = log_density(prepared(left[..., None])[..., 0], self.noise.degrees_of_freedom) - prepared.log_volume
        return np.where(self.in_contact, 0.0, density)

    def _scale(self, residual: np.ndarray, rounds: int = 5) -> np.ndarray:
        """Return (3,) the likeliest spread of residuals (N, 3), with its prior."""
        residual = residual if self.in_contact.all() else residual[~self.in_contact]
        count, spread = len(residual), self.settings.noise.set_scale_spread
        squared, scale2 = residual**2, np.ones(3)
        freedom = self.noise.degrees_of_freedom
        for _ in range(rounds):
            weight = np.ones(count)
            if freedom is not None:
                weight = (freedom + 3) / (freedom + (squared / scale2).sum(axis=1))
            wanted = np.maximum((weight[:, None] * squared).mean(axis=0), 1e-6)
            trust = 2 * count / (2 * count + 1 / spread**2)  # of its log, beside the prior at 0
            scale2 = np.exp(trust * np.log(wanted))
        return np.sqrt(scale2)

    def _scale_penalty(self, scale: np.ndarray) -> float:
        return float(((np.log(scale) / self.settings.noise.set_scale_spread) ** 2).sum()) / 2

    def thinned(self, most: int) -> "SessionLikelihood":
        """Return that of some runs, of about `most` transitions; itself where there are no more."""
        rows = self.session.spread_over(most)
        if rows.all():
            return self
        base = self.predictor.base
        base = base.of_rows(rows) if isinstance(base, CrossFitted) else base
        other = self._of(self.session.where(rows), base, self.explained)
        expected, directions = self.discrepancy
        other.discrepancy, other.disagreement = (expected[rows], directions[rows]), self.disagreement[rows]
        other.clock_s = self.clock_s
        return other

    def _of(self, session: MeasuredSession, base: DynamicsModel, explained: Sequence[Mechanism]) -> "SessionLikelihood":
        known = [vehicle for vehicle in self.session.transitions.vehicles if vehicle not in self.unknown_vehicles]
        return SessionLikelihood(
            base,
            self.reference_noise,
            session,
            tuple(known),
            self.unit_spread,
            self._discrepancy,
            self.settings,
            explained,
            self.predictor.quick,
        )

    def explained_by(self, mechanisms: Sequence[Mechanism]) -> "SessionLikelihood":
        """Return it with the noise of what mechanisms leave."""
        other = self._of(self.session, self.predictor.base, mechanisms)
        other.predictor, other.flexible = self.predictor, self.flexible
        other.one_member = self.one_member
        other.discrepancy, other.disagreement = self.discrepancy, self.disagreement
        return other

    # what mechanisms are made of

    def parameters(self, kinds: Sequence[MechanismClass]) -> list[tuple[int, str, Parameter]]:
        """Return the parameters of several mechanisms: number of the mechanism, name, parameter."""
        return [
            (number, name, parameter)
            for number, kind in enumerate(kinds)
            for name, parameter in kind.parameters_of(self.robot, self.session.conditions).items()
        ]

    def values(self, mechanisms: Sequence[Mechanism]) -> np.ndarray:
        """Return the values (P,) of all parameters of mechanisms."""
        kinds = [type(mechanism) for mechanism in mechanisms]
        return np.array([getattr(mechanisms[number], name) for number, name, _ in self.parameters(kinds)], float)

    def assembled(self, kinds: Sequence[MechanismClass], values: np.ndarray) -> list[Mechanism]:
        """Return mechanisms with values (P,) for all their parameters."""
        given: list[dict[str, float]] = [{} for _ in kinds]
        for (number, name, _), value in zip(self.parameters(kinds), values, strict=True):
            given[number][name] = float(value)
        return [kind.at({**self.read_off_clock(kind), **own}) for kind, own in zip(kinds, given, strict=True)]

    def read_off_clock(self, kind: MechanismClass) -> dict[str, float]:
        """Return what a mechanism reads off the session's clock."""
        return kind.read_from_clock(self.clock_s, self.robot) or {}

    def can_show(self, kind: MechanismClass) -> bool:
        """Say whether the session can show a mechanism at all."""
        transitions = self.session.transitions
        if kind.read_from_clock(self.clock_s, self.robot) is None:
            return False
        if loses_commands([kind]) and self.session.sent and self.session.sent.a_period >= 2:
            return False  # one that is lost is followed by the same, or nearly, within the period
        return "neighbours" not in kind.inputs or bool(np.isfinite(transitions.neighbours).any())

    def shown_of(self, kinds: Mapping[str, MechanismClass]) -> dict[str, MechanismClass]:
        """Return those of some mechanisms, by name, that the session can show at all."""
        return {name: kind for name, kind in kinds.items() if self.can_show(kind)}


def loses_commands(kinds: Sequence[MechanismClass]) -> bool:
    """Say whether one of the mechanisms decides that a command arrives."""
    return any(kind.arrival_probability is not Mechanism.arrival_probability for kind in kinds)


def arriving(mechanisms: Sequence[Mechanism]) -> list[Mechanism]:
    """Return the mechanisms under which every command arrives."""
    return [one for one in mechanisms if one.arrival_probability() >= 1.0]
