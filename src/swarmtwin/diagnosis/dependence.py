"""Step 2. What a residual depends on: score tests with runs as blocks, false discoveries controlled over them all."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy import stats

from swarmtwin.diagnosis.likelihood import FittedMechanisms, SessionLikelihood
from swarmtwin.diagnosis.measured_session import MeasuredSession
from swarmtwin.diagnosis.random_effects import RandomEffects
from swarmtwin.diagnosis.result import Dependence
from swarmtwin.diagnosis.settings import DependenceSettings, MotionNoiseSettings
from swarmtwin.simulation.residual_model import residual_encoding


@dataclass(frozen=True)
class StandardisedResidual:
    """A session's residuals, ready for tests.

    Attributes:
        session: of N transitions in R runs.
        residual: (N, 3) standardised by the session's noise, clipped.
        by_usual_noise: (N, 3) errors less what they depend on, standardised by the reference's noise, not clipped.
        size: (N, 3) simulated twists over usual ones.
        effects: (3 N, k) in one or more blocks, by what the residual may differ by chance, in all of the session alike,
            each in units of its standard deviation: what is uncertain in the simulation, and how units differ.
        weight: (N,) how much each transition counts.
    """

    session: MeasuredSession
    residual: np.ndarray
    by_usual_noise: np.ndarray
    size: np.ndarray
    effects: tuple[np.ndarray, ...]
    weight: np.ndarray

    @classmethod
    def of(
        cls,
        model: SessionLikelihood,
        fitted: FittedMechanisms,
        weight: np.ndarray | None = None,
        explained: SessionLikelihood | None = None,
    ) -> "StandardisedResidual":
        """Take the residuals that fitted mechanisms leave; of noise, those of the session as it is `explained`."""
        explained = explained or model
        whitened = explained.filter(explained.unpredicted_errors[..., None])[..., 0]
        of_units = explained.filter.inverse(explained.effects.of_sizes(explained.effects.sizes(whitened)))
        noise = explained.by_usual_noise(explained.unpredicted_errors - of_units)
        return cls.of_residual(model, fitted.whitened, noise, model.effects, weight)

    @classmethod
    def of_residual(
        cls,
        model: SessionLikelihood,
        residual: np.ndarray,
        noise: np.ndarray,
        effects: RandomEffects,
        weight: np.ndarray | None = None,
    ) -> "StandardisedResidual":
        """Take residuals (N, 3) as they are, and what is noise of them; vehicles in contact do not count."""
        clip_z, twist = model.settings.dependence.clip_z, model.simulated.numpy()
        size = twist / np.maximum(twist.std(axis=0), 1e-9)
        weight = np.where(model.in_contact, 0.0, 1.0 if weight is None else weight)
        return cls(model.session, np.clip(residual, -clip_z, clip_z), noise, size, effects.columns, weight)

    def effects_along(self, regressors: np.ndarray, axis: int) -> np.ndarray:
        """Return the products (K, q) of the effects on an axis with regressors (N, q)."""
        blocks = [block.reshape(len(regressors), 3, -1)[:, axis].T @ regressors for block in self.effects]
        return np.concatenate([*blocks, np.empty((0, regressors.shape[1]))])


def dependence_tests(
    measured: StandardisedResidual,
    reference: StandardisedResidual,
    seed: int,
    settings: DependenceSettings | None = None,
    reference_discrepancy: bool = True,
    usual_spread: float | None = None,
) -> list[Dependence]:
    """Test what residuals depend on beyond what the reference's own residuals do.

    For each part of the situation its functions, alone and times the motion, are regressed upon; the difference of the
    coefficients to the reference's is compared with what flipping the signs of whole runs (a wild bootstrap), and what
    is uncertain in all of the session alike, would give. Benjamini and Hochberg (1995) over all tests; what explains
    too small a share of the variance does not matter and is not found.

    Args:
        measured: the session's residuals.
        reference: the reference's own.
        seed: of the draws.
        settings: of the tests; None: the defaults.
        reference_discrepancy: whether a dependence that the reference shows as well is no news.
        usual_spread: standard deviation between sessions of the log of the noise's: less than two of them is no news;
            None: that between sessions of one vehicle.
    """
    settings = settings or DependenceSettings()
    rng = np.random.default_rng(seed)
    tests = _situation_tests(measured, reference if reference_discrepancy else None, settings, rng)
    tests = [_joined_with_runs(test, measured) if test.part == "time" else test for test in tests]
    tests += _shape_tests(measured, reference, settings, rng)
    usual = MotionNoiseSettings().usual_spread if usual_spread is None else usual_spread
    return _controlled(tests, settings, usual)


def _situation_tests(
    measured: StandardisedResidual,
    reference: StandardisedResidual | None,
    settings: DependenceSettings,
    rng: np.random.Generator,
) -> list[Dependence]:
    reference_functions = _functions(reference.session) if reference else {}
    if reference and _vehicles(measured.session) != _vehicles(reference.session):
        reference_functions.pop("vehicle", None)
    return [
        _tested(part, functions, reference_functions.get(part), measured, reference, settings, rng)
        for part, functions in _functions(measured.session).items()
    ]


def _functions(session: MeasuredSession) -> dict[str, np.ndarray]:
    """Return for each part of the situation its functions (N, q)."""
    conditions, pose = session.conditions, session.transitions.pose
    encoding = residual_encoding(session.transitions.robot, conditions)
    columns = encoding(session.situation).double().numpy()
    command, previous, place, push = (
        columns[:, encoding.columns_of(feature)]
        for feature in ("command", "previous_command", "position", "neighbours")
    )
    time, duration = (columns[:, encoding.columns_of(feature)[0]] for feature in ("elapsed_s", "duration_s"))
    heading = pose[:, 2]
    wall_mm = conditions.wall_distance_mm(torch.as_tensor(pose[:, :2])).numpy()
    least_mm = float(min(conditions.arena_mm.high_mm - conditions.arena_mm.low_mm))
    parts = {
        "command": _polynomials(command),
        "previous_command": _polynomials(previous),
        "heading": np.stack([f(k * heading) for k in (1, 2, 3, 4) for f in (np.cos, np.sin)], axis=1),
        "position": np.concatenate([_polynomials(place), _bumps(place)], axis=1),
        "wall_distance": np.stack([np.exp(-wall_mm / (share * least_mm)) for share in (0.05, 0.15)], axis=1),
        "time": np.stack([*_since_start(session), time, time**2, time**3, np.sign(time), *_waves(time)], axis=1),
    }
    if duration.std() > 0.02:  # of a tenth of a period: below 0.2 % periods are constant
        parts["duration"] = np.stack([duration, duration**2], axis=1)
    if np.abs(push).max() > 0:
        parts["neighbours"] = push
    vehicles = np.unique(session.transitions.vehicle)
    if len(vehicles) > 1:
        parts["vehicle"] = (session.transitions.vehicle[:, None] == vehicles[None, 1:]).astype(float)
    return parts


def _vehicles(session: MeasuredSession) -> set[str]:
    """Return the ids of the vehicles that occur."""
    return {session.transitions.vehicles[index] for index in np.unique(session.transitions.vehicle)}


def _polynomials(values: np.ndarray) -> np.ndarray:
    """Return powers up to the third and products of pairs of values (N, k)."""
    columns = [*values.T, *(values**2).T, *(values**3).T]
    count = values.shape[1]
    columns += [values[:, a] * values[:, b] for a in range(count) for b in range(a)]
    return np.stack(columns, axis=1)


def _bumps(place: np.ndarray) -> np.ndarray:
    """Return nine Gaussian bumps (N, 9) over places (N, 2) in an arena from −1 to 1: they overlap by half."""
    centres = np.stack(np.meshgrid([-0.6, 0.0, 0.6], [-0.6, 0.0, 0.6]), axis=-1).reshape(-1, 2)
    distance2 = ((place[:, None] - centres) ** 2).sum(axis=-1)
    bumps: np.ndarray = np.exp(-distance2 / (2 * 0.3**2))
    return bumps


def _since_start(session: MeasuredSession) -> list[np.ndarray]:
    """Return functions of the time since each run began: decays over a few periods and over a dozen."""
    elapsed_s, period_s = session.transitions.time_s, session.transitions.robot.period_s
    began_s = np.full(session.runs, np.inf)
    np.minimum.at(began_s, session.run, elapsed_s)
    periods = (elapsed_s - began_s[session.run]) / period_s
    return [np.exp(-periods / 3), np.exp(-periods / 12)]


def _waves(time: np.ndarray) -> list[np.ndarray]:
    """Return waves over the session's time (N,) from −1 to 1: half a one, a whole one, two."""
    return [f(np.pi * k * time) for k in (1, 2, 4) for f in (np.cos, np.sin)]


def _tested(
    part: str,
    functions: np.ndarray,
    reference_functions: np.ndarray | None,
    measured: StandardisedResidual,
    reference: StandardisedResidual | None,
    settings: DependenceSettings,
    rng: np.random.Generator,
) -> Dependence:
    """Test one part: regressions of all three axes on its functions (N, q), less those of the reference."""
    statistic, drawn = 0.0, np.zeros(settings.draws)
    centre, spread = functions.mean(axis=0), np.maximum(functions.std(axis=0), 1e-9)
    most = max(2, measured.session.runs // settings.runs_a_regressor)
    sizes, sizes_there = (
        rng.normal(size=(settings.draws, sum(block.shape[1] for block in one.effects))) if one else np.empty(0)
        for one in (measured, reference)
    )
    for axis in range(3):

        def regressors(values: np.ndarray, of: StandardisedResidual, axis: int = axis) -> np.ndarray:
            alone = (values - centre) / spread
            return np.concatenate([alone, alone * of.size[:, [axis]]], axis=1)[:, :most]

        value, by_chance, information = _coefficients(
            regressors(functions, measured), measured, sizes, axis, settings, rng
        )
        if reference and reference_functions is not None and reference_functions.shape[1] == functions.shape[1]:
            there = regressors(reference_functions, reference)
            other, other_by_chance, _ = _coefficients(there, reference, sizes_there, axis, settings, rng)
            value, by_chance = value - other, by_chance - other_by_chance
        statistic += float(value @ information @ value)
        drawn += np.einsum("dp,pq,dq->d", by_chance, information, by_chance)
    usual = float(drawn.mean())
    shape = usual**2 / max(float(drawn.var()), 1e-12)
    p_value = float(stats.gamma.sf(statistic, shape, scale=usual / shape))
    explained = max(statistic - usual, 0.0) / max(float((measured.residual**2).sum()), 1e-9)
    return Dependence(part=part, statistic=statistic, p_value=p_value, explained=explained, found=False)


def _coefficients(
    regressors: np.ndarray,
    residuals: StandardisedResidual,
    sizes: np.ndarray,
    axis: int,
    settings: DependenceSettings,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return coefficients (q,), coefficients by chance (draws, q), and their information (q, q).

    `sizes` (draws, K) are those of the effects, by chance: one of each for all axes.
    """
    weighted = regressors * residuals.weight[:, None]
    information = regressors.T @ weighted
    ridge = settings.ridge * np.trace(information) / len(information)
    inverse = np.linalg.pinv(information + ridge * np.eye(len(information)))
    by_run = residuals.session.by_run(weighted * residuals.residual[:, [axis]])
    value = inverse @ by_run.sum(axis=0)
    signs = rng.choice([-1.0, 1.0], (settings.draws, len(by_run)))
    by_chance = (signs @ by_run + sizes @ residuals.effects_along(weighted, axis)) @ inverse
    return value, by_chance, information


def _joined_with_runs(test: Dependence, residuals: StandardisedResidual) -> Dependence:
    """Join to the test of time whether runs differ: both halves of one share an error, ahead or turning.

    That is one of a vehicle in a run beyond its mean over all its runs.
    """
    vehicle = residuals.session.transitions.vehicle
    _, part = np.unique(np.column_stack([residuals.session.run, vehicle]), axis=0, return_inverse=True)
    part = part.ravel()
    parts = int(part.max()) + 1
    owner = np.zeros(parts, int)
    owner[part] = vehicle
    later, weight = _in_second_half(part), residuals.weight
    products, shared = np.zeros(parts), 0.0
    for axis in (0, 2):
        size = residuals.size[:, axis]
        for regressor in (np.ones(len(size)), size):
            slopes, weights = (
                np.stack([np.bincount(part, values * (half == later), parts) for half in (False, True)])
                for values in (weight * regressor * residuals.residual[:, axis], weight * regressor**2)
            )
            usual, known = (np.bincount(owner, both.sum(axis=0)) for both in (slopes, weights))
            beyond = slopes - (usual / np.maximum(known, 1e-9))[owner] * weights
            product = beyond.prod(axis=0) / np.sqrt(np.maximum(weights.prod(axis=0), 1e-9))
            products += product
            shared += float(product.sum())
    deviation = float(products.sum() / max(np.sqrt((products**2).sum()), 1e-12))
    p_value = float(stats.norm.sf(deviation))
    if test.p_value <= p_value:
        return test.model_copy(update={"p_value": min(1.0, 2 * test.p_value)})
    explained = max(shared, 0.0) * 2 / max(float((residuals.residual**2).sum()), 1e-9)
    update = {
        "statistic": deviation,
        "p_value": min(1.0, 2 * p_value),
        "explained": max(explained, test.explained),
    }
    return test.model_copy(update=update)


def _in_second_half(part: np.ndarray) -> np.ndarray:
    """Return (N,) whether a transition lies in the second half of its part of the session, which parts (N,) number."""
    order = np.argsort(part, kind="stable")
    rank = np.empty(len(part), int)
    rank[order] = np.arange(len(part)) - np.searchsorted(part[order], part[order])
    later: np.ndarray = rank * 2 >= np.bincount(part)[part]
    return later


def _shape_tests(
    measured: StandardisedResidual,
    reference: StandardisedResidual,
    settings: DependenceSettings,
    rng: np.random.Generator,
) -> list[Dependence]:
    """Compare spread and tails with the reference's."""
    found = []
    tail_z = settings.tail_z
    for part, of in (("spread", lambda z: np.minimum(z**2, tail_z**2)), ("tails", lambda z: np.abs(z) > tail_z)):
        figures = []
        for residuals in (measured, reference):
            shape = of(residuals.by_usual_noise).mean(axis=1)
            counted = np.column_stack([shape, np.ones(len(shape))])
            by_run = residuals.session.by_run(counted * residuals.weight[:, None])
            weights = rng.multinomial(len(by_run), np.full(len(by_run), 1 / len(by_run)), settings.draws)
            resampled = weights @ by_run
            figures.append((by_run[:, 0].sum() / by_run[:, 1].sum(), (resampled[:, 0] / resampled[:, 1]).std()))
        (here, error), (there, other_error) = figures
        deviation = (here - there) / max(np.hypot(error, other_error), 1e-9)
        p_value = float(2 * stats.norm.sf(abs(deviation)))
        explained = float(here / max(there, 1e-9) - 1) if part == "spread" else float(here - there)
        found.append(
            Dependence(part=part, statistic=float(deviation), p_value=p_value, explained=explained, found=False)
        )
    return found


def _controlled(tests: list[Dependence], settings: DependenceSettings, usual_spread: float) -> list[Dependence]:
    """Mark what stands after Benjamini and Hochberg, and is large enough to be worth anyone's time."""
    stands = stats.false_discovery_control([test.p_value for test in tests]) <= settings.false_discovery_rate
    least = {"spread": math.expm1(4 * usual_spread), "tails": settings.least_tails_change}
    return [
        test.model_copy(
            update={"found": bool(stood) and abs(test.explained) >= least.get(test.part, settings.least_explained)}
        )
        for test, stood in zip(tests, stands, strict=True)
    ]
