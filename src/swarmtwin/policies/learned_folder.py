"""The folder that learning a policy leaves: the policy, the evaluations of all seeds, how they learned."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from swarmtwin.dynamics.model_folder import read_description
from swarmtwin.dynamics.provenance import Provenance
from swarmtwin.files import folder_digest, write_text
from swarmtwin.policies.policy_folder import PolicyProvenance, SeedOutcome, SimulationOrigin, save_policy
from swarmtwin.policies.rollout_comparison import plain_figures
from swarmtwin.policies.rollout_folder import ROLLOUTS
from swarmtwin.policies.seeds import best_of
from swarmtwin.policies.training import (
    PolicyJob,
    SeedResult,
    policy_of,
    tested,
)
from swarmtwin.world.rollout import chosen_world, figures_of
from swarmtwin.world.rollout_storage import save_rollouts
from swarmtwin.world.task import Task


def origin_of(source: str, simulation: Path) -> SimulationOrigin:
    """Describe the simulation that a policy is learned in, by the name it was given and its folder."""
    provenance = Provenance.read(simulation)
    return SimulationOrigin(
        source=source,
        model=read_description(simulation).model["name"],
        digest=folder_digest(simulation),
        recording=provenance.recording,
        origin=provenance.origin,
    )


def provenance_of(job: PolicyJob, results: Sequence[SeedResult], origin: SimulationOrigin) -> PolicyProvenance:
    """Say where the policy of the best of some seeds comes from, which all learned like `job`.

    Raises:
        UserError: every seed has failed.
    """
    outcomes = [SeedOutcome(seed=result.seed, best=result.best, failed=result.failed) for result in results]
    return PolicyProvenance(
        simulation=origin,
        algorithm=job.algorithm.model_dump(mode="json"),
        schedule=job.schedule.model_dump(mode="json"),
        randomisation=job.randomisation.model_dump(mode="json") if job.randomisation else None,
        started_from=job.initial.origin if job.initial else None,
        seed=best_of(results).seed,
        seeds=tuple(outcomes),
    )


def save_learned(
    folder: Path, task: Task, job: PolicyJob, results: Sequence[SeedResult], origin: SimulationOrigin
) -> PolicyProvenance:
    """Save the best seed's policy, the evaluations of all seeds and how they learned; return where it comes from.

    `metrics.json` says how good the policy is, with intervals, in scenarios by which nothing was chosen; that roll-out
    of them whose reward is the median stands in `rollouts.npz`, to be shown.
    """
    best = best_of(results)
    provenance = provenance_of(job, results, origin)
    policy = policy_of(task, job.algorithm, best)
    save_policy(folder, policy, task.config, task.arena, provenance)
    rollout = tested(task, job, policy)
    save_rollouts(folder / ROLLOUTS, {"simulation": rollout.where(np.array([chosen_world(rollout, "typical")]))})
    metrics = {
        "test": plain_figures(figures_of(rollout)),
        "evaluation": provenance.evaluation.model_dump(),
        "seeds": {
            str(outcome.seed): outcome.best.model_dump() if outcome.best else None for outcome in provenance.seeds
        },
    }
    write_text(folder / "metrics.json", json.dumps(metrics, indent=1) + "\n")
    history_table(results).to_csv(folder / "history.csv", index=False, float_format="%.5f")
    return provenance


def history_table(results: Sequence[SeedResult]) -> pd.DataFrame:
    """Return the evaluations of all seeds while they learned, a row each."""
    return pd.DataFrame(
        [{"seed": result.seed, **evaluation.model_dump()} for result in results for evaluation in result.history]
    )
