"""Step 3, its tool: the likeliest parameters of a set of mechanisms, how sure they are, and the evidence for it."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import optimize

from swarmtwin.diagnosis.estimated_set import EstimatedSet
from swarmtwin.diagnosis.likelihood import MechanismClass, SessionLikelihood, loses_commands
from swarmtwin.diagnosis.lost_commands import LostCommands
from swarmtwin.diagnosis.random_effects import RandomEffects
from swarmtwin.simulation.mechanism import Mechanism

SHORT_STEP = 0.05
"""A step of least squares that is shorter, in standard deviations, changes the likelihood by a thousandth of a nat."""


def estimate(
    model: SessionLikelihood,
    start: Sequence[Mechanism],
    polish: bool = False,
    final: bool = False,
    enough: float = SHORT_STEP,
) -> EstimatedSet:
    """Return a set of mechanisms with its likeliest values, searched from those that `start` has.

    Args:
        model: of the session.
        start: the mechanisms.
        polish: whether to search a little around the end where the motion changes by jumps.
        final: whether to take slopes from the whole simulation, not from one member of what is quick in its place; and
            where the motion changes by jumps, to look at a smooth surface through the likelihood there: by what its
            minimum differs over resampled runs, since slopes say little there, and whether it leads further.
        enough: a step of least squares is the last one where it is shorter, in standard deviations.
    """
    kinds = [type(mechanism) for mechanism in start]
    search = _Search(model, kinds, is_exact=final)
    values = search.clipped(model.values(start))
    if loses_commands(kinds):
        values = search.by_likelihood(values)
    elif len(values):
        values = search.by_least_squares(values, enough)
        if polish and not all(kind.is_smooth for kind in kinds):
            found = search.estimated(search.polished(values))
            return search.smoothed(found) if final else found
    return search.estimated(values)


def with_further_uncertainty(model: SessionLikelihood, found: EstimatedSet) -> EstimatedSet:
    """Return a set that also knows how uncertain its values are since simulation and mechanisms are.

    The simulation was learned from so many runs. Its members have seen different ones, and the values follow what each
    of them answers (the delete-a-group jackknife). How members disagree is a random effect of the session as well, but
    there it takes away only these very directions, and the simulation's own error is another one of their kind: so the
    values are moved here as if that were not known. Where commands are lost, other forms of the mechanisms beside that
    are not integrated out: to these values adds what they are less known for them. Both is asked of the transitions
    whose commands arrived. And what the values stand for may not be known well (`Mechanism.plausible_alternatives`).
    """
    if not len(found.values):
        return found
    moved = list(_alternatives(model, found.mechanisms))
    lossy, count = loses_commands(found.fitted.kinds), len(found.values)
    if model.members < 2 and not lossy:
        return found.beyond(np.zeros(count), np.column_stack(moved)) if moved else found
    search = _Search(model, found.fitted.kinds)
    here = model.whitened(found.mechanisms).ravel() if lossy else found.fitted.whitened.ravel()
    arrived = np.repeat(~found.fitted.is_lost, 3)[:, None]
    slopes = arrived * search.slopes(found.values, here)
    if model.members >= 2:
        together = np.column_stack([slopes, model.disagreement_with(found.mechanisms)])
        gram = model.effects_of_certain_simulation.gram(together)
        moved.append(np.linalg.solve(gram[:count, :count] + search.prior_precision, gram[:count, count:]))
    if lossy:
        forms = arrived * model.any_forms(found.mechanisms)
        known, unknown = (
            np.linalg.inv(effects.gram(slopes) + search.prior_precision)
            for effects in (model.effects, model.effects.extended(forms))
        )
        more, axes = np.linalg.eigh(unknown - known)
        moved.append(axes * np.sqrt(np.maximum(more, 0.0)))
    return found.beyond(np.zeros(count), np.column_stack(moved))


def _alternatives(model: SessionLikelihood, mechanisms: Sequence[Mechanism]) -> Iterator[np.ndarray]:
    """Yield (P,) by what the values of mechanisms differ with each plausible alternative of one in its place."""
    values, deviations = model.values(mechanisms), model.settings.estimation.alternatives
    for place, one in enumerate(mechanisms):
        for other in one.plausible_alternatives():
            yield deviations * (model.values([*mechanisms[:place], other, *mechanisms[place + 1 :]]) - values)


class _Search:
    """The parameters of kinds of mechanisms, and what a session says of them."""

    def __init__(self, model: SessionLikelihood, kinds: Sequence[MechanismClass], is_exact: bool = False) -> None:
        self.model, self.kinds, self.settings = model, kinds, model.settings.estimation
        self.is_exact = is_exact
        self.parameters = [parameter for _, _, parameter in model.parameters(kinds)]
        self.low = np.array([one.low for one in self.parameters], float)
        self.high = np.array([one.high for one in self.parameters], float)
        self.step = np.array([one.response_step for one in self.parameters], float)
        self.prior_precision = np.diag(12 / np.maximum(self.high - self.low, 1e-12) ** 2)

    def at(self, values: np.ndarray) -> list[Mechanism]:
        """Return the mechanisms with values (P,)."""
        return self.model.assembled(self.kinds, values)

    def clipped(self, values: np.ndarray) -> np.ndarray:
        """Return values (P,) within the bounds."""
        return np.clip(values, self.low, self.high) if len(values) else values

    def _anchor(self, values: np.ndarray) -> list[Mechanism] | None:
        """Return the mechanisms from which one member of the simulation says what others change; None: all say it."""
        return None if self.is_exact else self.at(values)

    def whitened(self, values: np.ndarray) -> np.ndarray:
        """Return whitened errors (3 N,)."""
        return self.model.whitened(self.at(values)).ravel()

    def whitened_near(self, values: np.ndarray, near: Sequence[Mechanism]) -> np.ndarray:
        """Return whitened errors (3 N,), nearly, by what they differ from those with mechanisms `near`."""
        if self.is_exact:
            return self.whitened(values)
        return self.model.whitened_near(self.at(values), near).ravel()

    def slopes(self, values: np.ndarray, here: np.ndarray, near: Sequence[Mechanism] | None = None) -> np.ndarray:
        """Return (3 N, P) how whitened errors `here` change with the parameters, as `whitened_near` says."""
        columns, near = [], self.at(values) if near is None else near
        for index, parameter in enumerate(self.parameters):
            moved = values.copy()
            moved[index] = parameter.stepped_from(values[index])
            columns.append((self.whitened_near(moved, near) - here) / (moved[index] - values[index]))
        return np.stack(columns, axis=-1)

    def by_least_squares(self, values: np.ndarray, enough: float) -> np.ndarray:
        """Search by Gauss and Newton's method, random effects integrated out."""
        values = self._descended(values, self.model.effects, enough)
        return self._descended(values, self.model.effects_with(self.at(values), self._anchor(values)), enough)

    def _descended(self, values: np.ndarray, effects: RandomEffects, enough: float) -> np.ndarray:
        """Return values (P,) after some steps downhill, fewer where one is `enough` standard deviations or less.

        The whole simulation is asked where the descent begins; from there one member says what changes.
        """
        near = self.at(values)
        here = self.whitened(values)
        for _ in range(self.settings.rounds):
            gram = effects.gram(np.column_stack([self.slopes(values, here, near), here]))
            precision, loss = gram[:-1, :-1] + self.prior_precision, gram[-1, -1]
            moved = self._bounded_step(values, precision, -gram[:-1, -1])
            for _ in range(4):
                there = self.whitened_near(moved, near)
                if effects.loss(there) <= loss:
                    break
                moved = (moved + values) / 2
            else:
                return values
            shift = np.abs(moved - values) * np.sqrt(np.diag(precision))
            values, here = moved, there
            if shift.max() < enough:
                break
        return values

    def _bounded_step(self, values: np.ndarray, precision: np.ndarray, downhill: np.ndarray) -> np.ndarray:
        """Return values after a step to the minimum of a quadratic within the bounds."""
        free = np.ones(len(values), bool)
        for _ in range(len(values)):
            step = np.zeros(len(values))
            step[free] = np.linalg.solve(precision[np.ix_(free, free)], downhill[free])
            outside = free & ((values + step < self.low - 1e-12) | (values + step > self.high + 1e-12))
            stuck = outside & (((values <= self.low) & (step < 0)) | ((values >= self.high) & (step > 0)))
            if not stuck.any():
                return self.clipped(values + step)
            free &= ~stuck
            if not free.any():
                return values
        return self.clipped(values)

    def by_likelihood(self, values: np.ndarray, rounds: int = 3) -> np.ndarray:
        """Search the likelihood itself, where which commands arrived is summed over; steps are in standard errors.

        Which course each transition took stays as it is in each of so many rounds, since the likelihood jumps with it.
        """
        near = self.model.lost_commands(self.at(values))
        for _ in range(rounds):
            values = self._likeliest_near(values, near)
            before, near = near, self.model.lost_commands(self.at(values))
            if (before.likeliest == near.likeliest).all():
                break
        return values

    def _likeliest_near(self, values: np.ndarray, near: LostCommands, enough: float = 0.02) -> np.ndarray:
        """Climb by Newton's method, the products of scores for the curvature (Berndt, Hall, Hall, Hausman, 1974).

        Until a step is `enough` standard deviations or less, or the likelihood falls whatever its length.
        """
        reached, here = self._total(values, near), near
        for _ in range(self.settings.likelihood_rounds):
            information, scores = self._curvature(values, here)
            moved = self._bounded_step(values, information, scores.total)
            for _ in range(6):
                likelihood = self._total(moved, near)
                if likelihood >= reached:
                    break
                moved = (moved + values) / 2
            else:
                return values
            shift = np.abs(moved - values) * np.sqrt(np.diag(information))
            values, reached = moved, likelihood
            if shift.max() < enough:
                break
            if not self.is_exact:
                here = self.model.lost_commands(self.at(values), near=near)
        return values

    def _total(self, values: np.ndarray, near: LostCommands) -> float:
        return self.model.evaluate(self.at(values), near=near).total

    def polished(self, values: np.ndarray) -> np.ndarray:
        """Search a little around values where the motion changes by jumps."""
        near = self.at(values)
        effects = self.model.effects_with(near)

        def loss(scaled: np.ndarray) -> float:
            moved = values + scaled * self.step
            if np.any(moved < self.low) or np.any(moved > self.high):
                return np.inf
            return effects.loss(self.model.whitened_near(self.at(moved), near).ravel())

        simplex = np.concatenate([np.zeros((1, len(values))), np.eye(len(values)) * 1.5])
        options = {
            "initial_simplex": simplex,
            "maxfev": self.settings.most_polishing,
            "xatol": 0.02,
            "fatol": 0.1,
        }
        found = optimize.minimize(loss, np.zeros(len(values)), method="Nelder-Mead", options=options)
        return self.clipped(values + found.x * self.step)

    def smoothed(self, found: EstimatedSet) -> EstimatedSet:
        """Return a set with how its values vary over resampled runs, each with a quadratic surface (Box, Wilson, 1951).

        Where the edge of a patch passes single measured poses the loss jumps, and slopes do not say how well the values
        are known; a surface through points as far away as they are uncertain does. From its minimum the search also
        begins anew, and goes there if the loss is lower: the surface alone is bent, since edges are missed one-sidedly.
        """
        settings, rng = self.settings, np.random.default_rng(0)
        count = len(found.values)
        covariance = found.covariance
        wider = np.maximum(self.step / 4 / np.sqrt(np.diag(covariance)), 1.0)  # less far nothing jumps
        root = np.linalg.cholesky(covariance * np.outer(wider, wider))
        one, other = np.triu_indices(count)
        away = rng.normal(size=(settings.surface_points * (1 + count + len(one)), count))
        away *= rng.uniform(size=(len(away), 1)) ** (1 / count) / np.linalg.norm(away, axis=1, keepdims=True)
        points = self.clipped(found.values + settings.surface_radius * away @ root.T)
        away = np.linalg.solve(root, (points - found.values).T).T
        effects = self.model.effects_with(found.mechanisms)
        losses = np.array([self._loss_by_run(effects, self.whitened(point)) for point in points])
        terms = np.column_stack([np.ones(len(away)), away, away[:, one] * away[:, other]])

        def lowest(times: np.ndarray) -> np.ndarray:
            """Return the values (P,) at the minimum of the surface, runs counted (R,) times."""
            fitted = np.linalg.lstsq(terms, losses @ times, rcond=1e-8)[0]
            curvature = np.zeros((count, count))
            curvature[one, other] = fitted[1 + count :]
            sizes, axes = np.linalg.eigh(curvature + curvature.T)
            step = -axes @ (axes.T @ fitted[1 : 1 + count] / np.maximum(sizes, 1e-2))
            step *= min(1.0, settings.surface_radius / max(float(np.linalg.norm(step)), 1e-12))
            return self.clipped(found.values + root @ step)

        runs = losses.shape[1]
        drawn = rng.multinomial(runs, np.full(runs, 1 / runs), settings.surface_resamples)
        resampled = np.array([lowest(times) for times in drawn])
        again = self.polished(lowest(np.ones(runs)))
        is_lower = effects.loss(self.whitened(again)) < effects.loss(self.whitened(found.values))
        return replace(self.estimated(again) if is_lower else found, resampled=resampled.std(axis=0))

    def _loss_by_run(self, effects: RandomEffects, whitened: np.ndarray) -> np.ndarray:
        """Return (R,) half the squared errors of each run, and its part of what the random effects' size costs."""
        errors = whitened.reshape(-1, 3)
        sizes = effects.sizes(errors)
        left = errors - effects.of_sizes(sizes)
        by_run: np.ndarray = self.model.session.by_run(self.model.weight * (left**2).sum(axis=1) / 2)
        return by_run + float(sizes @ sizes) / 2 / len(by_run)

    def estimated(self, values: np.ndarray) -> EstimatedSet:
        """Return the set at its likeliest values, with its evidence."""
        mechanisms = self.at(values)
        lossy = loses_commands(self.kinds)
        effects = self.model.effects if lossy else self.model.effects_with(mechanisms, self._anchor(values))
        fitted = self.model.evaluate(mechanisms, effects)
        evidence = fitted.total - effects.log_determinant / 2
        runs = self.model.session.runs
        if not len(values):
            nothing = np.zeros((0, 0))
            return EstimatedSet(fitted, values, nothing, np.zeros((runs, 0)), nothing, evidence)
        if lossy:
            curvature, (scores, _) = self._curvature(values, self.model.lost_commands(mechanisms))
            information, naive = curvature, np.linalg.inv(curvature)
        else:
            slopes = self.slopes(values, fitted.whitened.ravel())
            wide = np.tile(fitted.scale, len(fitted.residual))
            scaled = slopes / wide[:, None]
            curvature = effects.gram(scaled) + self.prior_precision
            any_form = self.model.effects_with_any_form(mechanisms, self._anchor(values))
            information = any_form.gram(scaled) + self.prior_precision
            scores = -(scaled * (effects.weight * fitted.residual.ravel() / wide)[:, None])
            scores = scores.reshape(-1, 3, len(values)).sum(axis=1)
            naive = np.linalg.inv((scaled * effects.weight[:, None]).T @ scaled + self.prior_precision)
        by_run = self.model.session.by_run(scores) @ naive
        evidence -= float(np.log(np.maximum(self.high - self.low, 1e-12)).sum())
        evidence += len(values) * np.log(2 * np.pi) / 2 - float(np.linalg.slogdet(curvature)[1]) / 2
        return EstimatedSet(fitted, values, information, by_run, naive, evidence)

    def _curvature(self, values: np.ndarray, here: LostCommands) -> tuple[np.ndarray, "Scores"]:
        """Return the curvature (P, P) of the log-likelihood by its scores, and these.

        By central differences from what is known `here`, at these values, for which one member stands for the
        simulation unless all must be exact. Which course each transition took stays as it is: where that changes, one
        transition's log-likelihood jumps and the next one's jumps back, and the squares of both would be taken for
        information.
        """
        slopes = [self._slope(values, index, here) for index in range(len(values))]
        scores = Scores(*(np.stack(parts, axis=-1) for parts in zip(*slopes, strict=True)))
        return scores.of_each.T @ scores.of_each + self.prior_precision, scores

    def _slope(self, values: np.ndarray, index: int, here: LostCommands) -> "Scores":
        ends = []
        for sign in (1.0, -1.0):
            moved = values.copy()
            moved[index] += sign * self.step[index]
            moved = self.clipped(moved)
            fitted = self.model.evaluate(self.at(moved), near=here, is_quick=not self.is_exact)
            ends.append((moved[index], Scores(fitted.log_likelihood, np.array(fitted.total))))
        (ahead, first), (back, second) = ends
        return Scores(*((one - other) / max(ahead - back, 1e-12) for one, other in zip(first, second, strict=True)))


class Scores(NamedTuple):
    """How log-likelihoods change with P parameters.

    Attributes:
        of_each: (N, P) that of each transition.
        total: (P,) that of the whole session, with what random effects cost.
    """

    of_each: np.ndarray
    total: np.ndarray


Progress = Callable[[str, int, int], None]
"""Called with what is being done, how much of it is done, and of how much."""
