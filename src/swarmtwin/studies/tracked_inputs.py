"""What commands and studies are given, as they show it in MLflow beside their runs."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from swarmtwin.files import folder_digest
from swarmtwin.recordings.recording import Recording
from swarmtwin.robot import DISPLACEMENT_COLUMNS, POSE_COLUMNS
from swarmtwin.tracking.datasets import Dataset
from swarmtwin.transitions import SPLITS
from swarmtwin.transitions.source import TransitionSource
from swarmtwin.transitions.transitions import Split


def model_input(folder: Path, context: str) -> Dataset:
    """Describe the folder of a model, which is known by the digest of its weights and description."""
    return Dataset(folder, context, folder_digest(folder))


def recording_input(folder: Path, context: str, recording: Recording) -> Dataset:
    """Describe a recording that was read from a folder, or the part of it that is used."""
    profile = {"rows": sum(map(len, recording.tracks)), "runs": len(recording.runs)}
    columns = ("time_s", *recording.robot.command_columns, *POSE_COLUMNS)
    return Dataset(folder, context, recording.digest, profile, columns)


def split_inputs(folder: Path, transitions: TransitionSource, splits: Sequence[Split] = SPLITS) -> list[Dataset]:
    """Describe the splits of transitions that were read from a folder, each with a digest of its own."""
    columns = (*transitions.robot.command_columns, *POSE_COLUMNS, *DISPLACEMENT_COLUMNS)
    contexts = {"train": "training", "validation": "validation", "test": "test"}
    runs, digests = _runs_by_split(transitions), transitions.digests()
    return [
        Dataset(folder, contexts[split], digests[split], {"rows": rows, "runs": runs[split]}, columns)
        for split in splits
        if (rows := transitions.count(split))
    ]


def _runs_by_split(transitions: TransitionSource) -> dict[Split, int]:
    """Return how many runs have transitions in each split."""
    there = np.zeros((len(SPLITS), len(transitions.runs)), dtype=bool)
    for block in transitions.blocks(("run", "split")):
        there[block["split"], block["run"]] = True
    return dict(zip(SPLITS, there.sum(axis=1).tolist(), strict=True))
