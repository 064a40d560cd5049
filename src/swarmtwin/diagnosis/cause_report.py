"""Step 4. Causes as they are reported: parameters with intervals, confidence, rivals, evidence."""

from collections.abc import Mapping

import numpy as np

from swarmtwin.diagnosis.likelihood import LikelihoodModel
from swarmtwin.diagnosis.motion_noise import MotionNoise
from swarmtwin.diagnosis.posterior import Posterior
from swarmtwin.diagnosis.residual_analysis import ResidualAnalysis
from swarmtwin.diagnosis.result import Cause, Estimate
from swarmtwin.simulation.mechanism import Mechanism

Rivals = Mapping[str, np.ndarray]


def reported_causes(model: LikelihoodModel, analysis: ResidualAnalysis, rng: np.random.Generator) -> tuple[Cause, ...]:
    """Return the causes that stand, by share of the gap."""
    causes = []
    selected = analysis.causes
    if analysis.causes_are_reported and selected.posterior is not None:
        estimates = _estimates(model, selected.fitted.mechanisms, selected.posterior, rng)
        total = sum(max(nats, 1e-9) for nats in selected.evidence_nats)
        for mechanism, parameters, nats, rivals in zip(
            analysis.mechanisms, estimates, selected.evidence_nats, selected.rivals, strict=True
        ):
            nearest = sorted(rivals, key=lambda name: rivals[name].sum())
            causes.append(
                Cause(
                    name=mechanism.name,
                    parameters=parameters,
                    confidence=_confidence(rivals, model.settings.estimation.bootstraps, rng),
                    rivals=tuple(nearest),
                    share_of_gap=float(np.clip(analysis.share * max(nats, 0.0) / total, 0.0, 1.0)),
                    evidence=_evidence(model, nats, nearest, rivals),
                )
            )
    if analysis.motion_noise:
        causes.append(_noise_cause(analysis.motion_noise, 0.0 if causes else 1.0))
    return tuple(sorted(causes, key=lambda cause: -cause.share_of_gap))


def _evidence(model: LikelihoodModel, nats: float, nearest: list[str], rivals: Rivals) -> str:
    beside = (
        f"{nearest[0]} in its place is behind by {rivals[nearest[0]].sum():.1f}" if nearest else "no other comes near"
    )
    return f"log-likelihood of {model.session.runs} runs rises by {nats:.0f} with it; {beside}"


def _confidence(rivals: Rivals, draws: int, rng: np.random.Generator) -> float:
    """Return the share of resampled sessions in which no rival fits better."""
    if not rivals:
        return 1.0
    worse = np.stack(list(rivals.values()), axis=1)
    weights = rng.multinomial(len(worse), np.full(len(worse), 1 / len(worse)), draws)
    return float(((weights @ worse) > 0).all(axis=1).mean())


def _estimates(
    model: LikelihoodModel, mechanisms: tuple[Mechanism, ...], posterior: Posterior, rng: np.random.Generator
) -> list[dict[str, Estimate]]:
    """Return for each mechanism its parameters as they are reported, with intervals."""
    settings = model.settings.estimation
    kinds = [type(mechanism) for mechanism in mechanisms]
    parameters = model.parameters(kinds)
    drawn = posterior.draws(settings.bootstraps, rng)
    wider = np.array([kinds[number].interval_widening for number, _, _ in parameters])
    drawn = posterior.values + (drawn - posterior.values) * wider
    if parameters:
        low, high = ([getattr(parameter, end) for _, _, parameter in parameters] for end in ("low", "high"))
        drawn = np.clip(drawn, low, high)
    possible = [model.assembled(kinds, values) for values in drawn]
    estimates = []
    for index, mechanism in enumerate(mechanisms):
        if model.parameters([type(mechanism)]):
            samples = {
                name: np.array([one[index].reported()[name] for one in possible]) for name in mechanism.reported()
            }
        else:
            samples = _clock_samples(model, mechanism, rng)
        units = type(mechanism).units(model.robot, model.session.conditions)
        estimates.append(
            {
                name: _estimate(value, samples[name], units[name], settings.interval)
                for name, value in mechanism.reported().items()
            }
        )
    return estimates


def _estimate(value: float, samples: np.ndarray, unit: str, interval: float) -> Estimate:
    if unit == "rad":
        samples = value + np.angle(np.exp(1j * (samples - value)))
    low, high = np.quantile(samples, [(1 - interval) / 2, (1 + interval) / 2])
    return Estimate(value=value, low=float(low), high=float(high), unit=unit)


def _clock_samples(model: LikelihoodModel, mechanism: Mechanism, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return what resampled runs say of parameters that are read off the clock."""
    session = model.session
    duration_s = session.transitions.duration_s
    rows = [np.flatnonzero(session.run == run) for run in range(session.runs)]
    samples: dict[str, list[float]] = {name: [] for name in mechanism.reported()}
    for _ in range(model.settings.estimation.clock_bootstraps):
        chosen = np.concatenate([rows[run] for run in rng.integers(0, len(rows), len(rows))])
        seen = type(mechanism).read_from_clock(duration_s[chosen], model.robot.period_s) or {}
        for name, values in samples.items():
            values.append(seen.get(name, 0.0))
    return {name: np.array(values) for name, values in samples.items()}


def _noise_cause(noise: MotionNoise, share: float) -> Cause:
    return Cause(
        name="noise_change",
        parameters={"factor": Estimate(value=noise.factor, low=noise.low, high=noise.high, unit="")},
        confidence=1.0,
        rivals=(),
        share_of_gap=share,
        evidence=f"the random part of the motion is {abs(noise.errors):.0f} standard errors from the reference's, its "
        "mean as it was; the camera's part is told apart by how neighbouring residuals disagree",
    )
