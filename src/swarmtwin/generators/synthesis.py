"""From real transitions to synthetic ones: a generator learns, draws, and is compared with what it has not seen."""

from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from swarmtwin.files import folder_digest, write_text
from swarmtwin.generators.generator import Generator, GeneratorConfig
from swarmtwin.generators.generator_folder import Lineage, save_generator
from swarmtwin.generators.quality import Quality, Sets, assess, marginals
from swarmtwin.generators.sampling import Drawn, draw_believable
from swarmtwin.generators.training import Record, Report, fit
from swarmtwin.learning.device import Device
from swarmtwin.learning.trainer_settings import LiveCurves, TrainerSettings
from swarmtwin.transitions import Preparation, Transitions, first_runs
from swarmtwin.transitions.preparation import save_preparation

GENERATOR, TRANSITIONS = "generator", "transitions"


@dataclass(frozen=True)
class Synthesis:
    """A trained generator, how its training went, what was drawn from it, and how good that is."""

    generator: Generator
    history: list[Record]
    lineage: Lineage
    drawn: Drawn
    sets: Sets
    quality: Quality


def synthesise(
    transitions: Transitions,
    preparation: Preparation,
    config: GeneratorConfig,
    seed: int,
    *,
    real: int | None,
    count: int | None,
    report: Report | None,
    device: Device = "cpu",
    trainer: TrainerSettings | None = None,
    curves: LiveCurves | None = None,
) -> Synthesis:
    """Train, draw, and compare with real transitions that the generator has not seen.

    Those are the validation split: no generator is fitted to it or chosen by it, but generators are chosen by these
    figures, and the test split is kept from all choices.

    Args:
        transitions: real ones, with their splits.
        preparation: how they came about.
        config: of the generator.
        seed: of training and of drawing.
        real: how many of them to learn from, the first runs; None: all.
        count: how many to draw; None: as many as were learned from.
        report: called with each record of the training.
        device: where to train.
        trainer: how Lightning trains; None: its defaults, of which nothing is seen.
        curves: the run that the records are sent to as they are closed; None: none.
    """
    learned_from = first_runs(transitions, real) if real else transitions
    generator, history = fit(learned_from, config, seed, report, device, trainer, curves)
    lineage = Lineage.of(preparation, learned_from, seed)
    drawn = draw_believable(generator, count or lineage.real_transitions, seed)
    rows = generator.columns.rows
    sets = Sets(drawn.rows, rows(learned_from.part("train")), rows(transitions.part("validation")))
    quality = assess(generator.columns, sets, "validation", drawn.redrawn_share, seed)
    return Synthesis(generator, history, lineage, drawn, sets, quality)


def save_synthesis(folder: Path, made: Synthesis, seed: int) -> None:
    """Save the generator, what it drew, how good that is, and how it learned."""
    (folder / GENERATOR).mkdir()
    save_generator(folder / GENERATOR, made.generator, made.lineage, made.quality)
    save_drawn(folder / TRANSITIONS, folder / GENERATOR, made.generator, made.lineage, made.drawn, seed)
    write_text(folder / "quality.json", made.quality.model_dump_json(indent=1) + "\n")
    marginals(made.generator.columns, made.sets).to_csv(folder / "marginals.csv", index=False, float_format="%.6g")
    pd.DataFrame(made.history).to_csv(folder / "history.csv", index=False, float_format="%.6g")


def save_drawn(folder: Path, source: Path, generator: Generator, lineage: Lineage, drawn: Drawn, seed: int) -> None:
    """Write what was drawn from the generator, which lies in `source`, with its lineage."""
    folder.mkdir()
    name, digest = generator.config.name, folder_digest(source)
    save_preparation(folder, *lineage.synthetic(generator.columns, drawn, name, digest, seed))
