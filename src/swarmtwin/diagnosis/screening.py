"""Step 3. What each mechanism may gain beside others, and each pair: one linear step from a coarse grid of values."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from swarmtwin.diagnosis.likelihood import (
    FittedMechanisms,
    MechanismClass,
    SessionLikelihood,
    arriving,
    loses_commands,
)
from swarmtwin.errors import UserError
from swarmtwin.geometry import compose, exp_map
from swarmtwin.simulation.mechanism import Mechanism, Parameter, offered
from swarmtwin.simulation.mechanisms import gain_change
from swarmtwin.simulation.traction_score import LocalTractionScore


@dataclass(frozen=True)
class Candidate:
    """A mechanism at one point of its grid, beside others.

    Attributes:
        name: of the mechanism.
        nats: of log-likelihood that it promises.
        start: the others and it, where a fit begins.
        columns: (3 N, q) what it changes of whitened errors; none where commands may be lost.
        held: values of its parameters at the point.
        off: for each of these columns the parameter, and by how much it is off where it does nothing.
    """

    name: str
    nats: float
    start: tuple[Mechanism, ...]
    columns: np.ndarray
    held: Mapping[str, float] = field(default_factory=dict)
    off: Mapping[str, float] = field(default_factory=dict)

    @property
    def form(self) -> MechanismClass:
        """The form of the mechanism."""
        return type(self.start[-1])


def sought_kinds(model: SessionLikelihood) -> dict[str, MechanismClass]:
    """Return the mechanisms that are looked for in a session, by name: those that change what is expected.

    How random the motion is, is measured by itself (`motion_noise_change`).

    Raises:
        UserError: one loses commands by a law that is not that of a single probability.
    """
    found = offered(model.robot, model.session.conditions)
    for name, kind in found.items():
        parameters = kind.parameters_of(model.robot, model.session.conditions)
        if loses_commands([kind]) and len(parameters) != 1:
            raise UserError(
                f"mechanism {name} has the parameters {', '.join(parameters)}: the diagnosis knows lost commands by "
                "one, their probability; give the others fixed values, or take the mechanism's file away"
            )
    return {name: kind for name, kind in found.items() if kind.noise_factor is Mechanism.noise_factor}


def candidates(
    model: SessionLikelihood, beside: FittedMechanisms, kinds: Mapping[str, MechanismClass]
) -> list[Candidate]:
    """Return mechanisms at all points of their grids, beside others that are fitted already."""
    traction = local_traction_score(model, beside)
    here = model.whitened(arriving(beside.mechanisms))
    here[beside.is_lost] = 0.0
    found = []
    for name, cause in kinds.items():
        if name not in beside.names:
            for kind in cause.forms(model.robot):
                for start in _grid(model, kind, traction):
                    found.append(_candidate(model, beside, here, name, kind, start))
    return found


def best_by_name(found: Sequence[Candidate], most: int) -> list[Candidate]:
    """Return the best points of the `most` most promising mechanisms, one for each form, the most promising first."""
    best: dict[MechanismClass, Candidate] = {}
    for one in found:
        if one.form not in best or one.nats > best[one.form].nats:
            best[one.form] = one
    ordered = sorted(best.values(), key=lambda one: -one.nats)
    names = list(dict.fromkeys(one.name for one in ordered))[:most]
    return [one for one in ordered if one.name in names]


def pairs(model: SessionLikelihood, beside: FittedMechanisms, found: Sequence[Candidate]) -> list[Candidate]:
    """Return the best points of each pair of mechanisms, the most promising first: all of them from one Gram matrix."""
    usable = [one for one in found if one.columns.shape[1]]
    if not usable:
        return []
    columns = np.column_stack([one.columns for one in usable])
    ends = np.cumsum([one.columns.shape[1] for one in usable])
    rows = [np.arange(end - one.columns.shape[1], end) for end, one in zip(ends, usable, strict=True)]
    gram, side = model.effects.least_squares(columns, -beside.whitened.ravel())
    best: dict[tuple[str, str], Candidate] = {}
    for first, second in combinations(range(len(usable)), 2):
        names = usable[first].name, usable[second].name
        if names[0] == names[1]:
            continue
        own = np.concatenate([rows[first], rows[second]])
        solution = np.linalg.lstsq(gram[np.ix_(own, own)], side[own], rcond=1e-8)[0]
        nats = float(solution @ side[own]) / 2
        if names not in best or nats > best[names].nats:
            start = (*usable[first].start, usable[second].start[-1])
            best[names] = Candidate("+".join(names), nats, start, columns[:, :0])
    return sorted(best.values(), key=lambda one: -one.nats)


def local_traction_score(model: SessionLikelihood, fitted: FittedMechanisms, step: float = 0.02) -> LocalTractionScore:
    """Return where the traction seems to be another one than fitted mechanisms say, by a small loss everywhere."""
    others = arriving(fitted.mechanisms)
    weaker = [*others, gain_change.Config.at({"gain": 1 - step})]
    response = (model.whitened_near(weaker, others) - model.whitened(others)) / step
    response[fitted.is_lost] = 0.0
    session = model.session
    middle = compose(model.predictor.moment().pose, exp_map(session.twist / 2))[:, :2].numpy()
    weight = model.weight
    return LocalTractionScore(
        middle, -weight * (fitted.residual * response).sum(axis=1), weight * (response**2).sum(axis=1)
    )


def _grid(model: SessionLikelihood, kind: MechanismClass, traction: LocalTractionScore) -> list[dict[str, float]]:
    """Return where a search for a mechanism begins, at most so many points as the settings say, evenly thinned."""
    points = kind.initial_points(model.robot, model.session.conditions, traction)
    most = model.settings.search.grid_points
    chosen = np.unique(np.linspace(0, len(points) - 1, min(most, len(points))).round().astype(int))
    return [points[index] for index in chosen]


def _candidate(
    model: SessionLikelihood,
    beside: FittedMechanisms,
    here: np.ndarray,
    name: str,
    kind: MechanismClass,
    start: Mapping[str, float],
) -> Candidate:
    """Return a mechanism at a point of its grid, beside others with which whitened errors are `here` (N, 3)."""
    parameters = kind.parameters_of(model.robot, model.session.conditions)
    begun = {**model.read_off_clock(kind), **start}
    if loses_commands([kind]):
        moved = {key: _off_null(parameters[key], value) for key, value in start.items()}
        ahead = (*beside.mechanisms, kind.at({**begun, **moved}))
        return Candidate(name, model.evaluate(ahead).total - beside.total, ahead, np.zeros((3 * len(model.session), 0)))
    nulls = {key: one.null_value for key, one in parameters.items() if one.null_value is not None}
    moved = {key: _off_null(parameters[key], start[key]) for key in nulls}
    probes: list[dict[str, float]] = [{**nulls, key: value} for key, value in moved.items()]
    responses, others = [], arriving(beside.mechanisms)
    for probe in probes or [{}]:
        change = model.whitened_near([*others, kind.at({**begun, **probe})], others) - here
        change[beside.is_lost] = 0.0
        responses.append(change.ravel())
    columns = np.stack(responses, axis=-1)
    gram, side = model.effects.least_squares(columns, -here.ravel())
    solution = np.linalg.lstsq(gram, side, rcond=1e-8)[0]
    values = dict(begun)
    for (key, value), factor in zip(moved.items(), solution, strict=False):
        parameter, null = parameters[key], nulls[key]
        values[key] = float(np.clip(null + factor * (value - null), parameter.low, parameter.high))
        if null in (parameter.low, parameter.high) and factor <= 0:
            solution, values[key] = np.zeros_like(solution), value
    nats = float(solution @ side - solution @ gram @ solution / 2)
    off = {key: value - nulls[key] for key, value in moved.items()}
    ahead = (*beside.mechanisms, kind.at(values))
    if len(moved) == 1:  # what it does need not grow in proportion: where it was looked at may be better
        there = {**begun, **moved}
        error = model.whitened_near(arriving(ahead), others)
        error[beside.is_lost] = 0.0
        losses = [model.effects.loss(one.ravel()) / 2 for one in (here, error)]
        attained, on_grid = losses[0] - losses[1], float(side[0] - gram[0, 0] / 2)
        nats = max(attained, on_grid)
        if on_grid > attained:
            ahead = (*beside.mechanisms, kind.at(there))
    return Candidate(name, nats, ahead, columns, begun, off)


def _off_null(parameter: Parameter, value: float) -> float:
    """Return a value of a parameter away from where it does nothing."""
    return value if value != parameter.null_value else parameter.stepped_from(value, steps=3)
