"""The one interface of all generators: real rows go in, any number of synthetic rows comes out."""

from abc import ABC, abstractmethod
from typing import NamedTuple

import lightning
import numpy as np
import torch
from torch import Tensor

from swarmtwin.errors import UserError
from swarmtwin.generators.columns import Columns
from swarmtwin.generators.generator_config import GeneratorConfig
from swarmtwin.robot import Robot
from swarmtwin.transitions import Transitions

LEAST_TRANSITIONS = 200


class RealRows(NamedTuple):
    """What a generator learns from: rows as `Columns` orders them, float32.

    Attributes:
        train: (N, width).
        run: (N,) number of the run that each row of `train` comes from.
        validation: (M, width) to follow the training by, and to stop it.
    """

    train: Tensor
    run: Tensor
    validation: Tensor

    @classmethod
    def of(cls, transitions: Transitions, columns: Columns) -> "RealRows":
        """Take the training and validation splits; the test split is not touched.

        Raises:
            UserError: there are too few to learn from, or a value is not finite.
        """
        train, validation = transitions.part("train"), transitions.part("validation")
        if len(train) < LEAST_TRANSITIONS or len(validation) < 2:
            raise UserError(
                f"{len(train)} real transitions for training and {len(validation)} for validation are too few for a "
                f"generator: it needs at least {LEAST_TRANSITIONS} and 2; record more runs"
            )
        rows = [torch.as_tensor(columns.rows(part), dtype=torch.float32) for part in (train, validation)]
        for name, values in zip(columns.units, torch.cat(rows).T, strict=True):
            if broken := int((~values.isfinite()).sum()):
                total = len(train) + len(validation)
                raise UserError(f"{name} is not finite in {broken} of {total} transitions: prepare the recording anew")
        run = np.unique(train.run, return_inverse=True)[1]
        return cls(rows[0], torch.as_tensor(run), rows[1])


class Generator(lightning.LightningModule, ABC):
    """A generative model of one robot's transitions (section 3.2 of the paper).

    It owns its networks and scalings, so that a saved generator needs nothing beside it: above all no real row.

    Attributes:
        robot: the robot whose transitions it generates.
        config: the generator's configuration.
        columns: what a row holds.
        real: what it learns from, while it does; not kept with the weights.
    """

    real: RealRows

    def __init__(self, robot: Robot, config: GeneratorConfig) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.robot = robot
        self.config = config
        self.columns = Columns.of(robot)

    @abstractmethod
    def start(self, real: RealRows) -> None:
        """Take scalings, and whatever else is not learned by gradients, from the real rows."""

    @abstractmethod
    def training_step(self, step: int, batch_index: int) -> dict[str, Tensor]:
        """Take step number `step` of the training on real rows of its own choice; return losses by name."""

    @abstractmethod
    def validation_figures(self) -> dict[str, float]:
        """Say how good the generator is by now, on the validation rows; lower is better."""

    def finish(self) -> None:
        """Do what is left to do after the last step."""

    @abstractmethod
    def draw(self, count: int, source: torch.Generator) -> Tensor:
        """Draw rows (count, width); all randomness comes from `source`."""
