"""What a person sees while seeds train: one bar each, with its errors on the validation runs."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from swarmtwin.dynamics.progress import Epoch, EpochReport
from swarmtwin.policies.stage import Stage, StageReport


@contextmanager
def training_bars(name: str, epochs: int) -> Iterator[EpochReport]:
    """Show a bar for each seed while the block trains; give the function that moves them."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[errors]}"),
    )
    with Progress(*columns, console=Console(stderr=True)) as bars:
        tasks: dict[int, TaskID] = {}

        def report(seed: int, number: int, epoch: Epoch) -> None:
            if seed not in tasks:
                tasks[seed] = bars.add_task(f"{name}, seed {seed}", total=epochs, errors="")
            errors = f"{epoch.validation_position_mm:.2f} mm  {epoch.validation_orientation_deg:.2f}°"
            bars.update(tasks[seed], completed=number, errors=errors)

        yield report


@contextmanager
def learning_bars(name: str, steps: int) -> Iterator[StageReport]:
    """Show a bar for each seed while policies are learned; give the function that moves them."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[evaluation]}"),
    )
    with Progress(*columns, console=Console(stderr=True)) as bars:
        tasks: dict[int, TaskID] = {}

        def report(seed: int, done: int, stage: Stage | None) -> None:
            if seed not in tasks:
                tasks[seed] = bars.add_task(f"{name}, seed {seed}", total=steps, evaluation="")
            evaluation = f"success {stage.success:.0%}  reward {stage.reward:.2f}" if stage else ""
            bars.update(tasks[seed], completed=done, evaluation=evaluation)

        yield report


@contextmanager
def stage_bar(name: str) -> Iterator[Callable[[str, int, int], None]]:
    """Show one bar that says what is being done while the block works; give the function that moves it."""
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TextColumn("{task.fields[stage]}"))
    with Progress(*columns, console=Console(stderr=True)) as bars:
        task = bars.add_task(name, total=None, stage="")

        def report(stage: str, done: int, total: int) -> None:
            bars.update(task, completed=done, total=total, stage=stage)

        yield report
