"""Step 3, its end: what causes of the catalogue would gain if nothing were wrong but the simulation's uncertainty."""

from collections.abc import Sequence

import numpy as np
from scipy import stats

from swarmtwin.diagnosis.likelihood import SessionLikelihood, arriving, loses_commands
from swarmtwin.diagnosis.screening import candidates, sought_kinds
from swarmtwin.diagnosis.sized_causes import Surroundings
from swarmtwin.simulation.mechanism import Mechanism


def nats_by_chance(model: SessionLikelihood, residual: np.ndarray, draws: int) -> np.ndarray:
    """Return (draws,) the nats that the best single cause gains where nothing but the simulation is uncertain.

    A parametric bootstrap (Davison and Hinkley, 1997, section 4.2): errors are drawn as members that have seen
    different runs disagree, and added to noise, the session's own in another order. To these every mechanism is fitted
    by one linear step from each point of its grid, as where it is screened. The simulation's real error is another one
    of their kind, so the disagreement is not taken out of it, as a random effect would.

    Args:
        model: of N transitions.
        residual: (N, 3) whitened errors in which nothing is left to be explained.
        draws: of the simulation's error and of the order.
    """
    kinds = {
        name: kind
        for name, kind in model.shown_of(sought_kinds(model)).items()
        if not loses_commands([kind]) and not model.read_off_clock(kind)
    }
    columns = [one.columns for one in candidates(model, model.evaluate([]), kinds) if one.columns.shape[1]]
    most = np.zeros(draws)
    if not columns:
        return most
    directions, rng = model.filter(model.disagreement), np.random.default_rng(0)
    members = directions.shape[-1]
    drawn = [rng.permutation(residual) + directions @ rng.normal(size=members) for _ in range(draws)]
    errors = np.stack([one.ravel() for one in drawn], axis=-1)
    for changes in columns:
        beyond = model.effects_of_certain_simulation.beyond(changes)
        side = -beyond.T @ errors
        steps = np.linalg.lstsq(beyond.T @ changes, side, rcond=1e-8)[0]
        most = np.maximum(most, (steps * side).sum(axis=0) / 2)
    return most


def beyond_uncertainty(model: SessionLikelihood, mechanisms: Sequence[Mechanism]) -> frozenset[str]:
    """Return the names of those causes that show more than an uncertain simulation imitates of them.

    It errs somehow, and some cause looks like that, but not any: a simulation that does not look at the time does not
    slow down as a battery does. Of what a cause changes beside the others, a ridge regression takes off what goes with
    the situation as the simulation sees it. The rest is held against the errors, and against how members that have seen
    different runs disagree along it, whose variance the M of them tell with M − 1 degrees of freedom. It shows more
    where neither noise nor such a disagreement reaches as far but with a probability of about `imitated_level`, over
    all that the search has looked at (Bonferroni). A rest of no more than `least_unseen` is what the regression cannot
    fit, and says nothing.

    Args:
        model: of the session.
        mechanisms: the causes, with values; commands that they may lose are not looked at.

    Returns:
        None of them where the simulation has one member, or goes on from its own velocity, which holds all commands
        before.
    """
    settings, members, there = model.settings, model.members, arriving(mechanisms)
    if members < 2 or not there or model.has_momentum:
        return frozenset()
    each = settings.verdict.imitated_level / (len(sought_kinds(model)) * settings.search.grid_points)
    by_noise, by_members = stats.chi2.isf(each, 1), stats.f.isf(each, 1, members - 1)
    here, found = model.errors(there), []
    for cause in there:
        others = [one for one in there if one is not cause]
        change = here - model.errors(others)
        both = model.filter(np.stack([change, change - _seen_part(model, change)], axis=-1)).reshape(-1, 2)
        beyond = Surroundings(model, others, model.effects_of_certain_simulation).beyond(both)
        whole, length = (max(float(one), 1e-12) for one in (beyond * both).sum(axis=0))
        unseen = beyond[:, 1]
        shown = float(unseen @ model.whitened(others).ravel()) ** 2 / length
        imitated = float(((unseen @ model.disagreement_with(others)) ** 2).sum()) / length
        is_seen = length <= settings.verdict.least_unseen * whole
        if not is_seen and shown > by_noise + by_members * imitated:
            found.append(cause.name)
    return frozenset(found)


_SEEN = {"command": ("command",), "previous_command": ("memory",), "pose": ("heading", "place")}
"""Families of the flexible regression's features that go with a part of the situation."""


def _seen_part(model: SessionLikelihood, change: np.ndarray) -> np.ndarray:
    """Return what of a change of errors (N, 3) goes with the situation as the simulation sees it, (N, 3)."""
    flexible = model.flexible
    seen = [flexible.families[name] for part in model.predictor.base.inputs for name in _SEEN.get(part, ())]
    largest = max(float(np.abs(change).max()), 1e-9)  # nothing is clipped
    regressions = flexible.regressions([np.concatenate([[0], *seen])], np.full_like(change, largest), model.weight)
    return regressions.predicted(change)[0]
