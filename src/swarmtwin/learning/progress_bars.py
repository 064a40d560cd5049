"""What a person sees while something is learned or examined: bars that say how far it is, and no talk of details."""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn


@contextmanager
def training_bars(name: str, total: int) -> Iterator[Callable[[int, int, object | None], None]]:
    """Show a bar for each seed while the block trains; give the function that moves them.

    It is called with the seed, how much of `total` is done, and what prints as the latest errors, or None.
    """
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[latest]}"),
    )
    with Progress(*columns, console=Console(stderr=True)) as bars:
        tasks: dict[int, TaskID] = {}

        def report(seed: int, done: int, latest: object | None) -> None:
            if seed not in tasks:
                tasks[seed] = bars.add_task(f"{name}, seed {seed}", total=total, latest="")
            bars.update(tasks[seed], completed=done, latest="" if latest is None else str(latest))

        yield report


@contextmanager
def stage_bar(name: str) -> Iterator[Callable[[str, int, int], None]]:
    """Show one bar while the block works; give the function that moves it: what is being done, how much of how much."""
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TextColumn("{task.fields[stage]}"))
    with Progress(*columns, console=Console(stderr=True)) as bars:
        task = bars.add_task(name, total=None, stage="")

        def report(stage: str, done: int, total: int) -> None:
            bars.update(task, completed=done, total=total, stage=stage)

        yield report


@contextmanager
def quieter(logger: str, least: int = logging.ERROR) -> Iterator[None]:
    """Leave out what a logger, and those below it, say of less weight than `least` while the block works."""
    talking = logging.getLogger(logger)
    level = talking.level
    talking.setLevel(least)
    try:
        yield
    finally:
        talking.setLevel(level)
