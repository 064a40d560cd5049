"""A dynamics model as a folder: a description to read, and weights that nothing executable can hide in.

Beside them may lie evidence: measured transitions that the model was not fitted to. What a simulation gets wrong on a
later session is a gap only where it did not get the same wrong on the day it was learned; a diagnosis (DESIGN section
7) takes that from the evidence, so that it needs nothing but the model's folder and the session.
"""

from pathlib import Path
from typing import Any, Literal

from torch import Tensor

from swarmtwin.dynamics.model_config import model_config
from swarmtwin.dynamics.motion_noise import MotionNoise
from swarmtwin.dynamics.predictor import NetworkDynamics
from swarmtwin.errors import UserError
from swarmtwin.learning.stored_folder import StoredFolder
from swarmtwin.robot import Robot, SituationPart, StrictModel
from swarmtwin.transitions import Transitions, read_transitions, write_transitions

EVIDENCE = "evidence.parquet"


class Description(StrictModel):
    """The content of `model.yaml`.

    Attributes:
        format: changes when older versions cannot read the folder.
        model: name and configuration of the model, looked up among those of this package.
        robot: the robot, in full.
        situation: the parts of a situation that the model looks at.
        provenance: where the model comes from: recording, runs by split, seed, recipe, metrics.
        motion_noise: the random part of motion and camera; null where nobody estimated it, as in earlier versions.
    """

    format: Literal[1] = 1
    model: dict[str, Any]
    robot: Robot
    situation: tuple[SituationPart, ...]
    provenance: dict[str, Any]
    motion_noise: MotionNoise | None = None


MODEL_FOLDER = StoredFolder("model.yaml", Description, holds="model", made_by="train", remedy="train the model anew")

read_description = MODEL_FOLDER.read


def save_dynamics(folder: Path, dynamics: NetworkDynamics, provenance: dict[str, Any]) -> None:
    """Write a model into an existing `folder`. Provenance is plain data, as YAML knows it."""
    description = Description(
        model=dynamics.config.model_dump(mode="json"),
        robot=dynamics.robot,
        situation=dynamics.inputs,
        provenance=provenance,
        motion_noise=dynamics.motion_noise,
    )
    MODEL_FOLDER.save(folder, description, dynamics.state_dict())


def model_name(folder: Path) -> str:
    """Return the name of the model in `folder`, as `model=` of its training.

    Raises:
        UserError: there is no model, or its description is damaged.
    """
    return str(read_description(folder).model.get("name"))


def load_dynamics(folder: Path) -> NetworkDynamics:
    """Load a model to predict with; nothing in the folder is executed.

    Raises:
        UserError: a file is missing, damaged, or does not belong to the other.
    """
    description = read_description(folder)
    file = Path(folder) / MODEL_FOLDER.description_file
    config = model_config(description.model, f"{file}: model")
    if (inputs := config.inputs(description.robot)) != description.situation:
        raise UserError(
            f"{file}: situation: {', '.join(description.situation) or 'nothing'} is not what its model "
            f"looks at: {', '.join(inputs)}; {MODEL_FOLDER.remedy}"
        )

    def build(weights: dict[str, Tensor]) -> NetworkDynamics:
        return NetworkDynamics.with_weights(description.robot, config, weights)

    dynamics = MODEL_FOLDER.load_into(folder, build)
    dynamics.motion_noise = description.motion_noise
    return dynamics


def save_evidence(folder: Path, transitions: Transitions) -> None:
    """Write real transitions that the model in `folder` was not fitted to, for diagnosing later sessions.

    They say how large the model's own errors are, and what they depend on, in the recording that it was learned from.
    """
    write_transitions(folder / EVIDENCE, transitions)


def load_evidence(folder: Path) -> Transitions | None:
    """Read the real transitions, from the recording it was learned from, that the model in `folder` was not fitted to.

    Returns:
        Those of the splits "validation" and "test", whole runs; None where there are none, as with models of synthetic
        transitions alone and of earlier versions.

    Raises:
        UserError: the file is damaged.
    """
    file = Path(folder) / EVIDENCE
    return read_transitions(file, MODEL_FOLDER.remedy) if file.is_file() else None
