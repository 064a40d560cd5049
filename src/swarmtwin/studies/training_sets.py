"""What studies train models on, and what comes of it: parts of the real transitions, and models of single seeds."""

from dataclasses import dataclass
from typing import Any

import torch

from swarmtwin.dynamics.predictor import NetworkDynamics
from swarmtwin.dynamics.provenance import Provenance
from swarmtwin.dynamics.trained_folder import provenance_of
from swarmtwin.dynamics.training import SeedResult, Trained, TrainingJob
from swarmtwin.transitions import Preparation, Transitions
from swarmtwin.transitions.mixing import Prepared
from swarmtwin.transitions.preparation import counts_by_split, runs_by_split


@dataclass(frozen=True)
class TrainedModel:
    """What came of one seed.

    Attributes:
        seed: the seed.
        dynamics: the model; None where the seed is dead.
        provenance: where it comes from.
        dead: why the seed cannot be used; None for a live one.
    """

    seed: int
    dynamics: NetworkDynamics | None
    provenance: Provenance
    dead: str | None = None


def count_real(preparation: Preparation) -> int:
    """Return how many transitions there are to learn from, training and validation together."""
    return sum(preparation.transitions[split] for split in ("train", "validation"))


def described_part(preparation: Preparation, part: Transitions) -> Prepared:
    """Return a part of prepared transitions with the description that holds for it."""
    changes: dict[str, Any] = {"runs": runs_by_split(part), "transitions": counts_by_split(part)}
    return part, preparation.model_copy(update=changes)


def trained_model(job: TrainingJob, preparation: Preparation, result: SeedResult) -> TrainedModel:
    """Return the model that a training left, with where it comes from."""
    weights = {name: torch.from_numpy(values) for name, values in result.weights.items()}
    dynamics = NetworkDynamics.with_weights(job.transitions.robot, job.config, weights)
    provenance = provenance_of(Trained(dynamics, result.seed, job.recipe, (result,)), preparation)
    return TrainedModel(result.seed, None if result.dead else dynamics, provenance, result.dead)
