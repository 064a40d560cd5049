"""Models as folders: a description to read, and weights in which nothing executable can hide."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
import yaml
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from swarmtwin.errors import UserError
from swarmtwin.files import whole_file

WEIGHTS = "weights.safetensors"


def save_weights(folder: Path, weights: Mapping[str, torch.Tensor]) -> None:
    """Write `weights.safetensors` into an existing `folder`, whole or not at all."""
    plain = {name: tensor.detach().cpu().contiguous() for name, tensor in weights.items()}
    with whole_file(folder / WEIGHTS) as aside:
        save_file(plain, aside)


def load_weights(folder: Path, remedy: str) -> dict[str, torch.Tensor]:
    """Read `weights.safetensors` in `folder`; `remedy` says what to do where that cannot be done.

    Raises:
        UserError: the file is missing or damaged, or a weight is not finite.
    """
    path = folder / WEIGHTS
    if path.is_dir():
        raise _folder_in_place_of_file(path, remedy)
    try:
        weights: dict[str, torch.Tensor] = load_file(path)
    except FileNotFoundError:
        raise UserError(f"{path} is missing: {remedy}") from None
    except SafetensorError as error:
        raise UserError(f"{path} is damaged ({error}): {remedy}") from None
    if broken := [name for name, tensor in weights.items() if not tensor.isfinite().all()]:
        raise UserError(f"{path}: {broken[0]} is not finite; {remedy}")
    return weights


def not_belonging(folder: Path, description: str, remedy: str) -> UserError:
    """Return the error for weights whose names or shapes are not those that the description beside them asks for."""
    return UserError(f"{folder / WEIGHTS} does not belong to {description} beside it: {remedy}")


def read_description(path: Path, what: str, made_by: str, remedy: str) -> Any:
    """Read the content of a model's description, format 1, without executing anything in it.

    Args:
        path: the YAML file.
        what: what its folder should hold, such as "model".
        made_by: the command that makes such folders.
        remedy: what to do about a damaged one.

    Raises:
        UserError: the file is missing, damaged, or of another format.
    """
    try:
        content = yaml.safe_load(path.read_text())
    except (FileNotFoundError, NotADirectoryError):
        missing = f"no {what} in {path.parent}: {path.name} is missing"
        raise UserError(f"{missing}; name a folder that {made_by} made") from None
    except IsADirectoryError:
        raise _folder_in_place_of_file(path, remedy) from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise UserError(f"{path} is damaged: {' '.join(str(error).split())}; {remedy}") from None
    if isinstance(content, dict) and content.get("format") != 1:
        found = content.get("format")
        raise UserError(f"{path}: format {found!r} is not known here: update swarmtwin, or {_anew(remedy)}")
    return content


def _anew(remedy: str) -> str:
    """Shorten "train the model anew" to "train anew"."""
    return f"{remedy.split()[0]} anew"


def _folder_in_place_of_file(path: Path, remedy: str) -> UserError:
    return UserError(f"{path} is a folder and should be a file: {remedy}")
