"""Step 3. What each mechanism may gain beside others, and each pair: one linear step from a coarse grid of values."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
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
        point: of the grid.
    """

    name: str
    nats: float
    start: tuple[Mechanism, ...]
    columns: np.ndarray
    held: Mapping[str, float] = field(default_factory=dict)
    off: Mapping[str, float] = field(default_factory=dict)
    point: Mapping[str, float] = field(default_factory=dict)

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
    model: SessionLikelihood,
    beside: FittedMechanisms,
    kinds: Mapping[str, MechanismClass],
    known: Sequence[Candidate] = (),
) -> list[Candidate]:
    """Return mechanisms at the points of their grids, beside others that are fitted already.

    What they promise is what one linear step does.

    Args:
        model: of the session.
        beside: the others.
        kinds: the mechanisms, by name.
        known: candidates at all points beside nothing, where these were looked at. What mechanisms change beside
            others is much the same: of the points of a form that are known, those are looked at again that promise most
            by these changes.
    """
    traction = local_traction_score(model, beside)
    here = _left(model, beside)
    found = []
    for name, cause in kinds.items():
        if name not in beside.names:
            for kind in cause.forms(model.robot):
                points = _grid(model, kind, traction)
                for start in _promising(model, points, [one for one in known if one.form is kind], here):
                    found.append(_candidate(model, beside, here, name, kind, start))
    return found


def best_by_name(
    model: SessionLikelihood, beside: FittedMechanisms, found: Sequence[Candidate], most: int
) -> list[Candidate]:
    """Return the best points of the `most` most promising mechanisms, one for each form, the most promising first.

    Of each form, where its most promising points lead to is looked at.
    """
    here = _left(model, beside)
    by_form: dict[MechanismClass, list[Candidate]] = {}
    for one in found:
        by_form.setdefault(one.form, []).append(one)
    best = []
    for points in by_form.values():
        promising = sorted(points, key=lambda one: -one.nats)[: model.settings.search.tried_points]
        best.append(max((_tried(model, beside, here, one) for one in promising), key=lambda one: one.nats))
    ordered = sorted(best, key=lambda one: -one.nats)
    names = list(dict.fromkeys(one.name for one in ordered))[:most]
    return [one for one in ordered if one.name in names]


def pairs(model: SessionLikelihood, beside: FittedMechanisms, found: Sequence[Candidate], most: int) -> list[Candidate]:
    """Return the `most` most promising pairs, each at its best points: all of them from one Gram matrix.

    Where each of both leads to by itself is looked at.
    """
    usable = [one for one in found if one.columns.shape[1]]
    if not usable:
        return []
    columns, rows = _side_by_side(usable)
    gram, side = model.effects.least_squares(columns, -beside.whitened.ravel())
    best: dict[tuple[str, str], tuple[float, int, int]] = {}
    for first, second in combinations(range(len(usable)), 2):
        names = usable[first].name, usable[second].name
        if names[0] == names[1]:
            continue
        own = np.concatenate([rows[first], rows[second]])
        solution = np.linalg.lstsq(gram[np.ix_(own, own)], side[own], rcond=1e-8)[0]
        nats = float(solution @ side[own]) / 2
        if names not in best or nats > best[names][0]:
            best[names] = nats, first, second
    here, promising = _left(model, beside), []
    for names, (nats, *both) in sorted(best.items(), key=lambda one: -one[1][0])[:most]:
        starts = [_tried(model, beside, here, usable[place]).start for place in both]
        promising.append(Candidate("+".join(names), nats, (*starts[0], starts[1][-1]), columns[:, :0]))
    return promising


def _side_by_side(found: Sequence[Candidate]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the columns (3 N, q) of candidates, and the places of those of each."""
    ends = np.cumsum([one.columns.shape[1] for one in found])
    rows = [np.arange(end - one.columns.shape[1], end) for end, one in zip(ends, found, strict=True)]
    return np.column_stack([one.columns for one in found]), rows


def _left(model: SessionLikelihood, beside: FittedMechanisms) -> np.ndarray:
    """Return the whitened errors (N, 3) beside others of transitions whose commands arrived; 0 of the rest."""
    here = model.whitened(arriving(beside.mechanisms))
    here[beside.is_lost] = 0.0
    return here


def _promising(
    model: SessionLikelihood, points: list[dict[str, float]], known: Sequence[Candidate], here: np.ndarray
) -> list[dict[str, float]]:
    """Return the points of a form that are not known, and of those that are, the ones that promise most (`here`)."""
    most = model.settings.search.tried_points
    again = [one for one in known if one.point in points and one.columns.shape[1]]
    if len(again) <= most:
        return points
    columns, rows = _side_by_side(again)
    gram, side = model.effects.least_squares(columns, -here.ravel())
    parameters = again[0].form.parameters_of(model.robot, model.session.conditions)
    nats = [
        _linear_step(one.off, parameters, gram[np.ix_(own, own)], side[own])[1]
        for one, own in zip(again, rows, strict=True)
    ]
    best = [again[place].point for place in np.argsort(nats)[::-1][:most]]
    left_out = [one.point for one in again if one.point not in best]
    return [point for point in points if point not in left_out]


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
    off = {key: value - nulls[key] for key, value in moved.items()}
    factors, nats = _linear_step(off, parameters, gram, side)
    values = dict(begun)
    for (key, value), factor in zip(moved.items(), factors, strict=False):
        parameter, null = parameters[key], nulls[key]
        stays = factor <= 0 and null in (parameter.low, parameter.high)  # it begins where it was looked at
        stepped = value if stays else null + factor * off[key]
        values[key] = float(np.clip(stepped, parameter.low, parameter.high))
    return Candidate(name, nats, (*beside.mechanisms, kind.at(values)), columns, begun, off, start)


def _linear_step(
    off: Mapping[str, float], parameters: Mapping[str, Parameter], gram: np.ndarray, side: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return by how many times what parameters are `off` a linear step moves them (q,), and the nats that it promises.

    One parameter alone stays within its bounds; of several, one that would go beyond where it does nothing promises
    nothing.

    Args:
        off: by how much each parameter is off where it does nothing, where the columns were looked at.
        parameters: of the mechanism.
        gram: (q, q) products of the columns with each other.
        side: (q,) and with what is left.
    """
    factors = np.linalg.lstsq(gram, side, rcond=1e-8)[0]
    promised = factors
    for place, (key, by) in enumerate(off.items()):
        one = parameters[key]
        assert one.null_value is not None
        lowest, highest = sorted(((one.low - one.null_value) / by, (one.high - one.null_value) / by))
        if len(off) == 1:
            factors = promised = np.clip(factors, lowest, highest)
        elif factors[place] <= 0 and one.null_value in (one.low, one.high):
            promised = np.zeros_like(factors)
    return factors, float(promised @ side - promised @ gram @ promised / 2)


def _tried(model: SessionLikelihood, beside: FittedMechanisms, here: np.ndarray, one: Candidate) -> Candidate:
    """Return a candidate of one parameter with what it brings where its linear step leads, or where it was looked at.

    What it does need not grow in proportion: of both the better one. Whitened errors beside the others are `here`.
    """
    if len(one.off) != 1:
        return one
    key, off = next(iter(one.off.items()))
    null = one.form.parameters_of(model.robot, model.session.conditions)[key].null_value
    assert null is not None
    there, others = one.form.at({**one.held, key: null + off}), arriving(beside.mechanisms)
    error = model.whitened_near([*others, one.start[-1]], others)
    error[beside.is_lost] = 0.0
    products = model.effects.gram(np.column_stack([one.columns, here.ravel(), error.ravel()]))
    attained = float(products[1, 1] - products[2, 2]) / 2
    on_grid = float(-products[0, 1] - products[0, 0] / 2)
    start = (*beside.mechanisms, there) if on_grid > attained else one.start
    return replace(one, nats=max(attained, on_grid), start=start)


def _off_null(parameter: Parameter, value: float) -> float:
    """Return a value of a parameter away from where it does nothing."""
    return value if value != parameter.null_value else parameter.stepped_from(value, steps=3)
