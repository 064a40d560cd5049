"""What a run is given, as MLflow shows it beside the run: each input with a digest of its own, and DVC's hash of it."""

import hashlib
import json
import logging
import os
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mlflow
import yaml
from mlflow.entities import Dataset as DatasetEntity
from mlflow.entities import DatasetInput, InputTag
from mlflow.exceptions import MlflowException
from mlflow.utils.mlflow_tags import MLFLOW_DATASET_CONTEXT

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Dataset:
    """A folder that a run is given, or a part of what is in it.

    Attributes:
        folder: where it lies.
        context: what it is for: training, validation, test, reference, measured, simulation, policy.
        digest: identifies the content; MLflow keeps 36 characters of it.
        profile: how much it is, such as rows and runs.
        columns: those of its numbers, with units in their names.
    """

    folder: Path
    context: str
    digest: str
    profile: Mapping[str, int] = field(default_factory=dict)
    columns: Sequence[str] = ()

    @classmethod
    def of_files(cls, folder: Path, context: str) -> "Dataset":
        """Describe all files in a folder."""
        return cls(folder, context, files_digest(folder))


def files_digest(folder: Path, leave_out: Collection[str] = ()) -> str:
    """Return a digest of all files in a folder and those within: their names and their content.

    Args:
        folder: the folder.
        leave_out: names of files in the folder itself that do not count.
    """
    content = hashlib.sha256()
    files = {file.relative_to(folder).as_posix(): file for file in folder.rglob("*") if file.is_file()}
    for name in sorted(files.keys() - set(leave_out)):
        content.update(name.encode() + b"\0" + hashlib.sha256(files[name].read_bytes()).digest())
    return content.hexdigest()[:16]


def log_datasets(run_id: str, datasets: Iterable[Dataset], hashes: Mapping[Path, str]) -> None:
    """Keep the inputs of a run, with DVC's hashes of their folders where there are any."""
    inputs = []
    for one in datasets:
        schema = [{"name": name, "type": "double", "required": True} for name in one.columns]
        entity = DatasetEntity(
            name=one.folder.resolve().name,
            digest=one.digest[:36],
            source_type="local",
            source=json.dumps({"uri": str(one.folder)}),
            schema=json.dumps({"mlflow_colspec": schema}) if schema else None,
            profile=json.dumps(one.profile) if one.profile else None,
        )
        tags = [InputTag(MLFLOW_DATASET_CONTEXT, one.context)]
        if one.folder in hashes:
            tags.append(InputTag("dvc", hashes[one.folder]))
        inputs.append(DatasetInput(entity, tags))
    if inputs:
        _add(run_id, inputs)


def _add(run_id: str, inputs: list[DatasetInput], tries: int = 5) -> None:
    """Add inputs to a run; again where another run added the same ones since MLflow had looked: then it finds them."""
    for left in reversed(range(tries)):
        try:
            mlflow.MlflowClient().log_inputs(run_id, inputs)
            return
        except MlflowException as error:
            if not left or "unique constraint" not in str(error).lower():
                raise


def dvc_hashes(paths: Iterable[Path]) -> dict[Path, str]:
    """Return DVC's hashes of those paths that it tracks: outputs, and what lies in an output whose list is at hand."""
    tracked: dict[Path, dict[Path, str]] = {}
    hashes = {}
    for path in dict.fromkeys(paths):
        places = [path.resolve(), *path.resolve().parents]
        repository = next((place for place in places if (place / ".dvc").is_dir()), None)
        if repository is None:
            continue
        if repository not in tracked:
            tracked[repository] = dict(_tracked_outputs(repository))
        holder = next((place for place in places if place in tracked[repository]), None)
        if holder and (found := _hash_within(repository, tracked[repository][holder], places[0].relative_to(holder))):
            hashes[path] = found
    return hashes


def _hash_within(repository: Path, output: str, inside: Path) -> str | None:
    """Return the hash of a file or folder inside an output; None where DVC's list of the output's files is not here."""
    if inside == Path():
        return output
    for root in (repository, Path(os.environ.get("DVC_ROOT") or repository)):
        listing = root / ".dvc" / "cache" / "files" / "md5" / output[:2] / output[2:]
        if output.endswith(".dir") and listing.is_file():
            return _hash_in_list(json.loads(listing.read_text()), inside.as_posix())
    return None


def _hash_in_list(files: list[dict[str, str]], name: str) -> str | None:
    """Return the hash of a file in DVC's list, or of a folder as DVC computes it: that of the list of its files."""
    hashes = {entry["relpath"]: entry["md5"] for entry in files}
    if name in hashes:
        return hashes[name]
    start = f"{name}/"
    held = {file.removeprefix(start): found for file, found in hashes.items() if file.startswith(start)}
    text = json.dumps([{"md5": held[file], "relpath": file} for file in sorted(held)])
    return f"{hashlib.md5(text.encode()).hexdigest()}.dir" if held else None


def _tracked_outputs(repository: Path) -> Iterator[tuple[Path, str]]:
    safe_loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # a lock has thousands of lines
    for file in (*repository.glob("*.dvc"), repository / "dvc.lock"):
        if not file.is_file():
            continue
        try:
            content = yaml.load(file.read_text(), Loader=safe_loader) or {}
            entries = (content, *content.get("stages", {}).values())
            found = [output for entry in entries for output in _outputs(entry, repository)]
        except (yaml.YAMLError, UnicodeDecodeError, AttributeError, KeyError, TypeError):
            logger.warning("%s is not as DVC writes it: the hashes in it are not recorded", file)
            continue
        yield from found


def _outputs(entry: Mapping[str, Any], repository: Path) -> Iterator[tuple[Path, str]]:
    for output in entry.get("outs", []):
        if "md5" in output:
            yield (repository / output["path"]).resolve(), output["md5"]
