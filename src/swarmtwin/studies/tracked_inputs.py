"""What commands and studies are given, as they show it in MLflow beside their runs."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from swarmtwin.files import folder_digest
from swarmtwin.recordings.recording import Recording
from swarmtwin.robot import DISPLACEMENT_COLUMNS, POSE_COLUMNS
from swarmtwin.tracking.datasets import Dataset
from swarmtwin.transitions import SPLITS, Transitions
from swarmtwin.transitions.transitions import Split


def model_input(folder: Path, context: str) -> Dataset:
    """Describe the folder of a model, which is known by the digest of its weights and description."""
    return Dataset(folder, context, folder_digest(folder))


def recording_input(folder: Path, context: str, recording: Recording) -> Dataset:
    """Describe a recording that was read from a folder, or the part of it that is used."""
    profile = {"rows": sum(map(len, recording.tracks)), "runs": len(recording.runs)}
    columns = ("time_s", *recording.robot.command_columns, *POSE_COLUMNS)
    return Dataset(folder, context, recording.digest, profile, columns)


def split_inputs(folder: Path, transitions: Transitions, splits: Sequence[Split] = SPLITS) -> list[Dataset]:
    """Describe the splits of transitions that were read from a folder, each with a digest of its own."""
    columns = (*transitions.robot.command_columns, *POSE_COLUMNS, *DISPLACEMENT_COLUMNS)
    contexts = {"train": "training", "validation": "validation", "test": "test"}
    parts = {split: part for split in splits if len(part := transitions.part(split))}
    return [
        Dataset(folder, contexts[split], part.digest(), {"rows": len(part), "runs": len(np.unique(part.run))}, columns)
        for split, part in parts.items()
    ]
