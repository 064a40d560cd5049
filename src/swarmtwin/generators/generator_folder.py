"""A generator as a folder to give away: a description, weights, and a card that a stranger understands; no real row."""

from pathlib import Path
from typing import Any, Literal

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from torch import Tensor

from swarmtwin.errors import UserError
from swarmtwin.files import write_text
from swarmtwin.generators.columns import Columns
from swarmtwin.generators.generator import Generator, generator_config
from swarmtwin.generators.old_diffusion import renewed_config, renewed_weights
from swarmtwin.generators.quality import Quality
from swarmtwin.generators.sampling import Drawn, synthetic_transitions
from swarmtwin.learning.stored_folder import StoredFolder
from swarmtwin.robot import DISPLACEMENT_COLUMNS, Arena, Robot, StrictModel
from swarmtwin.transitions import Fractions, GeneratorOrigin, Preparation, RecordingOrigin, Transitions
from swarmtwin.transitions.preparation import CountsByReason, counts_by_split, runs_by_split


class Lineage(RecordingOrigin):
    """What a generator learned from.

    Attributes:
        fractions: how the recording was split.
        transitions: real ones it was trained on, and real ones its training was followed by.
        learned: marks of the tracks it may have seen: train and validation.
        seed: of the training.
    """

    fractions: Fractions
    transitions: dict[Literal["train", "validation"], int]
    learned: tuple[str, ...]
    seed: int

    @classmethod
    def of(cls, preparation: Preparation, learned_from: Transitions, seed: int) -> "Lineage":
        """Describe a generator trained on those of the prepared transitions that it `learned_from`."""
        return cls.shared_with(
            preparation,
            fractions=preparation.fractions,
            transitions={"train": len(learned_from.part("train")), "validation": len(learned_from.part("validation"))},
            learned=preparation.learned,
            seed=seed,
        )

    @property
    def real_transitions(self) -> int:
        """How many real transitions were used."""
        return sum(self.transitions.values())

    def synthetic(
        self, columns: Columns, drawn: Drawn, name: str, digest: str, seed: int
    ) -> tuple[Transitions, Preparation]:
        """Turn rows drawn from generator `name` with `seed` into transitions with lineage, split as the real ones."""
        validation = round(len(drawn.rows) * self.transitions["validation"] / self.real_transitions)
        transitions = synthetic_transitions(columns, drawn.rows, max(2, validation))
        preparation = Preparation.shared_with(
            self,
            robot=columns.robot.name,
            arena_mm=columns.arena_mm,
            fractions=self.fractions,
            seed=seed,
            counts=CountsByReason(
                rows=0,
                dropped_rows={},
                considered=len(drawn.rows) + drawn.redrawn,
                kept=len(drawn.rows),
                dropped={"unbelievable": drawn.redrawn} if drawn.redrawn else {},
            ),
            runs=runs_by_split(transitions),
            transitions=counts_by_split(transitions),
            learned=self.learned,
            origin="synthetic",
            generator=GeneratorOrigin(name=name, digest=digest, seed=seed, real_transitions=self.real_transitions),
        )
        return transitions, preparation


def card(description: dict[str, Any], columns: Columns, quality: Quality) -> str:
    """Write the card of a generator from the content of its `generator.yaml`."""
    environment = Environment(
        loader=PackageLoader("swarmtwin.generators", "."),
        undefined=StrictUndefined,
        keep_trailing_newline=True,
        trim_blocks=True,
    )
    robot = columns.robot
    meanings = {name: f"command, {column.low:g} to {column.high:g}" for name, column in robot.command.items()} | {
        "x_mm": "where the vehicle is at the start of the period, in the arena's frame",
        "y_mm": "likewise",
        "heading_rad": "where it looks then, counter-clockwise from the arena's x axis, (−π, π]",
        "forward_mm": "how far it moves over the period along its nose, in its frame at the start",
        "left_mm": "how far to its left, likewise",
        "turn_rad": "how far it turns, counter-clockwise positive",
    }
    return environment.get_template("card.md.jinja").render(
        robot=robot,
        kind=description["generator"]["name"],
        columns=[(name, unit, meanings[name]) for name, unit in columns.units.items()],
        lineage=description["lineage"],
        quality=quality,
        spreads=[_spread_row(name, quality) for name in DISPLACEMENT_COLUMNS],
    )


def _spread_row(name: str, quality: Quality) -> tuple[str, str, str, str]:
    """Return a displacement in a unit people read, and its spreads in generated, learned and held-out rows."""
    in_degrees = name == "turn_rad"
    factor = 180 / np.pi if in_degrees else 1.0
    sets = (quality.synthetic.spread, quality.real.spread, quality.held_out_spread)
    generated, learned, held_out = (f"{factor * spread[name]:.2f}" for spread in sets)
    return "turn, °" if in_degrees else name.replace("_mm", ", mm"), generated, learned, held_out


DESCRIPTION = "generator.yaml"
CARD = "README.md"


class Description(StrictModel):
    """The content of `generator.yaml`.

    Attributes:
        format: changes when older versions cannot read the folder.
        generator: name and configuration, which is the recipe as well, looked up among those of this package.
        robot: the robot, in full.
        arena_mm: the arena of the recording, in the frame of the poses; null in old folders: the robot's usual one.
        columns: what a row holds, in order, with units; displacements in the vehicle's frame, poses in the arena's.
        lineage: what it learned from.
        quality: how good its samples are.
    """

    format: Literal[1] = 1
    generator: dict[str, Any]
    robot: Robot
    arena_mm: Arena | None = None
    columns: dict[str, str]
    lineage: Lineage
    quality: Quality


GENERATOR_FOLDER = StoredFolder(
    DESCRIPTION,
    Description,
    holds="generator",
    made_by="generate",
    remedy="generate the folder anew",
    allow_unicode=True,
)

read_description = GENERATOR_FOLDER.read


def save_generator(folder: Path, generator: Generator, lineage: Lineage, quality: Quality) -> None:
    """Write a generator into an existing `folder`."""
    columns = generator.columns
    description = Description(
        generator=generator.config.model_dump(mode="json"),
        robot=columns.robot,
        arena_mm=columns.arena_mm,
        columns=columns.units,
        lineage=lineage,
        quality=quality,
    )
    GENERATOR_FOLDER.save(folder, description, generator.state_dict())
    write_text(folder / CARD, card(description.model_dump(mode="json"), columns, quality))


def load_generator(folder: Path) -> tuple[Generator, Description]:
    """Load a generator to sample from; nothing in the folder is executed.

    What earlier versions saved as `diffusion` is loaded as `residual_diffusion`: the name promised more than it was.

    Raises:
        UserError: a file is missing, damaged, or does not belong to the other.
    """
    description = read_description(folder)
    columns = Columns.of(description.robot, description.arena_mm)
    if list(columns.units.items()) != list(description.columns.items()):
        raise UserError(
            f"{folder / DESCRIPTION}: columns: {', '.join(description.columns)} are not those of its robot: "
            f"{', '.join(columns.units)}; {GENERATOR_FOLDER.remedy}"
        )
    content, where = description.generator, f"{folder / DESCRIPTION}: generator"
    old = content.get("name") == "diffusion"
    config = generator_config(renewed_config(content, columns) if old else content, where)

    def build(weights: dict[str, Tensor]) -> Generator:
        generator = config.build(columns)
        generator.load_state_dict(renewed_weights(weights, columns) if old else weights)
        return generator.eval()

    return GENERATOR_FOLDER.load_into(folder, build), description
