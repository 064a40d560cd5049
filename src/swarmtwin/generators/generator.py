"""The one interface of all generators: real rows go in, any number of synthetic rows comes out."""

from abc import ABC, abstractmethod
from typing import Annotated, Any, NamedTuple, Self, cast

import lightning
import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn

from swarmtwin.errors import UserError
from swarmtwin.generators import models
from swarmtwin.generators.columns import Columns
from swarmtwin.plugins import PluginRegistry
from swarmtwin.robot import StrictModel
from swarmtwin.transitions import Transitions

Steps = Annotated[int, Field(ge=1)]
Count = Annotated[int, Field(ge=2)]


class RealRows(NamedTuple):
    """What a generator learns from: rows as `Columns` orders them, float32.

    Attributes:
        train: (N, width).
        run: (N,) number of the run that each row of `train` comes from.
        validation: (M, width) to follow the training by.
    """

    train: Tensor
    run: Tensor
    validation: Tensor

    @classmethod
    def of(cls, transitions: Transitions, columns: Columns, least: int = 200) -> "RealRows":
        """Take the training and validation splits; the test split is not touched.

        Args:
            transitions: real ones.
            columns: what a row holds.
            least: with fewer rows to train on, distributions are guessed rather than learned.

        Raises:
            UserError: there are too few to learn from, or a value is not finite.
        """
        train, validation = transitions.part("train"), transitions.part("validation")
        if len(train) < least or len(validation) < 2:
            raise UserError(
                f"{len(train)} real transitions for training and {len(validation)} for validation are too few for a "
                f"generator: it needs at least {least} and 2; record more runs"
            )
        rows = [torch.as_tensor(columns.rows(part), dtype=torch.float32) for part in (train, validation)]
        for name, values in zip(columns.units, torch.cat(rows).T, strict=True):
            if broken := int((~values.isfinite()).sum()):
                total = len(train) + len(validation)
                raise UserError(f"{name} is not finite in {broken} of {total} transitions: prepare the recording anew")
        run = np.unique(train.run, return_inverse=True)[1]
        return cls(rows[0], torch.as_tensor(run), rows[1])


class Generator(nn.Module, ABC):
    """A generative model of one robot's transitions (section 3.2 of the paper), to sample from.

    It owns its networks and scalings, so that a saved generator needs nothing beside it: above all no real row.

    Attributes:
        columns: what a row holds, of which robot and in which arena.
        config: the generator's configuration.
    """

    columns: Columns
    config: "GeneratorConfig"

    def __init__(self, columns: Columns, config: "GeneratorConfig") -> None:
        super().__init__()
        self.columns = columns
        self.config = config

    @abstractmethod
    def sample(self, count: int, rng: torch.Generator) -> Tensor:
        """Draw rows (count, width), without gradients; all randomness comes from `rng`."""


class GeneratorTraining(lightning.LightningModule, ABC):
    """How one kind of generator learns from real rows, a step at a time.

    What is not learned by gradients, such as scalings, it gives to the generator before the first step. Tensors that
    its steps use are buffers, so that Lightning moves them to the device.

    Attributes:
        generator: what is trained.
    """

    def __init__(self, generator: Generator) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.generator = generator

    @abstractmethod
    def training_step(self, step: int, batch_index: int) -> dict[str, Tensor]:
        """Take step number `step` of the training on real rows of its own choice; return losses by name."""

    @abstractmethod
    def validation_figures(self) -> dict[str, float]:
        """Say how good the generator is by now, on the validation rows; lower is better."""

    def descend(self, loss: Tensor, optimiser: int, learning_rate: float | None = None) -> None:
        """Take a step down the gradient of `loss` with one of the optimisers that `configure_optimizers` lists."""
        listed = self.optimizers(use_pl_optimizer=False)
        chosen = cast(Any, listed[optimiser] if isinstance(listed, list) else listed)  # Lightning gives one by itself
        if learning_rate is not None:
            chosen.param_groups[0]["lr"] = learning_rate
        chosen.zero_grad()
        loss.backward()  # Lightning's own has hooks, which nobody uses, for as long again
        chosen.step()


class GeneratorConfig(StrictModel):
    """The configuration of a generator, as in its `conf/generator/<name>.yaml`.

    Attributes:
        name: the generator's name, that of its file.
    """

    name: str

    @property
    @abstractmethod
    def training_steps(self) -> int:
        """How many steps its whole training takes."""

    def completed(self, rows: int) -> Self:
        """Return it with what depends on the number of real rows it learns from worked out; most have nothing such."""
        return self

    @abstractmethod
    def build(self, columns: Columns) -> Generator:
        """Build the generator, untrained."""

    @abstractmethod
    def training(self, generator: Generator, real: RealRows) -> GeneratorTraining:
        """Return the training of a generator that was built so."""


GENERATORS: PluginRegistry[GeneratorConfig] = PluginRegistry(models, "generator", group="generator")

generator_names = GENERATORS.names
config_class = GENERATORS.plugin_class
generator_config = GENERATORS.config
