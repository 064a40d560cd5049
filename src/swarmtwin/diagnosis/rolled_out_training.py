"""An ensemble that is given the velocity learns to go on from its own: trained through several periods, not one.

One period alone teaches too little: measured velocities carry the camera's noise, by which what they do is learned too
small, and each small mistake is put in again in the next period. So predicted twists take the place of measured
velocities, and the errors of all periods of a stretch count, as in simulation error methods of system identification.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from swarmtwin.diagnosis.measured_session import MeasuredSession
from swarmtwin.learning.situation import Situation
from swarmtwin.simulation.ensemble_dynamics import EnsembleDynamics


@dataclass(frozen=True)
class RolledOutTraining:
    """How: AdamW with torch's one-cycle schedule, on random stretches.

    Attributes:
        periods: of a stretch.
        learning_rate: the largest.
        weight_decay: AdamW's.
        warm_up: share of the steps over which the learning rate rises.
        batch_size: stretches a step.
        steps: optimiser steps.
    """

    periods: int = 12
    learning_rate: float = 5e-3
    weight_decay: float = 0.1
    warm_up: float = 0.1
    batch_size: int = 64
    steps: int = 500


def learn_rolled_out(
    base: EnsembleDynamics,
    session: MeasuredSession,
    fold: np.ndarray,
    seed: int,
    training: RolledOutTraining | None = None,
) -> None:
    """Train an ensemble that is given the velocity further, each member on the runs that it may see.

    Args:
        base: as it was learned period by period; it is changed.
        session: of N transitions; where none of its runs is as long as a stretch, nothing is changed.
        fold: (N,) the member that must not see a transition's run.
        seed: of the stretches.
        training: how; None: the defaults.
    """
    how, ensemble = training or RolledOutTraining(), base.ensemble
    stretches = _stretches(session.follows, how.periods)
    if not stretches.shape[1]:
        return
    situation, measured = session.situation, session.twist.float()
    assert situation.velocity is not None
    change = (session.twist - situation.velocity * base.robot.period_s).std(dim=0).clamp(min=1e-9).float()
    counts = torch.as_tensor(fold[None] != np.arange(base.members)[:, None], dtype=torch.float32)
    optimiser = torch.optim.AdamW(
        ensemble.parameters(), lr=how.learning_rate, weight_decay=how.weight_decay, fused=True
    )
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, how.learning_rate, total_steps=how.steps, pct_start=how.warm_up
    )
    generator = torch.Generator().manual_seed(seed)
    encoded = base.encoding(situation).float()
    for _ in range(how.steps):
        chosen = stretches[:, torch.randint(0, stretches.shape[1], (how.batch_size,), generator=generator)]
        counted = counts[:, chosen[0]]
        twists = _rolled_out(base, situation, encoded, chosen)
        errors = (((twists - measured[chosen][:, None]) / change) ** 2).mean(dim=(0, 3))
        loss = base.members * (errors * counted).sum() / counted.sum()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()


def _stretches(follows: np.ndarray, periods: int) -> Tensor:
    """Return the indices (periods, S) of transitions that follow one another."""
    after = np.full(len(follows) + 1, -1)  # the last: none comes after none
    after[follows[follows >= 0]] = np.flatnonzero(follows >= 0)
    rows = [np.arange(len(follows))]
    for _ in range(periods - 1):
        rows.append(after[rows[-1]])
    return torch.as_tensor(np.stack(rows)[:, rows[-1] >= 0])


def _rolled_out(base: EnsembleDynamics, situation: Situation, encoded: Tensor, chosen: Tensor) -> Tensor:
    """Return the twists (periods, M, B, 3) of each member over stretches (periods, B), on from the first velocity."""
    assert situation.velocity is not None
    columns = base.encoding.columns_of("velocity")
    limit = torch.as_tensor(base.robot.displacement_limit, dtype=torch.float32)
    twist = (situation.velocity[chosen[0]] * base.robot.period_s).float().expand(base.members, -1, -1)
    twists = []
    for rows in chosen:
        inputs = encoded[rows].expand(base.members, -1, -1).clone()
        inputs[..., columns] = twist / limit
        twist = twist + base.ensemble(inputs)
        twists.append(twist)
    return torch.stack(twists)
