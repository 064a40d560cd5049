"""Named causes as they are told: parameters with intervals, confidence, rivals, evidence."""

from collections.abc import Mapping

import numpy as np

from swarmtwin.gap.certainty import Certainty
from swarmtwin.gap.diagnosis import Cause, Estimate
from swarmtwin.gap.examination import Examination, Found
from swarmtwin.gap.fitting import Fit
from swarmtwin.gap.mechanism import Mechanism
from swarmtwin.gap.spread import Spread

BOOTSTRAPS = 1000
INTERVAL = (0.025, 0.975)

Rivals = Mapping[str, np.ndarray]


def told_causes(examination: Examination, found: Found) -> tuple[Cause, ...]:
    """Return the causes that stand, by share of the gap."""
    causes = []
    if found.are_named and found.named.certainty is not None:
        estimates = _estimates(examination, found.named.certainty, found.named.fit)
        total = sum(max(news, 1e-9) for news in found.named.news)
        for mechanism, parameters, news, rivals in zip(
            found.mechanisms, estimates, found.named.news, found.named.rivals, strict=True
        ):
            share = float(np.clip(found.share * max(news, 0.0) / total, 0.0, 1.0))
            causes.append(_told(mechanism, parameters, news, rivals, share, examination))
    if found.spread:
        causes.append(_noise_cause(found.spread, 0.0 if causes else 1.0))
    return tuple(sorted(causes, key=lambda cause: -cause.share_of_gap))


def _told(
    mechanism: Mechanism,
    parameters: dict[str, Estimate],
    news: float,
    rivals: Rivals,
    share: float,
    examination: Examination,
) -> Cause:
    nearest = sorted(rivals, key=lambda name: rivals[name].sum())
    beside = (
        f"{nearest[0]} in its place is behind by {rivals[nearest[0]].sum():.1f}" if nearest else "no other comes near"
    )
    return Cause(
        name=mechanism.name,
        parameters=parameters,
        confidence=_confidence(rivals, examination.rng),
        rivals=tuple(nearest),
        share_of_gap=share,
        evidence=f"log-likelihood of {examination.problem.session.runs} runs rises by {news:.0f} with it; {beside}",
    )


def _confidence(rivals: Rivals, rng: np.random.Generator) -> float:
    """Return the share of resampled sessions in which no rival fits better."""
    if not rivals:
        return 1.0
    worse = np.stack(list(rivals.values()), axis=1)
    weights = rng.multinomial(len(worse), np.full(len(worse), 1 / len(worse)), BOOTSTRAPS)
    return float(((weights @ worse) > 0).all(axis=1).mean())


def _estimates(examination: Examination, certainty: Certainty, fit: Fit) -> list[dict[str, Estimate]]:
    """Return for each mechanism its parameters as they are told, with 95 % intervals."""
    problem = examination.problem
    quantities = [quantity for _, _, quantity in problem.quantities(fit.kinds)]
    drawn = certainty.draws(BOOTSTRAPS, examination.rng)
    wider = np.array([fit.kinds[number].widening for number, _, _ in problem.quantities(fit.kinds)])
    drawn = certainty.values + (drawn - certainty.values) * wider
    if quantities:
        drawn = np.clip(drawn, [quantity.low for quantity in quantities], [quantity.high for quantity in quantities])
    told = [problem.assembled(fit.kinds, values) for values in drawn]
    estimates = []
    for index, mechanism in enumerate(fit.mechanisms):
        if type(mechanism).quantities_of(problem.robot):
            samples = {name: np.array([one[index].reported()[name] for one in told]) for name in mechanism.reported()}
        else:
            samples = _read_off(examination, mechanism)
        units = type(mechanism).units(problem.robot)
        estimates.append(
            {name: _estimate(value, samples[name], units[name]) for name, value in mechanism.reported().items()}
        )
    return estimates


def _estimate(value: float, samples: np.ndarray, unit: str) -> Estimate:
    if unit == "rad":
        samples = value + np.angle(np.exp(1j * (samples - value)))
    low, high = np.quantile(samples, INTERVAL)
    return Estimate(value=value, low=float(low), high=float(high), unit=unit)


def _read_off(examination: Examination, mechanism: Mechanism) -> dict[str, np.ndarray]:
    """Return what resampled runs say of parameters that are read off the clock."""
    session = examination.problem.session
    duration_s, period_s = session.transitions.duration_s, session.drive.robot.period_s
    rows = [np.flatnonzero(session.run == run) for run in range(session.runs)]
    samples: dict[str, list[float]] = {name: [] for name in mechanism.reported()}
    for _ in range(BOOTSTRAPS // 5):
        chosen = np.concatenate([rows[run] for run in examination.rng.integers(0, len(rows), len(rows))])
        seen = type(mechanism).observed(duration_s[chosen], period_s) or {}
        for name, values in samples.items():
            values.append(seen.get(name, 0.0))
    return {name: np.array(values) for name, values in samples.items()}


def _noise_cause(spread: Spread, share: float) -> Cause:
    return Cause(
        name="noise_change",
        parameters={"factor": Estimate(value=spread.factor, low=spread.low, high=spread.high, unit="")},
        confidence=1.0,
        rivals=(),
        share_of_gap=share,
        evidence=f"the random part of the motion is {abs(spread.errors):.0f} standard errors from the reference's, its "
        "mean as it was; the camera's part is told apart by how neighbouring residuals disagree",
    )
