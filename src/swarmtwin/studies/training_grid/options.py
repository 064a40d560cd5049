"""What an experiment on a grid of trainings is told: conf/experiment/table1.yaml and its siblings."""

from pathlib import Path
from typing import Annotated, Any, Literal, Self

import yaml
from pydantic import Field, model_validator

from swarmtwin.configuration import config_files
from swarmtwin.dynamics.model_config import ModelConfig, model_config
from swarmtwin.errors import UserError, near_miss
from swarmtwin.generators.generator import GeneratorConfig, generator_config
from swarmtwin.learning.device import Device
from swarmtwin.learning.recipe import Recipe
from swarmtwin.robot import Positive, Robot, Seed, StrictModel
from swarmtwin.studies.training_grid.claims import Claim
from swarmtwin.studies.training_grid.comparison import Judging
from swarmtwin.studies.training_grid.result_table import Published
from swarmtwin.studies.training_grid.trainings import Grid, Share, Training, all_trainings
from swarmtwin.transitions import SplitOptions
from swarmtwin.transitions.inputs import Vehicles

Count = Annotated[int, Field(ge=1)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")]


class Scale(StrictModel):
    """How large the experiments are; `scales` in conf/training_grid/. Grids refer to `${scales.${scale}.amounts}`.

    Attributes:
        seeds: runs of each training.
        steps: optimiser steps of each on all real transitions; None: each model's own.
        steps_at_low_rate: likewise at the low learning rate of table 3.
        amounts: of real or of drawn transitions, in multiples of all real ones.
        real_shares: of a mixture, measured.
        generator_epochs: of a generator's training.
        noise: standard deviations, in mm and in degrees.
    """

    seeds: Count
    steps: Count | None
    steps_at_low_rate: Count
    amounts: Annotated[tuple[Share, ...], Field(min_length=1)]
    real_shares: tuple[Annotated[float, Field(ge=0, le=1)], ...]
    generator_epochs: tuple[Positive, ...]
    noise: tuple[Annotated[float, Field(ge=0)], ...]


class View(StrictModel):
    """What is drawn of a grid.

    Attributes:
        kind: dots for each training, curves, a heat map over real and drawn transitions, or runs predicted open loop.
        x: of curves, the field of the trainings that they run along.
    """

    kind: Literal["dots", "curve", "heat_map", "open_loop"]
    x: Literal["size", "real", "synthetic", "measured_share", "generator_epochs", "noise"] | None = None


class Options(StrictModel):
    """Options; their defaults stand in conf/experiment/, in the files with `study: training_grid`."""

    name: Name
    study: Literal["training_grid"]
    title: str
    shows: str
    robot: Robot
    recipe: Recipe
    scale: Name
    scales: dict[Name, Scale]
    split: SplitOptions
    models: Annotated[tuple[str, ...], Field(min_length=1)]
    generators: tuple[str, ...]
    trainings: Annotated[tuple[Grid, ...], Field(min_length=1)]
    view: View
    claims: tuple[Claim, ...]
    published: dict[str, tuple[Published, ...]]
    judging: Judging
    train_vehicle: Path
    train_vehicles: Vehicles
    other_vehicle: Path
    other_vehicles: Vehicles
    open_loop: Path | None
    store: Path
    device: Device
    processes: Count | None
    seed: Seed
    pictures: bool
    output: Path
    overwrite: bool

    @model_validator(mode="after")
    def _scale_is_known(self) -> Self:
        if self.scale not in self.scales:
            raise ValueError(f"no such scale: {self.scale!r}: {near_miss(self.scale, self.scales)}")
        return self

    @property
    def size(self) -> Scale:
        """How large it is."""
        return self.scales[self.scale]

    @property
    def grid(self) -> list[Training]:
        """All trainings, each once."""
        return all_trainings(self.trainings)

    @property
    def seeds(self) -> range:
        """The seeds of each training."""
        return range(self.seed, self.seed + self.size.seeds)

    def model_configs(self) -> dict[str, ModelConfig]:
        """Return the configuration of each model that is named, as its file in conf/model/ has it.

        Raises:
            UserError: there is no such file, or it is damaged.
        """
        names = dict.fromkeys((*self.models, *(training.model for training in self.grid)))
        return {name: model_config(_content("model", name), f"conf/model/{name}.yaml") for name in names}

    def generator_configs(self) -> dict[str, GeneratorConfig]:
        """Return the configuration of each generator that is named, likewise.

        Raises:
            UserError: there is no such file, or it is damaged.
        """
        asked = (*self.generators, *(training.generator for training in self.grid if training.generator))
        names = dict.fromkeys(asked)
        return {name: generator_config(_content("generator", name), f"conf/generator/{name}.yaml") for name in names}


def _content(group: str, name: str) -> Any:
    known = config_files(group)
    if name not in known:
        raise UserError(f"{group}s: no such {group}: {name!r}: {near_miss(name, known)}")
    return yaml.safe_load(known[name].read_text())
