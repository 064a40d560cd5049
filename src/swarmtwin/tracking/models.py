"""What is learned, as MLflow models: an `MLmodel` file with signature and input example around a model's folder."""

import importlib
import shutil
from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import mlflow
from mlflow.models import ModelSignature
from mlflow.types import ColSpec, DataType, Schema, TensorSpec

from swarmtwin import __version__
from swarmtwin.files import CHECKPOINTS, folder_digest

ModelKind = Literal["dynamics", "policy"]
"""What is registered, as `<robot>-<kind>`."""

LOADERS: dict[ModelKind, str] = {"dynamics": "swarmtwin.simulation.pyfunc", "policy": "swarmtwin.policies.pyfunc"}
"""The modules that MLflow loads them by; by name, since this room imports none that learns."""


def log_model(folder: Path, kind: ModelKind) -> str:
    """Keep a model as an output of the run that is open; return its URI, `models:/ID`.

    Its signature is what it answers to its own example. Nothing in it is pickled, and a loader compares the model's
    files with the digest that stands in the `MLmodel` file.

    Args:
        folder: the model as its command left it; a copy is kept, without the checkpoints in it.
        kind: what it is.

    Raises:
        UserError: it cannot be loaded.
    """
    served = importlib.import_module(LOADERS[kind]).serve(folder)
    answer = served.predict(served.example)
    looked_at = [*_columns(served.required), *_columns(served.optional, required=False)]
    with TemporaryDirectory() as aside:
        data = Path(aside) / "model"  # MLflow calls its copy so, not as its user calls the folder
        shutil.copytree(folder, data, ignore=shutil.ignore_patterns(CHECKPOINTS))
        kept = mlflow.pyfunc.log_model(
            name="model",
            loader_module=LOADERS[kind],
            data_path=str(data),
            signature=ModelSignature(Schema(looked_at), Schema(_columns(answer.columns))),
            input_example=served.example,
            pip_requirements=[f"swarmtwin=={__version__}"],
            metadata={"digest": folder_digest(folder)},
        )
    return f"models:/{kept.model_id}"


def model_data(kept: Path) -> Path:
    """Return the model's own folder in what MLflow keeps, an MLflow model or a copy of that folder."""
    return kept / "data" / "model" if (kept / "MLmodel").is_file() else kept


def _columns(names: Iterable[str], required: bool = True) -> list[ColSpec | TensorSpec]:
    return [ColSpec(DataType.double, name, required=required) for name in names]
