"""Step 4. Causes as they are reported: parameters with intervals, confidence, rivals, evidence."""

from collections.abc import Sequence

import numpy as np

from swarmtwin.diagnosis.cause_search import CausePosterior
from swarmtwin.diagnosis.estimated_set import EstimatedSet
from swarmtwin.diagnosis.estimation import estimate
from swarmtwin.diagnosis.explanation import Explanation
from swarmtwin.diagnosis.likelihood import SessionLikelihood
from swarmtwin.diagnosis.motion_noise_change import MotionNoiseChange
from swarmtwin.diagnosis.result import ENDS, Cause, CauseSet, Estimate, EstimatedCause
from swarmtwin.diagnosis.settings import VerdictSettings
from swarmtwin.simulation.mechanism import Mechanism


def likeliest_causes(explained: Explanation, rng: np.random.Generator) -> tuple[EstimatedCause, ...]:
    """Return the causes that are the likeliest together, named or not, with intervals drawn by `rng`."""
    estimates = reported_parameters(explained.model, explained.best, rng)
    return tuple(
        EstimatedCause(name=one.name, parameters=estimates[one.name], form=one.form())
        for one in explained.best.mechanisms
    )


def reported_causes(explained: Explanation, likeliest: Sequence[EstimatedCause]) -> tuple[Cause, ...]:
    """Return those of the likeliest causes that stand, by share of the gap, and noise that changed."""
    posterior, settings = explained.posterior, explained.model.settings.search
    verdict = explained.model.settings.verdict
    nats, transitions = _missed_nats(explained)
    total = sum(max(one, 1e-9) for one in nats.values())
    causes = []
    estimated = {one.name: one for one in likeliest}
    for name in explained.names:
        rivals = posterior.rivals(name, settings.rival_from)
        share = explained.share * max(nats[name], 0.0) / max(total, 1e-9)
        causes.append(
            Cause(
                name=name,
                parameters=estimated[name].parameters,
                form=estimated[name].form,
                posterior=posterior.probability(name),
                confidence=verdict.confidence(name, posterior.probability(name)),
                rivals=rivals,
                share_of_gap=float(np.clip(share, 0.0, 1.0)),
                evidence=_evidence(explained, name, nats[name], transitions, rivals),
            )
        )
    if explained.names_motion_noise:
        causes.append(_noise_cause(explained.motion_noise, verdict, 0.0 if causes else 1.0))
    return tuple(sorted(causes, key=lambda cause: -cause.share_of_gap))


def leading_sets(posterior: CausePosterior, most: int) -> tuple[CauseSet, ...]:
    """Return the most probable sets of causes, at most so many; that of no cause is one of them."""
    sets = [
        CauseSet(causes=names, probability=min(probability, 1.0), log_evidence=evidence)
        for names, probability, evidence in posterior.by_names()
    ]
    leading, nothing = sets[:most], [one for one in sets[most:] if not one.causes]
    return (*leading[: most - len(nothing)], *nothing)


def reported_parameters(
    model: SessionLikelihood, found: EstimatedSet, rng: np.random.Generator
) -> dict[str, dict[str, Estimate]]:
    """Return for each mechanism of a set its parameters as they are reported, with intervals drawn by `rng`."""
    settings = model.settings.estimation
    kinds = [type(mechanism) for mechanism in found.mechanisms]
    parameters = model.parameters(kinds)
    drawn = found.draws(settings.draws, rng)
    if parameters:
        low, high = ([getattr(parameter, end) for _, _, parameter in parameters] for end in ("low", "high"))
        drawn = np.clip(drawn, low, high)
    possible = [model.assembled(kinds, values) for values in drawn]
    estimates = {}
    for index, mechanism in enumerate(found.mechanisms):
        if model.parameters([type(mechanism)]):
            samples = {
                name: np.array([one[index].reported()[name] for one in possible]) for name in mechanism.reported()
            }
        else:
            samples = _clock_samples(model, mechanism, rng)
        units = type(mechanism).units(model.robot, model.session.conditions)
        estimates[mechanism.name] = {
            name: _estimate(value, samples[name], units[name]) for name, value in mechanism.reported().items()
        }
    return estimates


def _missed_nats(explained: Explanation) -> tuple[dict[str, float], int]:
    """Return by how many nats a session is less likely without each cause, the others fitted anew, and its transitions.

    These are the part of the session that was searched; where the search did not fit one of these sets of causes, they
    are all that was fitted to.
    """
    best, posterior = explained.best, explained.posterior
    others = {name: [one for one in best.mechanisms if one.name != name] for name in explained.names}
    together = posterior.of_names(best.names)
    beside = {name: posterior.of_names([one.name for one in rest]) for name, rest in others.items()}
    if together is None or not all(beside.values()):
        together = best
        beside = {name: estimate(explained.model, rest, polish=True) for name, rest in others.items()}
    nats = {name: together.fitted.total - one.fitted.total for name, one in beside.items() if one}
    return nats, len(together.fitted.residual)


def _evidence(explained: Explanation, name: str, nats: float, transitions: int, rivals: tuple[str, ...]) -> str:
    posterior = explained.posterior
    beside = "no other cause comes near"
    if rivals:
        sets = zip(posterior.sets, posterior.log_probability, strict=True)
        other, log = next((one, log) for one, log in sets if name not in one.names)
        behind, named = float(posterior.log_probability[0] - log), " + ".join(other.names) or "no cause"
        beside = f"the most probable set without it, {named}, is less probable by {behind:.1f} nats"
    return f"log-likelihood of {transitions:,} transitions rises by {nats:.0f} with it; {beside}"


def _estimate(value: float, samples: np.ndarray, unit: str) -> Estimate:
    if unit == "rad":
        samples = value + np.angle(np.exp(1j * (samples - value)))
    low, high = np.quantile(samples, ENDS)
    return Estimate(value=value, low=float(low), high=float(high), unit=unit)


def _clock_samples(model: SessionLikelihood, mechanism: Mechanism, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return what resampled runs say of parameters that are read off the clock."""
    session = model.session
    duration_s = session.transitions.duration_s
    rows = [np.flatnonzero(session.run == run) for run in range(session.runs)]
    samples: dict[str, list[float]] = {name: [] for name in mechanism.reported()}
    bounds = type(mechanism).bounds_of(model.robot, session.conditions)
    usual = {name: bounds[name].null_value or 0.0 for name in samples}
    for _ in range(model.settings.estimation.clock_bootstraps):
        chosen = np.concatenate([rows[run] for run in rng.integers(0, len(rows), len(rows))])
        seen = type(mechanism).read_from_clock(duration_s[chosen], model.robot) or {}
        for name, values in samples.items():
            values.append(seen.get(name, usual[name]))
    return {name: np.array(values) for name, values in samples.items()}


def _noise_cause(noise: MotionNoiseChange, verdict: VerdictSettings, share: float) -> Cause:
    return Cause(
        name="noise_change",
        parameters={"factor": Estimate(value=noise.factor, low=noise.low, high=noise.high, unit="")},
        posterior=noise.probability,
        confidence=verdict.confidence("noise_change", noise.probability),
        rivals=(),
        share_of_gap=share,
        evidence=f"the random part of the motion is {noise.factor:.2f} times the reference's, its mean as it was; the "
        "camera's part is told apart by how neighbouring errors disagree",
    )
