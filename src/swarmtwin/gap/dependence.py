"""What a residual depends on: score tests with runs as blocks, false discoveries controlled over all of them."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import stats

from swarmtwin.gap.base import AnyBase
from swarmtwin.gap.diagnosis import Dependence
from swarmtwin.gap.fitting import Fit, Problem
from swarmtwin.gap.learned import columns as all_columns
from swarmtwin.gap.noise import residual_of
from swarmtwin.gap.session import Session

DRAWS = 400
FALSE_DISCOVERY_RATE = 0.01
LEAST_EXPLAINED = 0.006
LARGEST_Z = 5.0
FAR_Z = 3.5


@dataclass(frozen=True)
class Examined:
    """A session's residuals, ready for tests.

    Attributes:
        session: of N transitions in R runs.
        residual: (N, 3) standardised.
        size: (N, 3) simulated ways over usual ones.
        members: (M, N, 3) what the simulation's members would change of the residual; M may be 0.
        weight: (N,) how much each transition counts.
    """

    session: Session
    residual: np.ndarray
    size: np.ndarray
    members: np.ndarray
    weight: np.ndarray

    @classmethod
    def of(cls, problem: Problem, fit: Fit, base: AnyBase | None, weight: np.ndarray | None = None) -> "Examined":
        """Take the residuals of a fit."""
        size = problem.whitener.size.numpy()
        clipped = np.clip(fit.residual, -LARGEST_Z, LARGEST_Z)
        weight = np.ones(len(clipped)) if weight is None else weight
        return cls(problem.session, clipped, size, member_changes(problem, base), weight)


def member_changes(problem: Problem, base: AnyBase | None) -> np.ndarray:
    """Return (M, N, 3) how standardised residuals change with single members of the simulation."""
    members = base.members if base else 0
    drive = problem.session.drive
    mean = problem.whitener(residual_of(problem.session, problem.simulated))
    changes = []
    for member in range(members):
        assert base is not None
        base.member = member
        try:
            way = base.way(drive.command, drive.previous_command, drive.pose)
        finally:
            base.member = None
        changes.append((problem.whitener(residual_of(problem.session, way)) - mean).numpy())
    return np.array(changes) if changes else np.empty((0, len(problem.session), 3))


def dependences(measured: Examined, known: Examined, seed: int, forgives: bool = True) -> list[Dependence]:
    """Test what residuals depend on beyond what the reference's own residuals do.

    For each part of the situation its functions, alone and times the motion, are regressed upon; the difference of the
    coefficients to the reference's is compared with what flipping the signs of whole runs, and exchanging the
    simulation's members, would give. Benjamini and Hochberg (1995) over all tests; what explains less than 0.6 % of the
    variance does not matter and is not found.
    """
    rng = np.random.default_rng(seed)
    tests = _each_part(measured, known if forgives else None, rng)
    tests = [_with_runs(test, measured) if test.part == "time" else test for test in tests]
    tests += _shape_tests(measured, known, rng)
    return _controlled(tests)


def tested_parts(measured: Examined, known: Examined, rng: np.random.Generator) -> list[Dependence]:
    """Test the parts of the situation alone, false discoveries controlled over them."""
    return _controlled(_each_part(measured, known, rng))


def _each_part(measured: Examined, known: Examined | None, rng: np.random.Generator) -> list[Dependence]:
    known_parts = _functions(known.session) if known else {}
    return [
        _tested(part, functions, known_parts.get(part), measured, known, rng)
        for part, functions in _functions(measured.session).items()
    ]


def _functions(session: Session) -> dict[str, np.ndarray]:
    """Return for each part of the situation its functions (N, q)."""
    drive, count = session.drive, len(session.drive.robot.command)
    columns = all_columns(drive).double().numpy()
    command, previous = columns[:, :count], columns[:, count : 2 * count]
    heading = drive.pose[:, 2].numpy()
    place = columns[:, 2 * count + 2 : 2 * count + 4]
    time = columns[:, 2 * count + 4]
    surroundings = drive.surroundings
    wall_mm = surroundings.wall_distance_mm(drive.pose[:, :2]).numpy()
    least_mm = float(min(surroundings.arena_mm.high_mm - surroundings.arena_mm.low_mm))
    parts = {
        "command": _polynomials(command),
        "previous_command": _polynomials(previous),
        "heading": np.stack([f(k * heading) for k in (1, 2, 3, 4) for f in (np.cos, np.sin)], axis=1),
        "position": np.concatenate([_polynomials(place), _bumps(place)], axis=1),
        "wall_distance": np.stack([np.exp(-wall_mm / (share * least_mm)) for share in (0.05, 0.15)], axis=1),
        "time": np.stack([*_since_start(session), time, time**2, time**3, np.sign(time), *_waves(time)], axis=1),
    }
    duration = columns[:, 2 * count + 5]
    if duration.std() > 0.02:
        parts["duration"] = np.stack([duration, duration**2], axis=1)
    push = columns[:, 2 * count + 6 :]
    if np.abs(push).max() > 0:
        parts["neighbours"] = push
    vehicles = np.unique(session.transitions.vehicle)
    if len(vehicles) > 1:
        parts["vehicle"] = (session.transitions.vehicle[:, None] == vehicles[None, 1:]).astype(float)
    return parts


def _polynomials(values: np.ndarray) -> np.ndarray:
    columns = [*values.T, *(values**2).T, *(values**3).T]
    count = values.shape[1]
    columns += [values[:, a] * values[:, b] for a in range(count) for b in range(a)]
    return np.stack(columns, axis=1)


def _bumps(place: np.ndarray) -> np.ndarray:
    centres = np.stack(np.meshgrid([-0.6, 0.0, 0.6], [-0.6, 0.0, 0.6]), axis=-1).reshape(-1, 2)
    distance2 = ((place[:, None] - centres) ** 2).sum(axis=-1)
    bumps: np.ndarray = np.exp(-distance2 / (2 * 0.3**2))
    return bumps


def _since_start(session: Session) -> list[np.ndarray]:
    """Return functions of the time since each run began."""
    elapsed_s, period_s = session.transitions.time_s, session.drive.robot.period_s
    began_s = np.full(session.runs, np.inf)
    np.minimum.at(began_s, session.run, elapsed_s)
    periods = (elapsed_s - began_s[session.run]) / period_s
    return [np.exp(-periods / 3), np.exp(-periods / 12)]


def _waves(time: np.ndarray) -> list[np.ndarray]:
    return [f(np.pi * k * time) for k in (1, 2, 4) for f in (np.cos, np.sin)]


def _tested(
    part: str,
    functions: np.ndarray,
    known_functions: np.ndarray | None,
    measured: Examined,
    known: Examined | None,
    rng: np.random.Generator,
) -> Dependence:
    statistic, drawn = 0.0, np.zeros(DRAWS)
    centre, spread = functions.mean(axis=0), np.maximum(functions.std(axis=0), 1e-9)
    for axis in range(3):
        alone = (functions - centre) / spread
        regressors = _trimmed(np.concatenate([alone, alone * measured.size[:, [axis]]], axis=1), measured.session.runs)
        own = _coefficients(regressors, measured, axis, rng)
        value, chances, information = own
        if known and known_functions is not None and known_functions.shape[1] == functions.shape[1]:
            there = (known_functions - centre) / spread
            same = np.concatenate([there, there * known.size[:, [axis]]], axis=1)[:, : regressors.shape[1]]
            other, other_chances, _ = _coefficients(same, known, axis, rng)
            value, chances = value - other, chances - other_chances
        statistic += float(value @ information @ value)
        drawn += np.einsum("dp,pq,dq->d", chances, information, chances)
    usual = float(drawn.mean())
    shape = usual**2 / max(float(drawn.var()), 1e-12)
    p_value = float(stats.gamma.sf(statistic, shape, scale=usual / shape))
    explained = max(statistic - usual, 0.0) / max(float((measured.residual**2).sum()), 1e-9)
    return Dependence(part=part, statistic=statistic, p_value=p_value, explained=explained, found=False)


def _trimmed(regressors: np.ndarray, runs: int) -> np.ndarray:
    return regressors[:, : max(2, min(regressors.shape[1], runs // 3))]


def _coefficients(
    regressors: np.ndarray, examined: Examined, axis: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return coefficients (q,), coefficients by chance (draws, q), and their information (q, q)."""
    weighted = regressors * examined.weight[:, None]
    information = regressors.T @ weighted
    inverse = np.linalg.pinv(information + 1e-3 * np.trace(information) / len(information) * np.eye(len(information)))
    by_run = examined.session.by_run(weighted * examined.residual[:, [axis]])
    value = inverse @ by_run.sum(axis=0)
    signs = rng.choice([-1.0, 1.0], (DRAWS, len(by_run)))
    chances = signs @ by_run @ inverse
    if len(examined.members) > 1:
        moved = np.einsum("nq,mn->mq", regressors, examined.members[:, :, axis]) @ inverse
        moved -= moved.mean(axis=0)
        members = len(moved)
        weights = rng.standard_t(members - 1, (DRAWS, members)) * np.sqrt((members - 1) / members)
        chances = chances + weights @ moved
    return value, chances, information


def _with_runs(test: Dependence, examined: Examined) -> Dependence:
    """Join to the test of time whether runs differ: both halves of a run err in the same way, ahead or turning."""
    session = examined.session
    rank = np.arange(len(session)) - np.searchsorted(session.run, session.run)
    length = np.bincount(session.run)[session.run]
    later = rank * 2 >= length
    products, shared = np.zeros(session.runs), 0.0
    for axis in (0, 2):
        size = examined.size[:, axis]
        for regressor in (np.ones(len(size)), size):
            slopes, weights = (
                [session.by_run(values * (half == later)) for half in (False, True)]
                for values in (regressor * examined.residual[:, axis], regressor**2)
            )
            product = slopes[0] * slopes[1] / np.sqrt(np.maximum(weights[0] * weights[1], 1e-9))
            products += product
            shared += float(product.sum())
    deviation = float(products.sum() / max(np.sqrt((products**2).sum()), 1e-12))
    p_value = float(stats.norm.sf(deviation))
    explained = max(shared, 0.0) * 2 / max(float((examined.residual**2).sum()), 1e-9)
    if 2 * min(p_value, test.p_value) == 2 * test.p_value:
        return test.model_copy(update={"p_value": min(1.0, 2 * test.p_value)})
    best = max(explained, test.explained)
    return test.model_copy(update={"statistic": deviation, "p_value": min(1.0, 2 * p_value), "explained": best})


def _shape_tests(measured: Examined, known: Examined, rng: np.random.Generator) -> list[Dependence]:
    """Compare spread and tails with the reference's."""
    found = []
    for part, of in (("spread", lambda z: np.minimum(z**2, FAR_Z**2)), ("tails", lambda z: np.abs(z) > FAR_Z)):
        figures = []
        for examined in (measured, known):
            counted = np.column_stack([of(examined.residual).mean(axis=1), np.ones(len(examined.residual))])
            by_run = examined.session.by_run(counted * examined.weight[:, None])
            weights = rng.multinomial(len(by_run), np.full(len(by_run), 1 / len(by_run)), DRAWS)
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


def _controlled(tests: list[Dependence]) -> list[Dependence]:
    """Mark what stands after Benjamini and Hochberg, and matters."""
    order = np.argsort([test.p_value for test in tests])
    limit = -1.0
    for rank, index in enumerate(order, start=1):
        if tests[index].p_value <= FALSE_DISCOVERY_RATE * rank / len(tests):
            limit = tests[index].p_value
    return [test.model_copy(update={"found": test.p_value <= limit and matters(test)}) for test in tests]


def matters(test: Dependence) -> bool:
    """Say whether a dependence is large enough to be worth anyone's time."""
    least: Mapping[str, float] = {"spread": 0.1, "tails": 0.004}
    return abs(test.explained) >= least.get(test.part, LEAST_EXPLAINED)
