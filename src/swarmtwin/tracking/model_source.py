"""The folder of a model, however it is named: MLflow is imported only for models that its registry keeps."""

from pathlib import Path

from swarmtwin.extras import require_extra
from swarmtwin.tracking.model_reference import named_folder


def model_folder(reference: str, task: str | None = None) -> Path:
    """Return the folder of a model given as a folder, `models:/NAME@ALIAS` or `models:/NAME/VERSION`.

    Args:
        reference: to the model.
        task: what a registered policy must be for; None: whatever it is for.

    Raises:
        UserError: there is no such folder, name, alias or version, it is for another task, or it is one of the
            registry's and MLflow is not installed.
    """
    if folder := named_folder(reference):
        return folder
    require_extra("tracking", f"{reference}, which MLflow keeps,")
    from swarmtwin.tracking.registry import find_version

    return find_version(reference, task).folder()
