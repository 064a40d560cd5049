"""Trains several seeds of a dynamics model and keeps the best live one."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from swarmtwin.dynamics.base import Dynamics
from swarmtwin.dynamics.fitting import SeedResult
from swarmtwin.dynamics.model_config import ModelConfig
from swarmtwin.dynamics.progress import EpochReport
from swarmtwin.dynamics.recipe import Recipe
from swarmtwin.dynamics.seeds import Job, fit_all
from swarmtwin.errors import UserError
from swarmtwin.transitions import Transitions

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Trained:
    """A trained model and what came of each seed.

    Attributes:
        dynamics: the live seed with the lowest validation loss, in eval mode.
        seed: its seed.
        recipe: the recipe with all its values known.
        results: one for each seed, in the order asked for.
    """

    dynamics: Dynamics
    seed: int
    recipe: Recipe
    results: tuple[SeedResult, ...]

    @property
    def best(self) -> SeedResult:
        """The chosen seed's result."""
        return next(result for result in self.results if result.seed == self.seed)

    @property
    def dead_seeds(self) -> dict[int, str]:
        """The seeds that cannot be used, with the reason."""
        return {result.seed: result.dead for result in self.results if result.dead}


def train(
    transitions: Transitions,
    config: ModelConfig,
    recipe: Recipe,
    seeds: Sequence[int],
    checkpoints: Path | None = None,
    report: EpochReport | None = None,
    processes: int | None = None,
    reserve: int = 0,
) -> Trained:
    """Train each seed on the training split; the best live one on the validation split is the model.

    Dead seeds are replaced by those that follow the last one, at most `reserve` of them, and stay in the results.

    Args:
        transitions: measured or synthetic transitions with their splits.
        config: which model.
        recipe: how to train it.
        seeds: one training each.
        checkpoints: a folder from which interrupted seeds continue, written after each epoch.
        report: called after each epoch of each seed.
        processes: seeds trained at a time; by default as many as there are cores, or one where that is quicker.
        reserve: how many further seeds may be tried in place of dead ones.

    Raises:
        UserError: too little data, values that are not finite, or every seed is dead.
    """
    recipe = recipe.for_model(config, len(transitions.part("train")))
    if checkpoints:
        checkpoints.mkdir(parents=True, exist_ok=True)
    results: list[SeedResult] = []
    waiting, spare = list(seeds), list(range(seeds[-1] + 1, seeds[-1] + 1 + reserve))
    while waiting:
        files = [checkpoints / f"seed-{seed}.ckpt" if checkpoints else None for seed in waiting]
        jobs = [Job(transitions, config, recipe, seed, file) for seed, file in zip(waiting, files, strict=True)]
        tried = fit_all(jobs, report, processes)
        results += tried
        dead = [result for result in tried if result.dead]
        for result in dead:
            log.warning("%s, seed %d is dead: %s", config.name, result.seed, result.dead)
        waiting, spare = spare[: len(dead)], spare[len(dead) :]
    best = _best_live(config, results)
    weights = {name: torch.from_numpy(values) for name, values in best.weights.items()}
    dynamics = Dynamics.with_weights(transitions.robot, config, weights)
    return Trained(dynamics, best.seed, recipe, tuple(results))


def _best_live(config: ModelConfig, results: Sequence[SeedResult]) -> SeedResult:
    live = [result for result in results if not result.dead]
    if not live:
        reasons = "; ".join(f"seed {result.seed}: {result.dead}" for result in results)
        raise UserError(
            f"{config.name}: every seed is dead ({reasons}): try other seeds, a lower learning rate, or another model"
        )
    return min(live, key=lambda result: result.validation_loss)
