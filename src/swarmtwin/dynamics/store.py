"""A dynamics model as a folder: a description to read, and weights that nothing executable can hide in."""

from pathlib import Path
from typing import Any, Literal

import torch
import yaml
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from swarmtwin.dynamics.base import Dynamics
from swarmtwin.dynamics.registry import model_config
from swarmtwin.errors import UserError
from swarmtwin.files import write_text
from swarmtwin.robot import Robot, SituationPart, StrictModel

DESCRIPTION = "model.yaml"
WEIGHTS = "weights.safetensors"


class Description(StrictModel):
    """The content of `model.yaml`.

    Attributes:
        format: changes when older versions cannot read the folder.
        model: name and configuration of the model, looked up among those of this package.
        robot: the robot, in full.
        situation: the parts of a situation that the model looks at.
        provenance: where the model comes from: recording, runs by split, seed, recipe, metrics.
    """

    format: Literal[1] = 1
    model: dict[str, Any]
    robot: Robot
    situation: tuple[SituationPart, ...]
    provenance: dict[str, Any]


def save_dynamics(folder: Path, dynamics: Dynamics, provenance: dict[str, Any]) -> None:
    """Write a model into an existing `folder`. Provenance is plain data, as YAML knows it."""
    description = Description(
        model=dynamics.config.model_dump(mode="json"),
        robot=dynamics.robot,
        situation=dynamics.parts,
        provenance=provenance,
    )
    weights = {name: tensor.detach().cpu().contiguous() for name, tensor in dynamics.state_dict().items()}
    aside = folder / f".{WEIGHTS}.partial"
    try:
        save_file(weights, aside)
        aside.replace(folder / WEIGHTS)
    finally:
        aside.unlink(missing_ok=True)
    write_text(folder / DESCRIPTION, yaml.safe_dump(description.model_dump(mode="json"), sort_keys=False))


def read_description(folder: Path) -> Description:
    """Read what `folder` says of its model.

    Raises:
        UserError: there is no model, or its description is damaged.
    """
    path = folder / DESCRIPTION
    try:
        content = yaml.safe_load(path.read_text())
    except (FileNotFoundError, NotADirectoryError):
        raise UserError(f"no model in {folder}: {DESCRIPTION} is missing; name a folder that train made") from None
    except IsADirectoryError:
        raise _folder_in_place_of_file(path) from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise UserError(f"{path} is damaged: {' '.join(str(error).split())}; train the model anew") from None
    if isinstance(content, dict) and content.get("format") != 1:
        raise UserError(f"{path}: format {content.get('format')!r} is not known here: update swarmtwin, or train anew")
    return Description.parse(content, str(path))


def _folder_in_place_of_file(path: Path) -> UserError:
    return UserError(f"{path} is a folder and should be a file: train the model anew")


def load_dynamics(folder: Path) -> Dynamics:
    """Load a model to predict with; nothing in the folder is executed.

    Raises:
        UserError: a file is missing, damaged, or does not belong to the other.
    """
    folder = Path(folder)
    description = read_description(folder)
    config = model_config(description.model, f"{folder / DESCRIPTION}: model")
    if (parts := config.parts(description.robot)) != description.situation:
        raise UserError(
            f"{folder / DESCRIPTION}: situation: {', '.join(description.situation) or 'nothing'} is not what its model "
            f"looks at: {', '.join(parts)}; train the model anew"
        )
    weights = _read_weights(folder / WEIGHTS)
    try:
        return Dynamics.with_weights(description.robot, config, weights)
    except RuntimeError:  # names or shapes differ
        raise UserError(
            f"{folder / WEIGHTS} does not belong to {DESCRIPTION} beside it: train the model anew"
        ) from None


def _read_weights(path: Path) -> dict[str, torch.Tensor]:
    if path.is_dir():
        raise _folder_in_place_of_file(path)
    try:
        weights: dict[str, torch.Tensor] = load_file(path)
    except FileNotFoundError:
        raise UserError(f"{path} is missing: train the model anew") from None
    except SafetensorError as error:
        raise UserError(f"{path} is damaged ({error}): train the model anew") from None
    if broken := [name for name, tensor in weights.items() if not tensor.isfinite().all()]:
        raise UserError(f"{path}: {broken[0]} is not finite; train the model anew")
    return weights
