"""A diagnosis as files: all that a report is made of, `diagnosis.json` first."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
import pandas as pd

from swarmtwin.diagnosis.result import DiagnosedSession, DiagnosisResult
from swarmtwin.dynamics.evaluation import predict
from swarmtwin.errors import UserError
from swarmtwin.files import write_text
from swarmtwin.robot import DISPLACEMENT_COLUMNS
from swarmtwin.simulation.open_loop import OpenLoop
from swarmtwin.simulation.open_loop_storage import load_open_loop, save_open_loop
from swarmtwin.transitions import Transitions, read_transitions, write_transitions
from swarmtwin.transitions.storage import readable

RESULT, RESIDUALS = "diagnosis.json", "residuals.parquet"
PARTS = ("simulated", "residual_before", "residual_after")
RUNS_BEFORE, RUNS_AFTER = "open_loop_before.parquet", "open_loop_after.parquet"


def save_findings(folder: Path, diagnosed: DiagnosedSession) -> None:
    """Write `diagnosis.json` and all else that a report is made of: transitions with their residuals, held-out runs."""
    write_text(folder / RESULT, diagnosed.result.model_dump_json(indent=1) + "\n")
    transitions = diagnosed.transitions
    parts = (predict(diagnosed.simulation, transitions), diagnosed.residual_before, diagnosed.residual_after)
    columns = {
        column: values
        for name, part in zip(PARTS, parts, strict=True)
        for column, values in zip(_columns(name), part.T, strict=True)
    }
    write_transitions(folder / RESIDUALS, transitions, {"held_out": diagnosed.held_out, **columns})
    save_open_loop(folder / RUNS_BEFORE, diagnosed.runs_before, transitions.arena_mm)
    save_open_loop(folder / RUNS_AFTER, diagnosed.runs_after, transitions.arena_mm)


@dataclass(frozen=True)
class SavedDiagnosis:
    """A diagnosis as its folder holds it: what a report is made of; the attributes are those of `DiagnosedSession`.

    Attributes:
        result: what it says.
        transitions: the N measured transitions.
        held_out: (N,).
        simulated: (N, 3) the displacements that the simulation predicts.
        residual_before: (N, 3).
        residual_after: (N, 3).
        runs_before: held-out runs predicted open loop.
        runs_after: likewise.
    """

    result: DiagnosisResult
    transitions: Transitions
    held_out: np.ndarray
    simulated: np.ndarray
    residual_before: np.ndarray
    residual_after: np.ndarray
    runs_before: tuple[OpenLoop, ...]
    runs_after: tuple[OpenLoop, ...]

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read what `save_findings` wrote.

        Raises:
            UserError: a file is missing or damaged.
        """
        transitions = read_transitions(folder / RESIDUALS, "diagnose again")
        with readable(folder / RESIDUALS, "diagnose again"):
            table = pd.read_parquet(folder / RESIDUALS)
            held_out = table["held_out"].to_numpy()
            simulated, before, after = (table[_columns(part)].to_numpy() for part in PARTS)
        return cls(
            result=read_result(folder),
            transitions=transitions,
            held_out=held_out,
            simulated=simulated,
            residual_before=before,
            residual_after=after,
            runs_before=tuple(load_open_loop(folder / RUNS_BEFORE)[0]),
            runs_after=tuple(load_open_loop(folder / RUNS_AFTER)[0]),
        )


def read_result(folder: Path) -> DiagnosisResult:
    """Read `diagnosis.json`.

    Raises:
        UserError: it is missing or damaged.
    """
    file = folder / RESULT
    try:
        return DiagnosisResult.parse(json.loads(file.read_text()), str(file))
    except (FileNotFoundError, NotADirectoryError):
        raise UserError(f"{file} is missing: name a folder that swarmtwin diagnose made") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{file} is damaged ({error}): diagnose again") from None


def _columns(name: str) -> list[str]:
    return [f"{name}_{column}" for column in DISPLACEMENT_COLUMNS]
