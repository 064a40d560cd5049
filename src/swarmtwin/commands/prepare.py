"""`swarmtwin prepare`: a recording becomes transitions, checked, counted by reason and split by run."""

from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from swarmtwin.files import new_folder
from swarmtwin.recordings.tracks import ROW_REASONS
from swarmtwin.robot import Robot, StrictModel
from swarmtwin.transitions import SPLITS, Preparation, SplitOptions
from swarmtwin.transitions.displacement_plots import draw_preparation
from swarmtwin.transitions.extraction import REASONS
from swarmtwin.transitions.preparing import prepare


class Options(StrictModel):
    """Options of `swarmtwin prepare`; their defaults stand in conf/prepare.yaml."""

    robot: Robot
    recording: Path
    split: SplitOptions
    pictures: bool
    output: Path
    overwrite: bool


def run(options: Options) -> dict[str, Any]:
    """Prepare a recording and show what was kept, what was dropped and why; return how many were kept.

    Raises:
        UserError: the recording is at fault, has too few runs to split, or the output is taken.
    """
    settings = options.model_dump(mode="json")
    with new_folder(options.output, "prepare", settings, options.overwrite, inputs=[options.recording]) as folder:
        preparation = prepare(options.recording, options.robot, options.split, folder)
        if options.pictures:
            draw_preparation(folder, folder)
    for table in summary(preparation):
        Console().print(table)
    for warning in preparation.warnings:
        Console().print(f"warning: {warning}", highlight=False, soft_wrap=True)
    counts = preparation.counts
    return {"transitions": counts.kept, "dropped": counts.considered - counts.kept, "output": str(options.output)}


def summary(preparation: Preparation) -> tuple[Table, Table]:
    """Return two tables a person reads: what became of the recording, and how it is split."""
    counts = preparation.counts
    kept = Table("", "count", "", title=f"{preparation.recording} ({preparation.robot})")
    kept.add_row("rows read", str(counts.rows), "")
    for reason, count in counts.dropped_rows.items():
        kept.add_row(f"  {reason}", str(count), ROW_REASONS[reason])
    kept.add_row("pairs of rows", str(counts.considered), "")
    for reason, count in counts.dropped.items():
        kept.add_row(f"  {reason}", str(count), REASONS[reason])
    kept.add_row("transitions kept", str(counts.kept), f"{counts.kept / counts.considered:.2%}")
    splits = Table("split", "runs", "transitions", "share")
    for split in SPLITS:
        number = preparation.transitions[split]
        splits.add_row(split, str(len(preparation.runs[split])), str(number), f"{number / counts.kept:.1%}")
    for table, columns in ((kept, (1,)), (splits, (1, 2, 3))):
        for column in columns:
            table.columns[column].justify = "right"
    return kept, splits
