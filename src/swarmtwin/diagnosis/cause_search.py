"""Step 3. Causes are added one after the other: the best is taken, then each is tried against every other one."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from swarmtwin.diagnosis.estimation import GainEstimate, estimate, gain_estimate, local_traction_score
from swarmtwin.diagnosis.likelihood import FittedMechanisms, LikelihoodModel, MechanismClass, loses_commands
from swarmtwin.diagnosis.posterior import Posterior, posterior
from swarmtwin.simulation.mechanism import Mechanism

Progress = Callable[[str, int, int], None]
"""Called with what is being done, how much of it is done, and of how much."""


@dataclass(frozen=True)
class SelectedCauses:
    """The causes that explain a session best.

    Attributes:
        fitted: the mechanisms with their values.
        posterior: of these values; None where there is no cause.
        evidence_nats: for each cause, by how much it is missed when it is left out, penalties taken off.
        rivals: for each cause, those that fit in its place nearly as well, with what their fit is worse by, (R,) nats.
    """

    fitted: FittedMechanisms
    posterior: Posterior | None
    evidence_nats: tuple[float, ...]
    rivals: tuple[Mapping[str, np.ndarray], ...]

    def estimated_in(self, model: LikelihoodModel) -> "SelectedCauses":
        """Return the same causes with values estimated in another, larger session."""
        if not self.fitted.mechanisms:
            return replace(self, fitted=model.evaluate([]))
        fitted = estimate(model, self.fitted.mechanisms)
        return replace(self, fitted=fitted, posterior=posterior(model, fitted))


class CauseSearch:
    """A search for the causes in one session.

    Args:
        model: of the session.
        reference_model: of the reference's own transitions, answered by what has not seen them.
        kinds: the mechanisms offered, by name.
        reference_discrepancy: whether what improves the reference as well is its own discrepancy, and no evidence.
        progress: called with what is being tried.
    """

    def __init__(
        self,
        model: LikelihoodModel,
        reference_model: LikelihoodModel,
        kinds: Mapping[str, MechanismClass],
        reference_discrepancy: bool = True,
        progress: Progress | None = None,
    ) -> None:
        self.model, self.reference_model = model, reference_model
        self.settings = model.settings.search
        self.kinds = {name: kind for name, kind in kinds.items() if model.can_show(kind)}
        self.reference_discrepancy, self.progress = reference_discrepancy, progress
        self._fitted: dict[frozenset[str], FittedMechanisms] = {}
        self._gain_estimates: dict[frozenset[str], dict[str, GainEstimate]] = {}
        self._changes: dict[str, np.ndarray] = {}
        self._nothing = model.evaluate([])
        self._reference_nothing = reference_model.evaluate([])
        self._reference_weight = model.session.covariate_overlap(
            reference_model.session, model.settings.reference.overlap_neighbours
        )
        settings = self.settings
        self.least = max(settings.fewest_nats, settings.fewest_nats_a_transition * len(model.session))

    def run(self) -> SelectedCauses:
        """Add the best cause, exchange what fits better otherwise, drop what is not needed; until nothing helps."""
        chosen = self._nothing
        for _ in range(self.settings.most_causes):
            better = self._exchanged(self._grown(chosen))
            if better is None or len(better.mechanisms) <= len(chosen.mechanisms):
                break
            chosen = better
        chosen = self._pruned(chosen)
        if not chosen.mechanisms:
            return SelectedCauses(chosen, None, (), ())
        causes = range(len(chosen.mechanisms))
        evidence = tuple(self._evidence_nats(chosen, self._without(chosen, index)) for index in causes)
        rivals = tuple(self._rivals(chosen, index) for index in causes)
        return SelectedCauses(chosen, posterior(self.model, chosen), evidence, rivals)

    def _fit(self, beside: FittedMechanisms, name: str) -> FittedMechanisms:
        """Fit a mechanism together with others, from where these are."""
        key = frozenset([*beside.names, name])
        if key not in self._fitted:
            self._fitted[key] = estimate(self.model, self._gains_beside(beside)[name].start)
        return self._fitted[key]

    def _without(self, chosen: FittedMechanisms, index: int) -> FittedMechanisms:
        others = [one for number, one in enumerate(chosen.mechanisms) if number != index]
        key = frozenset(other.name for other in others)
        if key not in self._fitted:
            self._fitted[key] = estimate(self.model, others)
        return self._fitted[key]

    def _gains_beside(self, fitted: FittedMechanisms) -> dict[str, GainEstimate]:
        """Return what each mechanism may gain beside others."""
        key = frozenset(fitted.names)
        if key not in self._gain_estimates:
            traction = local_traction_score(self.model, fitted)
            self._gain_estimates[key] = {
                name: gain_estimate(self.model, fitted, kind, traction)
                for name, kind in self.kinds.items()
                if name not in fitted.names
            }
        return self._gain_estimates[key]

    def _promising(self, fitted: FittedMechanisms, needed: float) -> list[str]:
        """Return the mechanisms that could gain so many nats beside others, the most promising first."""
        gains = self._gains_beside(fitted)
        return sorted((name for name in gains if gains[name].nats > needed), key=lambda name: -gains[name].nats)

    def _grown(self, chosen: FittedMechanisms) -> FittedMechanisms | None:
        """Return the best fit with one mechanism more, None where none is worth it."""
        best, most = None, self.least
        gains, tried_share = self._gains_beside(chosen), self.settings.tried_share
        names = self._promising(chosen, tried_share * self.least)
        for number, name in enumerate(names):
            if self.progress:
                self.progress(f"cause {len(chosen.mechanisms) + 1}", number, len(names))
            needed = max(most, self._needed_beside(chosen, gains[name].change))
            if gains[name].nats < tried_share * needed:
                continue
            found = self._fit(chosen, name)
            if found.total - chosen.total > needed and (evidence := self._evidence_nats(found, chosen)) > needed:
                best, most = found, evidence
        return best

    def _needed_beside(self, chosen: FittedMechanisms, change: np.ndarray) -> float:
        """Return the nats that a further cause must bring: the more, the more it looks like one already there.

        A mechanism is never exact. What it leaves is like itself, and must not be taken for a second cause.
        """
        needed = self.settings.least_share * (chosen.total - self._nothing.total)
        for index, mechanism in enumerate(chosen.mechanisms):
            if mechanism.name not in self._changes:
                alone = self.model.evaluate([mechanism])
                self._changes[mechanism.name] = (alone.residual - self._nothing.residual).ravel()
            other = self._changes[mechanism.name]
            size = float(np.linalg.norm(change) * np.linalg.norm(other))
            alike = abs(float(change @ other)) / max(size, 1e-12)
            gained = chosen.total - self._without(chosen, index).total
            needed = max(needed, mechanism.share_left_over * alike * gained)
        return needed

    def _exchanged(self, chosen: FittedMechanisms | None) -> FittedMechanisms | None:
        """Exchange single mechanisms as long as another one fits better in their place."""
        if chosen is None or len(chosen.mechanisms) < 2:
            return chosen
        for _ in range(len(chosen.mechanisms) + 1):
            better = self._best_exchange(chosen)
            if better is None:
                return chosen
            chosen = better
        return chosen

    def _best_exchange(self, chosen: FittedMechanisms) -> FittedMechanisms | None:
        best = None
        for index in range(len(chosen.mechanisms)):
            others = self._without(chosen, index)
            for name in self._promising(others, self.settings.exchange_tried_share * (chosen.total - others.total)):
                if name in chosen.names:
                    continue
                found = self._fit(others, name)
                standing = best or chosen
                needed = self._needed_beside(others, self._gains_beside(others)[name].change)
                if found.total - others.total < needed:
                    continue
                more = max(self._more_parameters(found, standing), 0)
                if found.total > standing.total + self.settings.exchange_nats + more:
                    best = found
        return best

    def _more_parameters(self, found: FittedMechanisms, standing: FittedMechanisms) -> int:
        return len(self.model.values(found.mechanisms)) - len(self.model.values(standing.mechanisms))

    def _pruned(self, chosen: FittedMechanisms) -> FittedMechanisms:
        """Drop mechanisms that the others make superfluous."""
        while len(chosen.mechanisms) > 1:
            fewer = [self._without(chosen, index) for index in range(len(chosen.mechanisms))]
            evidence = [self._evidence_nats(chosen, fitted) for fitted in fewer]
            if min(evidence) > self.least:
                return chosen
            chosen = fewer[int(np.argmin(evidence))]
        return chosen

    def _evidence_nats(self, larger: FittedMechanisms, smaller: FittedMechanisms) -> float:
        """Return the nats that a fit is better by than a smaller one, beyond chance and the reference's discrepancy."""
        settings = self.settings
        gained = larger.total - smaller.total
        added = [mechanism for mechanism in larger.mechanisms if mechanism.name not in smaller.names]
        discrepancy = self._discrepancy_nats(added, larger, smaller)
        optimism = posterior(self.model, larger).optimism
        if smaller.mechanisms:
            optimism -= posterior(self.model, smaller).optimism
        searched = settings.jump_nats * sum(not mechanism.is_smooth for mechanism in added)
        by_run = self.model.session.by_run(larger.log_likelihood - smaller.log_likelihood)
        errors = by_run.sum() / max(by_run.std() * np.sqrt(len(by_run)), 1e-9)
        is_large = gained >= settings.large_gain * self.least
        if errors < (settings.fewest_errors_of_large if is_large else settings.fewest_errors):
            return -np.inf
        return gained - discrepancy - settings.penalty_weight * max(optimism, 0.0) - searched

    def _discrepancy_nats(
        self, added: Sequence[Mechanism], larger: FittedMechanisms, smaller: FittedMechanisms
    ) -> float:
        """Return the nats of a gain that the reference would show as well: there the simulation is weak, no more.

        Where mechanisms would change the reference's residuals by d, they go along with d by a slope α, 0 if nothing is
        wrong with the simulation. As far as that is so, α Σ d² nats of the session's gain are no evidence.
        """
        if not self.reference_discrepancy:
            return 0.0
        model, nothing, clip_z = self.reference_model, self._reference_nothing, self.settings.clip_z
        with_added = model.evaluate(added)
        if loses_commands([type(mechanism) for mechanism in added]):
            return max(0.0, float((with_added.log_likelihood - nothing.log_likelihood) @ self._reference_weight))
        change = (nothing.residual - with_added.residual).clip(-clip_z, clip_z)
        along = (nothing.residual.clip(-clip_z, clip_z) * change).sum(axis=1)
        size = float((change**2).sum())
        by_run = model.session.by_run(along)
        slope = (float(along.sum()) + float(by_run.std()) * np.sqrt(len(by_run))) / max(size, 1e-9)
        here = (smaller.residual - larger.residual).clip(-clip_z, clip_z) / larger.residual_scale
        return max(slope, 0.0) * float((here**2).sum()) if size > 0 else 0.0

    def _rivals(self, chosen: FittedMechanisms, index: int) -> dict[str, np.ndarray]:
        """Return by name what fits nearly as well in the place of a cause, and by how much less in each run, (R,)."""
        settings = self.settings
        others = self._without(chosen, index)
        found = {}
        for name in self._promising(others, settings.exchange_tried_share * (chosen.total - others.total)):
            if name in chosen.names:
                continue
            rival = self._fit(others, name)
            worse = self.model.session.by_run(chosen.log_likelihood - rival.log_likelihood)
            worse += settings.nats_a_parameter * self._more_parameters(rival, chosen) / len(worse)
            error = worse.std() * np.sqrt(len(worse))
            if worse.sum() < max(settings.rival_nats, settings.rival_errors * error):
                found[name] = worse
        return found
