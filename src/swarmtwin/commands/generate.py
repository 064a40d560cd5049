"""`swarmtwin generate`: a generator learns from real transitions and draws synthetic ones, or a given one draws."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
from pydantic import Field
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from swarmtwin.commands.outputs import output_folder
from swarmtwin.commands.sources import Vehicles, training_transitions
from swarmtwin.errors import UserError
from swarmtwin.files import check_output, folder_digest, new_folder, write_text
from swarmtwin.generators.base import Generator
from swarmtwin.generators.figures import quality_figure, training_figure
from swarmtwin.generators.fitting import Record, Report, fit
from swarmtwin.generators.generator_config import GeneratorConfig
from swarmtwin.generators.lineage import Lineage
from swarmtwin.generators.quality import Quality, Sets, assess
from swarmtwin.generators.registry import generator_config
from swarmtwin.generators.sampling import Drawn, draw_believable
from swarmtwin.generators.store import load_generator, read_description, save_generator
from swarmtwin.robot import Robot, Seed, StrictModel
from swarmtwin.tracking import TrackedRun, tracked_run
from swarmtwin.transitions import Preparation, SplitOptions, Transitions, first_runs
from swarmtwin.transitions.preparation import save_preparation
from swarmtwin.transitions.transitions import Split

GENERATOR, TRANSITIONS = "generator", "transitions"


class Options(StrictModel):
    """Options of `swarmtwin generate`; their defaults stand in conf/generate.yaml."""

    robot: Robot | None
    generator: dict[str, Any]
    split: SplitOptions
    transitions: Path | None
    recording: Path | None
    vehicles: Vehicles
    real: Annotated[int, Field(ge=1)] | None
    from_folder: Annotated[Path | None, Field(alias="from")]
    count: Annotated[int, Field(ge=2)] | None
    seed: Seed
    output: Path | None
    overwrite: bool


def run(options: Options) -> None:
    """Train a generator and draw from it, or draw from the one given.

    Raises:
        UserError: no usable transitions or generator, one of another robot, or the output is taken.
    """
    if options.from_folder:
        return _draw_from(options, options.from_folder)
    if options.robot is None:
        raise UserError("say of which robot: robot=..., or give a generator's folder: from=...")
    return _train(options, options.robot)


@dataclass(frozen=True)
class Made:
    """A trained generator, how its training went, what was drawn from it, and how good that is."""

    generator: Generator
    history: list[Record]
    lineage: Lineage
    drawn: Drawn
    sets: Sets
    quality: Quality


def _draw_from(options: Options, source: Path) -> None:
    description = read_description(source)
    _check_alone(options, description.robot, source)
    output = output_folder(options.output, "generate", f"{description.robot.name}-{description.generator['name']}")
    settings = options.model_dump(mode="json", by_alias=True)
    check_output(output, "generate", options.overwrite, [source])
    generator, description = load_generator(source)
    with new_folder(output, "generate", settings, options.overwrite, inputs=[source]) as folder:
        drawn = draw_believable(generator, options.count or description.lineage.real_transitions, options.seed)
        _save_transitions(folder, source, generator, description.lineage, drawn, options.seed)
    _say(_drawn_text(output, drawn))


def _check_alone(options: Options, robot: Robot, source: Path) -> None:
    """Check that nothing beside the generator's folder says what to learn from, nor another robot."""
    for name in ("transitions", "recording", "vehicles", "real"):
        if getattr(options, name) is not None:
            raise UserError(
                f"from=... draws from a trained generator, which needs no {name}=...: leave one of them out"
            )
    if options.robot and options.robot != robot:
        said = options.robot.name
        if said != robot.name:
            raise UserError(f"{source} is a generator of robot {robot.name!r}, not of {said!r}: leave robot=... out")
        raise UserError(f"{source} was made for another {said!r} than conf/robot states: leave robot=... out")


def _train(options: Options, robot: Robot) -> None:
    config = generator_config(options.generator, "generator")
    transitions, preparation, source = training_transitions(
        robot, options.transitions, options.recording, options.vehicles, options.split
    )
    if preparation.origin != "real":
        raise UserError(f"{source} holds {preparation.origin} transitions: a generator learns from real ones only")
    name = f"{robot.name}-{config.name}"
    output = output_folder(options.output, "generate", f"{name}-seed{options.seed}")
    settings = options.model_dump(mode="json", by_alias=True)
    check_output(output, "generate", options.overwrite, [source])
    with tracked_run("generator", name, settings, [source], options.seed) as tracked:
        started = time.monotonic()
        with new_folder(output, "generate", settings, options.overwrite, inputs=[source]) as folder:
            made = _make(transitions, preparation, config, options)
            _save(folder, made, options.seed)
        _track(tracked, made, time.monotonic() - started)
        tracked.folder(output / GENERATOR, GENERATOR)
    Console().print(_table(name, made.quality))
    _say(_drawn_text(output, made.drawn))
    _say(f"the generator, to give away, learned from {made.lineage.real_transitions} real ones: {output / GENERATOR}")


def _make(transitions: Transitions, preparation: Preparation, config: GeneratorConfig, options: Options) -> Made:
    """Train, draw, and compare with real transitions that the generator has not seen."""
    learned_from = first_runs(transitions, options.real) if options.real else transitions
    with _training_bar(f"{transitions.robot.name} {config.name}", config.training_steps) as report:
        generator, history = fit(learned_from, config, options.seed, report)
    lineage = Lineage.of(preparation, learned_from, options.seed)
    drawn = draw_believable(generator, options.count or lineage.real_transitions, options.seed)
    split: Split = "test" if len(transitions.part("test")) else "validation"
    rows = generator.columns.rows
    sets = Sets(drawn.rows, rows(learned_from.part("train")), rows(transitions.part(split)))
    quality = assess(generator.columns, sets, split, drawn.redrawn_share, options.seed)
    return Made(generator, history, lineage, drawn, sets, quality)


def _save(folder: Path, made: Made, seed: int) -> None:
    (folder / GENERATOR).mkdir()
    save_generator(folder / GENERATOR, made.generator, made.lineage, made.quality)
    _save_transitions(folder, folder / GENERATOR, made.generator, made.lineage, made.drawn, seed)
    write_text(folder / "quality.json", made.quality.model_dump_json(indent=1) + "\n")
    title = f"{made.generator.robot.title}: synthetic transitions by {made.generator.config.name}"
    quality_figure(made.generator.columns, made.sets, made.quality, title).savefig(folder / "quality.png")
    pd.DataFrame(made.history).to_csv(folder / "history.csv", index=False, float_format="%.6g")
    training_figure(made.history).savefig(folder / "history.png")


def _save_transitions(
    folder: Path, source: Path, generator: Generator, lineage: Lineage, drawn: Drawn, seed: int
) -> None:
    """Write what was drawn from the generator, which lies in `source`, with its lineage."""
    (folder / TRANSITIONS).mkdir()
    name, digest = generator.config.name, folder_digest(source)
    save_preparation(folder / TRANSITIONS, *lineage.synthetic(generator.robot, drawn, name, digest, seed))


def _track(tracked: TrackedRun, made: Made, seconds: float) -> None:
    tracked.metrics(made.quality.tracked() | {"training_s": seconds})
    tracked.history((int(record["step"]), {k: v for k, v in record.items() if k != "step"}) for record in made.history)
    tracked.tag("recording", made.lineage.recording)
    tracked.tag("recording.digest", made.lineage.digest)


@contextmanager
def _training_bar(name: str, steps: int) -> Iterator[Report]:
    """Show a bar while the block trains; give the function that moves it."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, TextColumn("{task.fields[figures]}"), console=Console(stderr=True)) as bars:
        task = bars.add_task(name, total=steps, figures="")

        def report(record: Record) -> None:
            figures = "  ".join(f"{value:.4g}" for key, value in record.items() if key.startswith("validation"))
            bars.update(task, completed=record["step"], figures=figures)

        yield report


def _table(name: str, quality: Quality) -> Table:
    table = Table("", "synthetic", "real", title=f"{name}: samples against {quality.held_out}")
    for column in table.columns[1:]:
        column.justify = "right"
    for label, synthetic, real in quality.rows():
        table.add_row(label, synthetic, real)
    table.caption = "real: transitions learned from, measured alike"
    return table


def _drawn_text(output: Path, drawn: Drawn) -> str:
    redrawn = f", {drawn.redrawn} beyond belief drawn again" if drawn.redrawn else ""
    return f"{len(drawn.rows)} synthetic transitions{redrawn}: {output / TRANSITIONS}"


def _say(text: str) -> None:
    Console().print(text, highlight=False, soft_wrap=True)
