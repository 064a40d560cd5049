"""Every run in MLflow: its configuration, the code's commit, its inputs' DVC hashes, its seed, metrics and plots."""

import logging
import os
import socket
import subprocess
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import mlflow
import yaml
from matplotlib.figure import Figure
from mlflow.entities import Metric

from swarmtwin.tracking.store import store_errors, use_experiment, use_store

logger = logging.getLogger(__name__)

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

    def warnings(self, texts: Sequence[str]) -> None:
        """Keep what is unusual of the recording that was used, if anything is, as the tag `recording.warnings`."""
        if texts:
            self.tag("recording.warnings", "\n".join(texts))

    @store_errors()
    def figure(self, figure: Figure, name: str) -> None:
        """Keep a plot as `figures/<name>.png`."""
        mlflow.log_figure(figure, f"figures/{name}.png")

    @store_errors()
    def folder(self, folder: Path, name: str) -> str:
        """Keep a copy of a folder under `name`; return its URI."""
        mlflow.log_artifacts(str(folder), name)
        return mlflow.get_artifact_uri(name)


@contextmanager
def tracked_run(
    experiment: Experiment, name: str, config: Mapping[str, Any], inputs: Sequence[Path] = (), seed: int | None = None
) -> Iterator[TrackedRun]:
    """Open an MLflow run, under the sweep or study that is going on if there is one; close it with how it ended.

    Raises:
        UserError: the tracking store cannot be used.
    """
    tags = _tags(inputs, seed)
    output = str(config["output"]) if config.get("output") else None
    with store_errors():
        use_experiment(experiment)
        _close_orphans(experiment, output)
        run = mlflow.start_run(run_name=name, tags=tags, parent_run_id=os.environ.get(PARENT_RUN))
    try:
        with store_errors():
            longest = 500  # characters that MLflow keeps of a parameter's value
            mlflow.log_params({key: value[:longest] for key, value in _flat(config)})
            mlflow.log_text(yaml.safe_dump(dict(config), sort_keys=False), "config.yaml")
        yield TrackedRun(run.info.run_id)
    except BaseException as error:
        mlflow.end_run("KILLED" if isinstance(error, KeyboardInterrupt) else "FAILED")
        raise
    mlflow.end_run()


def _close_orphans(experiment: Experiment, output: str | None) -> None:
    """Close as killed the runs for this output whose processes, on this machine, are no more."""
    condition = _output_is(output) if output else None
    if condition is None:
        return
    found = mlflow.search_runs(
        experiment_names=[experiment],
        filter_string=f"{condition} and attributes.status = 'RUNNING'",
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


def open_parent(experiment: Experiment, name: str, kind: Literal["sweep", "study"]) -> str:
    """Open a run that groups those started until it is closed, also in other processes; return its id."""
    tags = _tags((), None)
    with store_errors():
        use_experiment(experiment)
        client = mlflow.MlflowClient()
        found = client.get_experiment_by_name(experiment)
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


def _tags(inputs: Sequence[Path], seed: int | None) -> dict[str, str]:
    tags = {"process": f"{socket.gethostname()} {os.getpid()}"}
    if seed is not None:
        tags["seed"] = str(seed)
    if commit := _git("rev-parse", "HEAD"):
        tags["mlflow.source.git.commit"] = commit
        tags["git.uncommitted_changes"] = str(bool(_git("status", "--porcelain", "--untracked-files=no"))).lower()
    for path in inputs:
        if digest := dvc_hash(path):
            tags[f"dvc.{path}"] = digest
    return tags


def _git(*arguments: str) -> str:
    try:
        answer = subprocess.run(["git", *arguments], capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return ""
    return answer.stdout.strip() if answer.returncode == 0 else ""


def dvc_hash(path: Path) -> str | None:
    """Return the DVC hash of the nearest tracked output that is `path` or holds it; None where DVC knows none."""
    path = path.resolve()
    for folder in [path, *path.parents]:
        if not (folder / ".dvc").is_dir():
            continue
        tracked = dict(_tracked_outputs(folder))
        for candidate in [path, *path.parents]:
            if candidate in tracked:
                return tracked[candidate]
        return None
    return None


def _tracked_outputs(repository: Path) -> Iterator[tuple[Path, str]]:
    for file in (*repository.glob("*.dvc"), repository / "dvc.lock"):
        if not file.is_file():
            continue
        try:
            content = yaml.safe_load(file.read_text()) or {}
        except yaml.YAMLError:
            logger.warning("%s is not valid YAML: the hashes in it are not recorded", file)
            continue
        for entry in (content, *content.get("stages", {}).values()):
            yield from _outputs(entry, repository)


def _outputs(entry: Mapping[str, Any], repository: Path) -> Iterator[tuple[Path, str]]:
    for output in entry.get("outs", []):
        if "md5" in output:
            yield (repository / output["path"]).resolve(), output["md5"]
