"""Step 3, its end: what causes of the catalogue would gain if nothing were wrong but the simulation's uncertainty."""

import numpy as np

from swarmtwin.diagnosis.likelihood import SessionLikelihood, loses_commands
from swarmtwin.diagnosis.screening import candidates, sought_kinds


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
