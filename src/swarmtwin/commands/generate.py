"""`swarmtwin generate`: a generator learns from real transitions and draws synthetic ones, or a given one draws."""

import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from swarmtwin.errors import UserError
from swarmtwin.files import check_output, new_folder, output_folder
from swarmtwin.generators.generator import generator_config
from swarmtwin.generators.generator_folder import load_generator, read_description
from swarmtwin.generators.quality import Quality
from swarmtwin.generators.quality_plots import draw_synthesis
from swarmtwin.generators.sampling import Drawn, draw_believable
from swarmtwin.generators.synthesis import GENERATOR, TRANSITIONS, save_drawn, save_synthesis, synthesise
from swarmtwin.generators.training import Record, Report
from swarmtwin.learning.device import Device
from swarmtwin.learning.trainer_settings import LiveCurves, TrainerSettings
from swarmtwin.robot import Robot, Seed, StrictModel
from swarmtwin.studies.tracked_inputs import split_inputs
from swarmtwin.tracking.runs import tracked_run
from swarmtwin.tracking.store import store_uri
from swarmtwin.transitions import SplitOptions
from swarmtwin.transitions.inputs import Vehicles, training_transitions


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
    trainer: TrainerSettings
    device: Device
    seed: Seed
    pictures: bool
    output: Path | None
    overwrite: bool


def run(options: Options) -> dict[str, Any]:
    """Train a generator and draw from it, or draw from the one given; return how good that is, if it was measured.

    Raises:
        UserError: no usable transitions or generator, one of another robot, or the output is taken.
    """
    if options.from_folder:
        return _draw_from(options, options.from_folder)
    _check_trainer(options.trainer)
    assert options.robot is not None
    return _train(options, options.robot)


def _check_trainer(trainer: TrainerSettings) -> None:
    """Check that a generator can be trained so: by one process, to the end."""
    if trainer.processes > 1:
        raise UserError("a generator is trained by one process: trainer=default or trainer=gpu")
    if trainer.patience_epochs is not None:
        raise UserError("a generator has no loss by which it could end early: leave trainer.patience_epochs out")


def _draw_from(options: Options, source: Path) -> dict[str, Any]:
    description = read_description(source)
    _check_alone(options, description.robot, source)
    output = output_folder(options.output, "generate", f"{description.robot.name}-{description.generator['name']}")
    settings = options.model_dump(mode="json", by_alias=True)
    check_output(output, "generate", options.overwrite, [source])
    generator, description = load_generator(source)
    with new_folder(output, "generate", settings, options.overwrite, inputs=[source]) as folder:
        drawn = draw_believable(generator, options.count or description.lineage.real_transitions, options.seed)
        save_drawn(folder / TRANSITIONS, source, generator, description.lineage, drawn, options.seed)
    _say(_drawn_text(output, drawn))
    return {"transitions": len(drawn.rows), "output": str(output)}


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


def _train(options: Options, robot: Robot) -> dict[str, Any]:
    config = generator_config(options.generator, "generator")
    transitions, preparation, source = training_transitions(
        robot, options.transitions, options.recording, options.vehicles, options.split
    )
    if preparation.origin != "real":
        raise UserError(f"{source} holds {preparation.origin} transitions: a generator learns from real ones only")
    name = f"{robot.name}-{config.name}"
    output = output_folder(options.output, "generate", f"{name}-seed{options.seed}")
    settings = options.model_dump(mode="json", by_alias=True)
    with (
        new_folder(output, "generate", settings, options.overwrite, inputs=[source]) as folder,
        tracked_run(
            "generator",
            name,
            settings,
            split_inputs(source, transitions),
            options.seed,
            options.trainer.system_metrics,
        ) as tracked,
    ):
        started = time.monotonic()
        tracked.warnings(preparation.warnings)
        bars = options.trainer.progress_bar == "epochs"
        curves = LiveCurves(tracked.run_id, store_uri()) if options.trainer.logger == "mlflow" else None
        with _training_bar(f"{robot.name} {config.name}") if bars else nullcontext() as report:
            made = synthesise(
                transitions,
                preparation,
                config,
                options.seed,
                real=options.real,
                count=options.count,
                report=report,
                device=options.device,
                trainer=options.trainer,
                curves=curves,
            )
        save_synthesis(folder, made, options.seed)
        if options.pictures:
            draw_synthesis(folder, folder)
        tracked.metrics(made.quality.tracked() | {"training_s": time.monotonic() - started})
        if not curves:
            tracked.history((int(one["step"]), {k: v for k, v in one.items() if k != "step"}) for one in made.history)
        tracked.tag("recording", made.lineage.recording)
        tracked.tag("recording.digest", made.lineage.digest)
        tracked.folder(folder / GENERATOR, GENERATOR)
    Console().print(_table(name, made.quality))
    _say(_drawn_text(output, made.drawn))
    _say(f"the generator, to give away, learned from {made.lineage.real_transitions} real ones: {output / GENERATOR}")
    figures = made.quality.tracked()
    shown = ("told_apart", "precision", "recall", "nearer_to_learned", "exact_copies")
    return {**{name: figures[name] for name in shown}, "output": str(output)}


@contextmanager
def _training_bar(name: str) -> Iterator[Report]:
    """Show a bar while the block trains; give the function that moves it."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, TextColumn("{task.fields[figures]}"), console=Console(stderr=True)) as bars:
        task = bars.add_task(name, total=None, figures="")

        def report(record: Record, steps: int) -> None:
            figures = "  ".join(f"{value:.4g}" for key, value in record.items() if key.startswith("validation"))
            bars.update(task, total=steps, completed=record["step"], figures=figures)

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
