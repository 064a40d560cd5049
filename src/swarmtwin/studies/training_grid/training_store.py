"""Finished trainings, kept by the digest of what they are made of: nothing is trained twice, in any experiment."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from swarmtwin import __version__
from swarmtwin.dynamics.model_folder import load_dynamics, save_dynamics
from swarmtwin.dynamics.provenance import Provenance
from swarmtwin.errors import UserError
from swarmtwin.files import new_folder, write_text
from swarmtwin.generators.columns import Columns
from swarmtwin.generators.generator import Generator, generator_config
from swarmtwin.generators.generator_folder import Lineage
from swarmtwin.learning.stored_folder import StoredFolder
from swarmtwin.robot import Arena, Robot, StrictModel
from swarmtwin.studies.training_grid.measured_errors import MeasuredErrors
from swarmtwin.studies.training_sets import TrainedModel

COMMAND = "experiment training"
OUTCOME = "outcome.json"


class TrainingOutcome(StrictModel):
    """What came of a training.

    Attributes:
        made_of: all that decided it.
        seconds: that it took.
        epochs: passes over what it learned from.
        steps: optimiser steps.
        learned_from: how many transitions it was trained on.
        dead: why its model, or the generator that it was to learn from, cannot be used; None for a live one.
    """

    made_of: dict[str, Any]
    seconds: float
    epochs: int = 0
    steps: int = 0
    learned_from: int = 0
    dead: str | None = None


class StoredGenerator(StrictModel):
    """A trained generator's description, without the quality and the card of one that is given away."""

    format: Literal[1] = 1
    generator: dict[str, Any]
    robot: Robot
    arena_mm: Arena
    lineage: Lineage


GENERATOR_FOLDER = StoredFolder(
    "generator.yaml", StoredGenerator, holds="generator", made_by=COMMAND, remedy="delete its folder"
)


def key_of(made_of: Mapping[str, Any]) -> str:
    """Return the digest of all that decides what comes of a training, this version of swarmtwin included."""
    text = json.dumps({"swarmtwin": __version__, **made_of}, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:24]


@dataclass(frozen=True)
class TrainingStore:
    """A folder of finished trainings, each a folder of its own; several commands may share it.

    Attributes:
        folder: made when something is kept.
    """

    folder: Path

    def path(self, key: str) -> Path:
        """Return where a training lies, finished or not."""
        return self.folder / key[:2] / key

    def has(self, key: str) -> bool:
        """Say whether a training is finished, well or badly."""
        return (self.path(key) / OUTCOME).exists()

    def outcome(self, key: str) -> TrainingOutcome:
        """Return what came of a training.

        Raises:
            UserError: its file is damaged.
        """
        return TrainingOutcome.parse(self._json(self.path(key) / OUTCOME), str(self.path(key) / OUTCOME))

    def keep_model(self, key: str, model: TrainedModel | None, outcome: TrainingOutcome) -> None:
        """Keep a trained model, as `train` leaves one, or why there is none.

        Raises:
            UserError: another process is keeping it at this moment.
        """
        with new_folder(self.path(key), COMMAND, outcome.made_of, overwrite=True) as folder:
            if model and model.dynamics:
                save_dynamics(folder, model.dynamics, model.provenance.model_dump(mode="json"))
            write_text(folder / OUTCOME, outcome.model_dump_json(indent=1) + "\n")

    def model(self, key: str, seed: int) -> TrainedModel:
        """Return the live model of a finished training.

        Raises:
            UserError: it is damaged.
        """
        return TrainedModel(seed, load_dynamics(self.path(key)), Provenance.read(self.path(key)))

    def keep_generator(self, key: str, trained: tuple[Generator, Lineage] | None, outcome: TrainingOutcome) -> None:
        """Keep a trained generator, or why there is none.

        Raises:
            UserError: another process is keeping it at this moment.
        """
        with new_folder(self.path(key), COMMAND, outcome.made_of, overwrite=True) as folder:
            if trained:
                generator, lineage = trained
                description = StoredGenerator(
                    generator=generator.config.model_dump(mode="json"),
                    robot=generator.columns.robot,
                    arena_mm=generator.columns.arena_mm,
                    lineage=lineage,
                )
                GENERATOR_FOLDER.save(folder, description, generator.state_dict())
            write_text(folder / OUTCOME, outcome.model_dump_json(indent=1) + "\n")

    def generator(self, key: str) -> tuple[Generator, Lineage]:
        """Return a finished generator and what it learned from.

        Raises:
            UserError: its training failed, or it is damaged.
        """
        if dead := self.outcome(key).dead:
            raise UserError(dead)
        folder = self.path(key)
        description = GENERATOR_FOLDER.read(folder)
        config = generator_config(description.generator, f"{folder / 'generator.yaml'}: generator")

        def build(weights: dict[str, Tensor]) -> Generator:
            generator = config.build(Columns.of(description.robot, description.arena_mm))
            generator.load_state_dict(weights)
            return generator.eval()

        with torch.random.fork_rng(devices=[]):
            return GENERATOR_FOLDER.load_into(folder, build), description.lineage

    def measured(self, key: str, recording: str) -> MeasuredErrors | None:
        """Return how a model measured on the recording with a digest; None where nobody has measured it.

        Raises:
            UserError: the file is damaged.
        """
        file = self._measured_file(key, recording)
        return MeasuredErrors.parse(self._json(file), str(file)) if file.exists() else None

    def keep_measured(self, key: str, recording: str, errors: MeasuredErrors) -> None:
        """Keep how a model measured on the recording with a digest."""
        write_text(self._measured_file(key, recording), errors.model_dump_json() + "\n")

    def _measured_file(self, key: str, recording: str) -> Path:
        return self.path(key) / f"on-{recording}.json"

    def _json(self, file: Path) -> Any:
        try:
            return json.loads(file.read_text())
        except ValueError as error:
            raise UserError(f"{file} is not valid JSON ({error}): delete the folder {file.parent}") from None
