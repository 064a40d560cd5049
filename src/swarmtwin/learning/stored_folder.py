"""What was learned, as a folder: a description to read, and weights in which nothing executable can hide."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import torch
import yaml
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from swarmtwin.errors import UserError
from swarmtwin.files import check_holds, check_regular, whole_file, write_text
from swarmtwin.plain_yaml import read_yaml
from swarmtwin.robot import StrictModel

DescriptionT = TypeVar("DescriptionT", bound=StrictModel)
Built = TypeVar("Built")


@dataclass(frozen=True)
class StoredFolder(Generic[DescriptionT]):
    """One kind of such folders: a YAML file, format 1, beside `weights.safetensors`.

    Attributes:
        description_file: name of the YAML file.
        description_class: types its content.
        holds: what such a folder holds, as messages call it: "model".
        made_by: the command that makes such folders.
        remedy: what to do about a damaged one: "train the model anew".
        allow_unicode: whether letters beyond ASCII stand in the YAML file as they are, rather than escaped.
        weights_file: name of the other file.
    """

    description_file: str
    description_class: type[DescriptionT]
    holds: str
    made_by: str
    remedy: str
    allow_unicode: bool = False
    weights_file: str = "weights.safetensors"

    def save(self, folder: Path, description: DescriptionT, weights: Mapping[str, Tensor]) -> None:
        """Write both files into an existing `folder`, each whole or not at all."""
        plain = {name: tensor.detach().cpu().contiguous() for name, tensor in weights.items()}
        with whole_file(folder / self.weights_file) as aside:
            save_file(plain, aside)
        content = description.model_dump(mode="json")
        text = yaml.safe_dump(content, sort_keys=False, allow_unicode=self.allow_unicode)
        write_text(folder / self.description_file, text)

    def read(self, folder: Path) -> DescriptionT:
        """Read the description in `folder`, without executing anything in it.

        Raises:
            UserError: it is missing, damaged, or of another format.
        """
        path = Path(folder) / self.description_file
        return self.description_class.parse(self._content(path), str(path))

    def load_into(self, folder: Path, build: Callable[[dict[str, Tensor]], Built]) -> Built:
        """Return what `build` makes of the weights in `folder`; no random number is drawn.

        Args:
            folder: where both files are.
            build: builds what the description asks for and gives it the weights, by name; it may raise what torch and
                Python raise where names, shapes or sizes do not fit.

        Raises:
            UserError: the weights are missing, damaged or not finite, or do not belong to the description.
        """
        weights = self._weights(Path(folder) / self.weights_file)
        try:
            with torch.random.fork_rng(devices=[]):
                return build(weights)
        except (RuntimeError, KeyError, TypeError, ValueError):
            raise UserError(
                f"{Path(folder) / self.weights_file} does not belong to {self.description_file} beside it: "
                f"{self.remedy}"
            ) from None

    def _content(self, path: Path) -> Any:
        check_holds(path.parent, path.name, self.holds, self.made_by)
        try:
            content = read_yaml(path)
        except IsADirectoryError:
            raise self._folder_in_place_of_file(path) from None
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            raise UserError(f"{path} is damaged: {' '.join(str(error).split())}; {self.remedy}") from None
        if isinstance(content, dict) and content.get("format") != 1:
            found = content.get("format")
            anew = f"{self.remedy.split()[0]} anew"  # "train the model anew" in short
            raise UserError(f"{path}: format {found!r} is not known here: update swarmtwin, or {anew}")
        return content

    def _weights(self, path: Path) -> dict[str, Tensor]:
        if path.is_dir():
            raise self._folder_in_place_of_file(path)
        check_regular(path)
        try:
            weights: dict[str, Tensor] = load_file(path)
        except FileNotFoundError:
            raise UserError(f"{path} is missing: {self.remedy}") from None
        except SafetensorError as error:
            raise UserError(f"{path} is damaged ({error}): {self.remedy}") from None
        if broken := [name for name, tensor in weights.items() if not tensor.isfinite().all()]:
            raise UserError(f"{path}: {broken[0]} is not finite; {self.remedy}")
        return weights

    def _folder_in_place_of_file(self, path: Path) -> UserError:
        return UserError(f"{path} is a folder and should be a file: {self.remedy}")
