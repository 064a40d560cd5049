"""What the experiments on grids of trainings left, collected: their summaries, tables and pictures."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from swarmtwin.errors import UserError
from swarmtwin.files import PROVENANCE, read_provenance
from swarmtwin.robot import StrictModel
from swarmtwin.studies.training_grid.summary import Summary
from swarmtwin.studies.training_grid.table_file import read_table


@dataclass(frozen=True)
class Collected:
    """What one experiment left.

    Attributes:
        folder: where.
        summary: metrics.json.
        table: table.csv.
        pictures: in the order of their names.
    """

    folder: Path
    summary: Summary
    table: pd.DataFrame
    pictures: tuple[Path, ...]


def collect(parent: Path) -> list[Collected]:
    """Return what the experiments in a folder left, tables before figures, each by its number.

    Raises:
        UserError: there is none, or what one left is damaged.
    """
    folders = [
        file.parent for file in sorted(parent.glob(f"[!.]*/{PROVENANCE}"))
    ]  # what is not finished begins with a dot
    found = [_collected(folder) for folder in folders if _is_grid(folder)]
    if not found:
        raise UserError(
            f"{parent} holds no output of an experiment on trainings: run `swarmtwin experiment name=table1 "
            f"output={parent / 'table1'}`, and others likewise"
        )
    return sorted(found, key=lambda one: (not one.summary.name.startswith("table"), _number(one.summary.name)))


def _is_grid(folder: Path) -> bool:
    command, options = read_provenance(folder)
    return command == "experiment" and options.get("study") == "training_grid"


def _collected(folder: Path) -> Collected:
    file = folder / "metrics.json"
    try:
        content = json.loads(file.read_text())
        table = read_table(folder / "table.csv")
    except (OSError, ValueError) as error:
        raise UserError(f"{folder}: {error}; run its experiment again with overwrite=true") from None
    return Collected(folder, Summary.parse(content, str(file)), table, tuple(sorted(folder.glob("*.png"))))


def _number(name: str) -> tuple[int, str]:
    digits = "".join(sign for sign in name if sign.isdigit())
    return int(digits or 0), name


class FloorGain(StrictModel):
    """What knowing the previous commands gains at best, on one recording.

    Attributes:
        robot: whose.
        recording: on which.
        command_mm: mean position error of the best possible model given the robot's situation.
        history_mm: given the commands before as well.
        command_deg: the same of orientation.
        history_deg: likewise.
    """

    robot: str
    recording: str
    command_mm: float
    history_mm: float
    command_deg: float
    history_deg: float

    @property
    def share_mm(self) -> float:
        """The share of the position error that goes."""
        return 1 - self.history_mm / self.command_mm

    @property
    def share_deg(self) -> float:
        """The share of the orientation error that goes."""
        return 1 - self.history_deg / self.command_deg


def floor_gains(collected: Sequence[Collected]) -> list[FloorGain]:
    """Return the gains of all robots and recordings, each once."""
    gains: dict[tuple[str, str], FloorGain] = {}
    names = [
        f"floor_{known}_{quantity}"
        for quantity in ("position_mm", "orientation_deg")
        for known in ("command", "history")
    ]
    for one in collected:
        if not set(names) <= set(one.table):
            continue
        for recording, own in one.table.dropna(subset=names).groupby("recording", sort=False):
            command_mm, history_mm, command_deg, history_deg = (float(own[name].min()) for name in names)
            gain = FloorGain(
                robot=one.summary.robot,
                recording=str(recording),
                command_mm=command_mm,
                history_mm=history_mm,
                command_deg=command_deg,
                history_deg=history_deg,
            )
            gains.setdefault((gain.robot, gain.recording), gain)
    return list(gains.values())


class PaperDistance(StrictModel):
    """How far our figures are from the paper's, in one experiment, recording and quantity.

    Attributes:
        title: the table or figure.
        robot: ours.
        recording: on which.
        quantity: which error.
        figures: how many the paper states.
        median: of our figure as a share of the paper's.
        least: of these shares.
        most: likewise.
        rank_agreement: Spearman's correlation of our order of trainings with the paper's; None of fewer than three.
    """

    title: str
    robot: str
    recording: str
    quantity: str
    figures: int
    median: float
    least: float
    most: float
    rank_agreement: float | None


def paper_distances(collected: Sequence[Collected]) -> list[PaperDistance]:
    """Return the distances of all experiments for which the paper states figures."""
    return [
        distance
        for one in collected
        for recording, own in one.table.groupby("recording", sort=False)
        for quantity in ("position_mm", "orientation_deg", "open_loop_mm")
        if (distance := _distance(one.summary, str(recording), own, quantity))
    ]


def _distance(summary: Summary, recording: str, own: pd.DataFrame, quantity: str) -> PaperDistance | None:
    stated = f"paper_{quantity}"
    if not {stated, quantity} <= set(own):
        return None
    known = own.dropna(subset=[stated, quantity])
    if known.empty:
        return None
    ratio = known[quantity] / known[stated]
    agreement = known[quantity].corr(known[stated], method="spearman") if len(known) > 2 else np.nan
    return PaperDistance(
        title=summary.title,
        robot=summary.robot,
        recording=recording,
        quantity=quantity,
        figures=len(known),
        median=float(ratio.median()),
        least=float(ratio.min()),
        most=float(ratio.max()),
        rank_agreement=None if np.isnan(agreement) else float(agreement),
    )
