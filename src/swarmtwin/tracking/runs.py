"""Every run in MLflow: its configuration, the code's commit, its inputs, its seed, metrics and plots."""

import os
import socket
import subprocess
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import mlflow
import yaml
from matplotlib.figure import Figure
from mlflow.entities import Metric

from swarmtwin.errors import UserError
from swarmtwin.files import CHECKPOINTS
from swarmtwin.tracking.datasets import Dataset, dvc_hashes, log_datasets
from swarmtwin.tracking.models import ModelKind, log_model
from swarmtwin.tracking.store import experiment_name, store_errors, use_experiment, use_store

Experiment = Literal["dynamics", "generator", "diagnosis", "policy", "transfer", "deployment"]
PARENT_RUN = "SWARMTWIN_PARENT_RUN"


class TrackedRun:
    """The MLflow run that is open: what a command hands over to be kept and compared."""

    def __init__(self, run_id: str) -> None:
        self.run_id = run_id

    def metrics(self, values: Mapping[str, float], step: int = 0) -> None:
        """Keep figures, whose names end in their units."""
        self.history([(step, values)])

    @store_errors()
    def history(self, rows: Iterable[tuple[int, Mapping[str, float]]]) -> None:
        """Keep figures that change over steps: all rows in few calls, of at most the 1000 figures that MLflow takes."""
        now = int(time.time() * 1000)
        batch = [Metric(name, float(value), now, step) for step, values in rows for name, value in values.items()]
        client = mlflow.MlflowClient()
        for start in range(0, len(batch), 1000):
            client.log_batch(self.run_id, metrics=batch[start : start + 1000])

    @store_errors()
    def tag(self, name: str, value: str) -> None:
        """Mark the run."""
        mlflow.MlflowClient().set_tag(self.run_id, name, value)

    def note(self, text: str) -> None:
        """Say in a sentence what the run found: MLflow shows it as the run's description."""
        self.tag("mlflow.note.content", text)

    def warnings(self, texts: Sequence[str]) -> None:
        """Keep what is unusual of the recording that was used, if anything is, as the tag `recording.warnings`."""
        if texts:
            self.tag("recording.warnings", "\n".join(texts))

    @store_errors()
    def figure(self, figure: Figure, name: str) -> None:
        """Keep a plot as `figures/<name>.png`."""
        mlflow.log_figure(figure, f"figures/{name}.png")

    @store_errors()
    def picture(self, file: Path) -> None:
        """Keep a picture or a film that was drawn, as `figures/<its name>`."""
        mlflow.log_artifact(str(file), "figures")

    @store_errors()
    def model(self, folder: Path, kind: ModelKind) -> str:
        """Keep a model as an MLflow model; return its URI, `models:/ID`.

        Raises:
            UserError: it cannot be loaded.
        """
        return log_model(folder, kind)

    @store_errors()
    def folder(self, folder: Path, name: str) -> str:
        """Keep a copy of a folder under `name`, without the checkpoints in it; return its URI."""
        for path in folder.iterdir():
            if path.name != CHECKPOINTS:
                mlflow.log_artifact(str(path), name)
        return mlflow.get_artifact_uri(name)


@contextmanager
def tracked_run(
    experiment: Experiment,
    name: str,
    config: Mapping[str, Any],
    inputs: Sequence[Dataset] = (),
    seed: int | None = None,
    system_metrics: bool = False,
) -> Iterator[TrackedRun]:
    """Open an MLflow run, under the sweep or study that is going on if there is one; close it with how it ended.

    Args:
        experiment: that it belongs to, which MLflow knows by `experiment_name`.
        name: of the run.
        config: its options.
        inputs: what it is given.
        seed: of everything random.
        system_metrics: whether it shows how busy processor, memory, disk and GPU are.

    Raises:
        UserError: the tracking store cannot be used, or what measures the machine is not installed.
    """
    if system_metrics and find_spec("psutil") is None:
        raise UserError(
            "system_metrics measures by psutil, which is not installed here: pip install 'swarmtwin[train]'"
        )
    hashes = dvc_hashes(dataset.folder for dataset in inputs)
    tags = _tags(hashes, seed)
    with store_errors():
        use_experiment(experiment_name(experiment))
        close_orphans(experiment)
        run = mlflow.start_run(
            run_name=name,
            tags=tags,
            parent_run_id=os.environ.get(PARENT_RUN),
            log_system_metrics=system_metrics or None,
        )
    try:
        with store_errors():
            longest = 500  # characters that MLflow keeps of a parameter's value
            mlflow.log_params({key: value[:longest] for key, value in _flat(config)})
            mlflow.log_text(yaml.safe_dump(dict(config), sort_keys=False), "config.yaml")
            log_datasets(run.info.run_id, inputs, hashes)
        yield TrackedRun(run.info.run_id)
    except BaseException as error:
        with suppress(Exception):  # the store may be what failed
            mlflow.end_run("KILLED" if isinstance(error, KeyboardInterrupt) else "FAILED")
        raise
    with store_errors():
        mlflow.end_run()


def close_orphans(experiment: Experiment) -> None:
    """Close as killed the experiment's runs whose processes, on this machine, are no more."""
    with store_errors():
        use_store()
        found = mlflow.search_runs(
            experiment_names=[experiment_name(experiment)],
            filter_string="attributes.status = 'RUNNING'",
            output_format="list",
        )
        for run in found:
            host, _, process = run.data.tags.get("process", "").partition(" ")
            if host == socket.gethostname() and process.isdigit() and not _is_alive(int(process)):
                mlflow.MlflowClient().set_terminated(run.info.run_id, "KILLED")


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # another user's
        return True
    return True


def _output_is(output: Path | str) -> str | None:
    """Return the condition of MLflow's that finds runs by their output; None for a name that it cannot say."""
    quote = '"' if "'" in str(output) else "'"
    return None if quote in str(output) else f"params.output = {quote}{output}{quote}"


@store_errors()
def keep_with_run(output: Path, pictures: Path) -> None:
    """Keep a folder of pictures with the latest run that finished and left `output`, if there is one that can be found.

    Raises:
        UserError: the tracking store cannot be used.
    """
    condition = _output_is(output)
    if condition is None:
        return
    with store_errors():
        use_store()
        found = mlflow.search_runs(
            search_all_experiments=True,
            filter_string=f"{condition} and attributes.status = 'FINISHED'",
            order_by=["attributes.start_time DESC"],
            max_results=1,
            output_format="list",
        )
        for run in found:
            mlflow.MlflowClient().log_artifacts(run.info.run_id, str(pictures), "pictures")


@store_errors()
def keep_folder(run_id: str, folder: Path, name: str) -> None:
    """Keep a copy of a folder under `name` with a run that need not be the one that is open.

    Raises:
        UserError: the tracking store cannot be used.
    """
    use_store()
    mlflow.MlflowClient().log_artifacts(run_id, str(folder), name)


def open_parent(experiment: Experiment, name: str, kind: Literal["sweep", "study"]) -> str:
    """Open a run that groups those started until it is closed, also in other processes; return its id."""
    tags = _tags({}, None)
    with store_errors():
        use_experiment(experiment_name(experiment))
        close_orphans(experiment)
        client = mlflow.MlflowClient()
        found = client.get_experiment_by_name(experiment_name(experiment))
        assert found is not None
        run = client.create_run(found.experiment_id, run_name=name, tags={"kind": kind, **tags})
    os.environ[PARENT_RUN] = run.info.run_id
    return run.info.run_id


def close_parent(run_id: str, status: Literal["FINISHED", "FAILED"]) -> None:
    """Close the run that groups others."""
    os.environ.pop(PARENT_RUN, None)
    with store_errors():
        use_store()
        mlflow.MlflowClient().set_terminated(run_id, status)


@contextmanager
def parent_run(experiment: Experiment, name: str, kind: Literal["sweep", "study"]) -> Iterator[str]:
    """Group the runs that start within the block, also in other processes, under one; give its id."""
    run_id = open_parent(experiment, name, kind)
    try:
        yield run_id
    except BaseException:
        close_parent(run_id, "FAILED")
        raise
    close_parent(run_id, "FINISHED")


def _flat(config: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    for key, value in config.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", str(value)


def _tags(hashes: Mapping[Path, str], seed: int | None) -> dict[str, str]:
    tags = {"process": f"{socket.gethostname()} {os.getpid()}"}
    if seed is not None:
        tags["seed"] = str(seed)
    if commit := _git("rev-parse", "HEAD"):
        tags["mlflow.source.git.commit"] = commit
        locks = (":(top,exclude)dvc.lock", ":(top,exclude)*.dvc")  # what runs leave, not what they are run with
        changes = _git("status", "--porcelain", "--untracked-files=no", "--", ":(top)", *locks)
        tags["git.uncommitted_changes"] = str(bool(changes)).lower()
    return tags | {f"dvc.{folder}": found for folder, found in hashes.items()}


def _git(*arguments: str) -> str:
    try:
        answer = subprocess.run(["git", *arguments], capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return ""
    return answer.stdout.strip() if answer.returncode == 0 else ""
