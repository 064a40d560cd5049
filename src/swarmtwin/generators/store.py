"""A generator as a folder to give away: a description, weights, and a card that a stranger understands; no real row."""

from pathlib import Path
from typing import Any, Literal

import torch
import yaml

from swarmtwin import weights
from swarmtwin.errors import UserError
from swarmtwin.files import write_text
from swarmtwin.generators.base import Generator
from swarmtwin.generators.card import card
from swarmtwin.generators.columns import Columns
from swarmtwin.generators.lineage import Lineage
from swarmtwin.generators.quality import Quality
from swarmtwin.generators.registry import generator_config
from swarmtwin.robot import Robot, StrictModel

DESCRIPTION = "generator.yaml"
CARD = "README.md"
REMEDY = "generate the folder anew"


class Description(StrictModel):
    """The content of `generator.yaml`.

    Attributes:
        format: changes when older versions cannot read the folder.
        generator: name and configuration, which is the recipe as well, looked up among those of this package.
        robot: the robot, in full.
        columns: what a row holds, in order, with units; displacements in the vehicle's frame, poses in the arena's.
        lineage: what it learned from.
        quality: how good its samples are.
    """

    format: Literal[1] = 1
    generator: dict[str, Any]
    robot: Robot
    columns: dict[str, str]
    lineage: Lineage
    quality: Quality


def save_generator(folder: Path, generator: Generator, lineage: Lineage, quality: Quality) -> None:
    """Write a generator into an existing `folder`."""
    description = Description(
        generator=generator.config.model_dump(mode="json"),
        robot=generator.robot,
        columns=generator.columns.units,
        lineage=lineage,
        quality=quality,
    )
    weights.save_weights(folder, generator.state_dict())
    content = description.model_dump(mode="json")
    write_text(folder / DESCRIPTION, yaml.safe_dump(content, sort_keys=False, allow_unicode=True))
    write_text(folder / CARD, card(content, generator.robot, quality))


def read_description(folder: Path) -> Description:
    """Read what `folder` says of its generator.

    Raises:
        UserError: there is no generator, or its description is damaged.
    """
    path = folder / DESCRIPTION
    return Description.parse(weights.read_description(path, "generator", "generate", REMEDY), str(path))


def load_generator(folder: Path) -> tuple[Generator, Description]:
    """Load a generator to sample from; nothing in the folder is executed.

    Raises:
        UserError: a file is missing, damaged, or does not belong to the other.
    """
    description = read_description(folder)
    config = generator_config(description.generator, f"{folder / DESCRIPTION}: generator")
    units = Columns.of(description.robot).units
    if list(units.items()) != list(description.columns.items()):
        raise UserError(
            f"{folder / DESCRIPTION}: columns: {', '.join(description.columns)} are not those of its robot: "
            f"{', '.join(units)}; {REMEDY}"
        )
    trained = weights.load_weights(folder, REMEDY)
    with torch.random.fork_rng(devices=[]):
        generator = config.build(description.robot)
    try:
        generator.load_state_dict(trained)
    except RuntimeError:  # names or shapes differ
        raise weights.not_belonging(folder, DESCRIPTION, REMEDY) from None
    return generator.eval(), description
