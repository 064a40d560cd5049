"""What was learned as MLflow loads and serves it, by its `pyfunc` flavour: a table goes in, a table comes out.

`mlflow.pyfunc` imports the loader module that the `MLmodel` file of a model names and calls its `_load_pyfunc` with the
folder that the file is about. Ours are `pyfunc.py` of each room: they read safetensors and YAML as everywhere, unpickle
nothing, and compare the folder with the digest in the `MLmodel` file before.
"""

from pathlib import Path
from typing import Any, Protocol

import pandas as pd
import yaml

from swarmtwin.errors import UserError
from swarmtwin.files import folder_digest
from swarmtwin.plain_yaml import read_yaml


class ServedModel(Protocol):
    """A model that answers tables of numbers, a row each.

    Attributes:
        required: the columns that a table must have.
        optional: those that may be left out, or be empty in some rows.
        example: a table to try it with.
    """

    required: tuple[str, ...]
    optional: tuple[str, ...]
    example: pd.DataFrame

    def predict(self, table: pd.DataFrame) -> pd.DataFrame:
        """Return the answers, a row each, in the order of the table's rows."""


def unchanged_folder(path: str | Path) -> Path:
    """Return the model's folder that MLflow names, if it is as it was when the `MLmodel` file two levels up was made.

    Raises:
        UserError: it is not, or the file does not say.
    """
    folder = Path(path).absolute()
    file = folder.parents[1] / "MLmodel"
    try:
        content: Any = read_yaml(file)
        stated = content["metadata"]["digest"]
    except (OSError, yaml.YAMLError, UnicodeDecodeError, KeyError, TypeError):
        raise UserError(f"{file} does not state the digest of {folder}: register the model's folder anew") from None
    if stated != (found := folder_digest(folder)):
        raise UserError(
            f"{folder} is not what was registered: its digest is {found}, {file} says {stated}; bring the old files "
            "back, or register the model's folder anew"
        )
    return folder
