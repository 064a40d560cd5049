"""A dynamics model as a folder: a description to read, and weights that nothing executable can hide in.

Beside them may lie evidence: measured transitions that the model was not fitted to. What a simulation gets wrong on a
later session is a gap only where it did not get the same wrong on the day it was learned; a diagnosis (DESIGN section
7) takes that from the evidence, so that it needs nothing but the model's folder and the session.
"""

from pathlib import Path
from typing import Any, Literal

import yaml

from swarmtwin.dynamics.model_config import model_config
from swarmtwin.dynamics.motion_noise import MotionNoise
from swarmtwin.dynamics.predictor import NetworkDynamics
from swarmtwin.errors import UserError
from swarmtwin.files import write_text
from swarmtwin.learning import weights
from swarmtwin.robot import Robot, SituationPart, StrictModel
from swarmtwin.transitions import Transitions, read_transitions, write_transitions

DESCRIPTION = "model.yaml"
EVIDENCE = "evidence.parquet"
REMEDY = "train the model anew"


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


def save_dynamics(folder: Path, dynamics: NetworkDynamics, provenance: dict[str, Any]) -> None:
    """Write a model into an existing `folder`. Provenance is plain data, as YAML knows it."""
    description = Description(
        model=dynamics.config.model_dump(mode="json"),
        robot=dynamics.robot,
        situation=dynamics.inputs,
        provenance=provenance,
        motion_noise=dynamics.motion_noise,
    )
    weights.save_weights(folder, dynamics.state_dict())
    write_text(folder / DESCRIPTION, yaml.safe_dump(description.model_dump(mode="json"), sort_keys=False))


def read_description(folder: Path) -> Description:
    """Read what `folder` says of its model.

    Raises:
        UserError: there is no model, or its description is damaged.
    """
    path = folder / DESCRIPTION
    return Description.parse(weights.read_description(path, "model", "train", REMEDY), str(path))


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
    folder = Path(folder)
    description = read_description(folder)
    config = model_config(description.model, f"{folder / DESCRIPTION}: model")
    if (inputs := config.inputs(description.robot)) != description.situation:
        raise UserError(
            f"{folder / DESCRIPTION}: situation: {', '.join(description.situation) or 'nothing'} is not what its model "
            f"looks at: {', '.join(inputs)}; {REMEDY}"
        )
    trained = weights.load_weights(folder, REMEDY)
    try:
        dynamics = NetworkDynamics.with_weights(description.robot, config, trained)
    except RuntimeError:  # names or shapes differ
        raise weights.not_belonging(folder, DESCRIPTION, REMEDY) from None
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
    return read_transitions(file, REMEDY) if file.is_file() else None
