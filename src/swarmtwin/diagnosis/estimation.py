"""Step 3, its tool: the likeliest parameters of mechanisms, and what another mechanism may gain beside them."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import optimize

from swarmtwin.diagnosis.likelihood import FittedMechanisms, LikelihoodModel, MechanismClass, loses_commands
from swarmtwin.geometry import compose, exp_map
from swarmtwin.simulation.mechanism import LocalTractionScore, Mechanism, Parameter
from swarmtwin.simulation.mechanisms import gain_change


def estimate(model: LikelihoodModel, mechanisms: Sequence[Mechanism]) -> FittedMechanisms:
    """Return the likeliest values of all parameters, searched from those that `mechanisms` have."""
    kinds = [type(mechanism) for mechanism in mechanisms]
    start = model.values(mechanisms)
    if not len(start):
        return model.evaluate(mechanisms)
    by_likelihood = loses_commands(kinds)
    found = _by_likelihood(model, kinds, start) if by_likelihood else _by_least_squares(model, kinds, start)
    best = model.evaluate(model.assembled(kinds, found))
    return best if all(kind.is_smooth for kind in kinds) else _polished(model, kinds, best)


def _bounds(model: LikelihoodModel, kinds: Sequence[MechanismClass]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the lower and upper bounds and the steps (P,) of all parameters."""
    parameters = [parameter for _, _, parameter in model.parameters(kinds)]
    low, high = (np.array([getattr(one, end) for one in parameters]) for end in ("low", "high"))
    return low, high, np.array([one.response_step for one in parameters])


def _by_least_squares(model: LikelihoodModel, kinds: Sequence[MechanismClass], start: np.ndarray) -> np.ndarray:
    """Search by robust least squares in rounds; each weighs the residuals' axes by their spread at its start."""
    low, high, step = _bounds(model, kinds)
    margin = 1e-6 * (high - low)  # strictly inside, as scipy's trust region asks
    found = start
    for evaluations in model.settings.estimation.evaluations:
        found = np.clip(found, low + margin, high - margin)
        scale = model.scale(model.residual(model.assembled(kinds, found)))

        def residuals(values: np.ndarray, scale: np.ndarray = scale) -> np.ndarray:
            return (model.residual(model.assembled(kinds, values)) / scale).ravel()

        def slopes(values: np.ndarray, scale: np.ndarray = scale) -> np.ndarray:
            one_sided = _one_sided_jacobian(model, kinds, values)
            return one_sided.reshape(-1, len(values)) / np.tile(scale, len(model.session))[:, None]

        found = optimize.least_squares(
            residuals,
            found,
            slopes,
            (low, high),
            x_scale=step,
            loss="huber",
            f_scale=model.settings.estimation.huber_z,
            max_nfev=evaluations,
            xtol=1e-4,
            ftol=1e-6,
        ).x
    return found


def _by_likelihood(model: LikelihoodModel, kinds: Sequence[MechanismClass], start: np.ndarray) -> np.ndarray:
    """Search the likelihood itself, where several outcomes make it a mixture."""
    low, high, step = _bounds(model, kinds)

    def loss(scaled: np.ndarray) -> float:
        return -model.evaluate(model.assembled(kinds, np.clip(scaled * step, low, high))).total

    found = optimize.minimize(
        loss,
        start / step,
        method="L-BFGS-B",
        bounds=list(zip(low / step, high / step, strict=True)),
        options={"eps": 0.1, "maxiter": 12, "ftol": 1e-9},
    )
    return np.clip(found.x * step, low, high)


def _polished(model: LikelihoodModel, kinds: Sequence[MechanismClass], fitted: FittedMechanisms) -> FittedMechanisms:
    """Search a little around values where the motion changes by jumps."""
    low, high, step = _bounds(model, kinds)
    start = model.values(fitted.mechanisms)

    def loss(scaled: np.ndarray) -> float:
        values = start + scaled * step
        if np.any(values < low) or np.any(values > high):
            return np.inf
        return -model.evaluate(model.assembled(kinds, values)).total

    simplex = np.concatenate([np.zeros((1, len(start))), np.eye(len(start)) * 1.5])
    found = optimize.minimize(
        loss,
        np.zeros(len(start)),
        method="Nelder-Mead",
        options={
            "initial_simplex": simplex,
            "maxfev": model.settings.estimation.most_polishing,
            "xatol": 0.02,
            "fatol": 0.05,
        },
    )
    polished = model.evaluate(model.assembled(kinds, np.clip(start + found.x * step, low, high)))
    return polished if polished.total > fitted.total else fitted


def _one_sided_jacobian(model: LikelihoodModel, kinds: Sequence[MechanismClass], values: np.ndarray) -> np.ndarray:
    """Return (N, 3, P) as `jacobian` does, by differences to one side: half the work, enough for a search."""
    _, high, step = _bounds(model, kinds)
    here = model.residual(model.assembled(kinds, values))
    columns = []
    for index in range(len(values)):
        moved = values.copy()
        moved[index] += step[index] if values[index] + step[index] <= high[index] else -step[index]
        there = model.residual(model.assembled(kinds, moved))
        columns.append((there - here) / (moved[index] - values[index]))
    return np.stack(columns, axis=-1)


def jacobian(model: LikelihoodModel, kinds: Sequence[MechanismClass], values: np.ndarray) -> np.ndarray:
    """Return (N, 3, P) how standardised residuals change with the parameters, by central differences."""
    return _central_differences(model, kinds, values, model.residual)


def scores(model: LikelihoodModel, kinds: Sequence[MechanismClass], values: np.ndarray) -> np.ndarray:
    """Return (N, P) how the log-likelihood of each transition changes with the parameters, by central differences."""
    return _central_differences(model, kinds, values, lambda mechanisms: model.evaluate(mechanisms).log_likelihood)


def _central_differences(
    model: LikelihoodModel,
    kinds: Sequence[MechanismClass],
    values: np.ndarray,
    function: Callable[[list[Mechanism]], np.ndarray],
) -> np.ndarray:
    """Return how a function (N, ...) of mechanisms changes with their parameters, (N, ..., P)."""
    low, high, step = _bounds(model, kinds)
    columns = []
    for index in range(len(values)):
        ends = []
        for sign in (1.0, -1.0):
            moved = values.copy()
            moved[index] = np.clip(moved[index] + sign * step[index], low[index], high[index])
            ends.append((moved[index], function(model.assembled(kinds, moved))))
        (ahead, first), (back, second) = ends
        columns.append((first - second) / max(ahead - back, 1e-12))
    return np.stack(columns, axis=-1)


class GainEstimate(NamedTuple):
    """What a mechanism beside others may gain.

    Attributes:
        nats: estimated gain of log-likelihood.
        start: the other mechanisms and the new one, where a search begins.
        change: (3 N,) what it would change of the standardised residuals.
    """

    nats: float
    start: tuple[Mechanism, ...]
    change: np.ndarray


def gain_estimate(
    model: LikelihoodModel, beside: FittedMechanisms, kind: MechanismClass, traction: LocalTractionScore
) -> GainEstimate:
    """Estimate by one linear step what a mechanism beside others would gain, from the best place to begin.

    Args:
        model: of the session.
        beside: the mechanisms that are there already.
        kind: the mechanism.
        traction: `local_traction_score` beside them.
    """
    parameters = kind.parameters_of(model.robot, model.session.conditions)
    held = _held(model, beside).ravel()
    best = GainEstimate(-np.inf, beside.mechanisms, np.zeros_like(held))
    for start in kind.initial_points(model.robot, model.session.conditions, traction):
        begun = {**model.read_off_clock(kind), **start}
        moved = [
            {name: _off_null(parameter, start[name])}
            for name, parameter in parameters.items()
            if parameter.null_value is not None
        ]
        gained, responses = 0.0, []
        for values in moved or [{}]:
            ahead = model.evaluate([*beside.mechanisms, kind.at({**begun, **values})])
            gained = max(gained, ahead.total - beside.total)
            responses.append(((ahead.residual - beside.residual) / beside.residual_scale).ravel())
        stacked = np.stack(responses, axis=-1)
        solution, *_ = np.linalg.lstsq(stacked, -held, rcond=None)
        change = stacked @ solution
        gained = max(gained, float(-held @ change) / 2)
        if gained > best.nats:
            best = GainEstimate(gained, (*beside.mechanisms, kind.at(begun)), change)
    return best


def local_traction_score(model: LikelihoodModel, fitted: FittedMechanisms) -> LocalTractionScore:
    """Return where the traction seems to be another one than fitted mechanisms say."""
    step = model.settings.estimation.traction_step
    weaker = [*fitted.mechanisms, gain_change.Config.at({"gain": 1 - step})]
    response = (model.residual(weaker) - fitted.residual) / step / fitted.residual_scale
    session = model.session
    middle = compose(model.predictor.moment().pose, exp_map(session.twist / 2))[:, :2].numpy()
    return LocalTractionScore(middle, -(_held(model, fitted) * response).sum(axis=1), (response**2).sum(axis=1))


def _held(model: LikelihoodModel, fitted: FittedMechanisms) -> np.ndarray:
    """Return residuals (N, 3) in units of their own spread, clipped as Huber's loss lets them pull."""
    huber_z = model.settings.estimation.huber_z
    return np.clip(fitted.residual / fitted.residual_scale, -huber_z, huber_z)


def _off_null(parameter: Parameter, value: float) -> float:
    """Return a value of a parameter away from where it does nothing."""
    if value != parameter.null_value:
        return value
    step = 3 * parameter.response_step
    return value + step if value + step <= parameter.high else value - step
