"""Registered models: versions of `<robot>-dynamics` and `<robot>-policy`, and who is `challenger` and who `champion`.

Every model is registered as a version; `challenger` is the one that is measurably better than the challenger before,
or cannot be compared with it, `champion` the one that passed the gate. Policies of different tasks have champions,
challengers and histories of their own: the plain aliases belong to the task that had one first, those of any other task
are called after it, `champion-obstacle`. So `models:/mgr-policy@champion` stays the name of one task's policy, whatever
else is learned later; whoever says which task is meant is given that task's champion, and never the policy of another.
"""

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast, get_args

import mlflow
from mlflow.exceptions import MlflowException
from mlflow.utils.mlflow_tags import MLFLOW_MODEL_VERSIONS

from swarmtwin.errors import UserError
from swarmtwin.files import folder_digest
from swarmtwin.tracking.datasets import files_digest
from swarmtwin.tracking.model_reference import ModelReference
from swarmtwin.tracking.models import model_data
from swarmtwin.tracking.store import store_errors, store_lock, use_store

Role = Literal["challenger", "champion"]
FORMER_CHAMPIONS = "former_champions"
FILES_DIGEST = "files.digest"


@dataclass(frozen=True)
class Version:
    """One version of a registered model.

    Attributes:
        name: of the registered model.
        number: of the version.
        aliases: that it carries.
        source: where its files lie.
        tags: what is kept beside it.
        run_id: the MLflow run that made it.
    """

    name: str
    number: int
    aliases: tuple[str, ...]
    source: str
    tags: Mapping[str, str]
    run_id: str | None = None

    @property
    def task(self) -> str | None:
        """The task of a policy; None of a dynamics model."""
        return self.tags.get("task")

    def __str__(self) -> str:
        return f"{self.name} version {self.number}"

    def folder(self) -> Path:
        """Return a local folder with the model's files, fetched where the store is elsewhere.

        Raises:
            UserError: the files are gone or changed since they were registered, or the store cannot be used.
        """
        with store_errors():
            use_store()
            try:
                kept = Path(mlflow.artifacts.download_artifacts(self.source))
            except (MlflowException, OSError) as error:
                if Path(self.source.removeprefix("file://")).is_dir() or "://" in self.source.removeprefix("file://"):
                    raise
                raise UserError(
                    f"the files of {self} are not where the registry says, {self.source}: bring them back, or register "
                    "the model's folder anew"
                ) from error
        if stated := self.tags.get(FILES_DIGEST):
            folder, found = model_data(kept), _files_digest(kept)
        else:  # a version of before: the model's folder itself
            folder, stated, found = kept, self.tags.get("digest"), folder_digest(kept)
        if stated and stated != found:
            raise UserError(
                f"the files of {self} in {kept} are not those that were registered: their digest is {found}, the "
                f"registry says {stated}; bring the old ones back, or register the model's folder anew"
            )
        return folder


def register(name: str, folder: Path, source: str, run_id: str | None, tags: Mapping[str, str]) -> Version:
    """Register the model in `folder`, kept at the URI `source`, as a new version of `name`.

    Args:
        name: the registered model, `<robot>-dynamics` or `<robot>-policy`.
        folder: the model as its command left it; its digest identifies the version.
        source: what MLflow keeps of it: an MLflow model, `models:/ID`, or the URI of a copy of the folder.
        run_id: the run that made it.
        tags: what people should read beside the version's number in the UI: the kind of model, its errors.
    """
    with store_errors():
        use_store()
        client = mlflow.MlflowClient()
        model_id = None
        if source.startswith("models:/"):
            model_id = source.removeprefix("models:/")
            source = client.get_logged_model(model_id).artifact_location
        kept = Path(mlflow.artifacts.download_artifacts(source))
        tags = {**tags, "digest": folder_digest(folder), FILES_DIGEST: _files_digest(kept)}
        with store_lock():
            if name not in _names(client):
                client.create_registered_model(name)
        number = client.create_model_version(name, source, run_id, tags=tags, model_id=model_id).version
        if model_id:
            client.set_logged_model_tags(
                model_id, {MLFLOW_MODEL_VERSIONS: json.dumps([{"name": name, "version": number}])}
            )
    return Version(name, int(number), (), source, tags, run_id)


def versions(name: str) -> list[Version]:
    """Return all versions of a registered model, newest first; empty where the name is unknown."""
    with store_errors():
        use_store()
        client = mlflow.MlflowClient()
        if name not in _names(client):
            return []
        bearers = client.get_registered_model(name).aliases
        found = client.search_model_versions(f"name = '{name}'", max_results=10_000)
    entries = []
    for entry in found:
        aliases = tuple(alias for alias, number in bearers.items() if str(number) == str(entry.version))
        entries.append(Version(name, int(entry.version), aliases, entry.source or "", entry.tags, entry.run_id))
    return sorted(entries, key=lambda version: version.number, reverse=True)


def holders(name: str, role: Role) -> list[Version]:
    """Return the challenger or the champion of each task, the newest first; of dynamics models there is one at most."""
    return _holders(versions(name), role)


def holder(name: str, role: Role, task: str | None = None) -> Version | None:
    """Return the challenger or the champion, of a task where it is a policy's; None where there is none yet."""
    return _holder(versions(name), role, task)


def _holders(known: list[Version], role: Role) -> list[Version]:
    return [version for version in known if {role, _own_alias(role, version.task)} & {*version.aliases}]


def _holder(known: list[Version], role: Role, task: str | None) -> Version | None:
    return next((version for version in _holders(known, role) if version.task == task), None)


def _own_alias(role: Role, task: str | None) -> str:
    """Return the alias of a role that is called after its task."""
    return f"{role}-{re.sub('[^A-Za-z0-9_-]', '_', task)}" if task else role


def _alias(known: list[Version], role: Role, task: str | None) -> str:
    """Return the alias that the challenger or the champion of a task carries."""
    bearer = next((version for version in known if role in version.aliases), None)
    return role if bearer is None or bearer.task == task else _own_alias(role, task)


def version_of(name: str, folder: Path) -> Version | None:
    """Return the newest version of `name` that holds the same content as `folder`, None where there is none."""
    digest = folder_digest(folder)
    return next((version for version in versions(name) if version.tags.get("digest") == digest), None)


def find_version(reference: str, task: str | None = None) -> Version:
    """Return the version that `models:/NAME@ALIAS` or `models:/NAME/VERSION` names.

    Args:
        reference: to a registered model; `champion` and `challenger` are those of the task, if one is given.
        task: what it must be for; None: whatever it is for.

    Raises:
        UserError: the reference is malformed, there is no such name, alias or version, or it is for another task.
    """
    wanted = ModelReference.parse(reference)
    known = versions(wanted.name)
    if not known:
        with store_errors():
            names = ", ".join(_names(mlflow.MlflowClient())) or "none yet: train one first"
        raise UserError(f"no registered model {wanted.name!r}; registered: {names}")
    if task is not None and wanted.alias in get_args(Role) and (own := _holder(known, cast(Role, wanted.alias), task)):
        return own
    for version in known:
        if wanted.alias in version.aliases or version.number == wanted.version:
            check_task(version, task)
            return version
    raise UserError(f"{reference}: no such version; there are {_describe(known)}")


def check_task(version: Version, task: str | None) -> None:
    """Check that a policy is for the task that is meant; None: for whichever.

    Raises:
        UserError: it is for another one; the message names the champion of the task that is meant, if there is one.
    """
    if task is None or version.task == task:
        return
    known = versions(version.name)
    remedy = f"write models:/{version.name}@{_alias(known, 'champion', task)}"
    if _holder(known, "champion", task) is None:
        remedy = f"no policy for {task!r} is champion yet"
    raise UserError(f"{version} is for task {version.task!r}, not for {task!r}: {remedy}")


def challenge(version: Version, compare: Callable[[Version], tuple[bool, str]]) -> str:
    """Make a version the challenger, unless it is not measurably better than the one there is; return what was done.

    Args:
        version: the new one.
        compare: says of the challenger whether the new version takes its place, and why.
    """
    while True:
        incumbent = holder(version.name, "challenger", version.task)
        better, reason = compare(incumbent) if incumbent else (True, "")
        if incumbent and not better:
            return f"registered as {version}; version {incumbent.number} stays challenger: {reason}"
        with store_errors(), store_lock():
            known = versions(version.name)
            now, alias = _holder(known, "challenger", version.task), _alias(known, "challenger", version.task)
            if (now and now.number) != (incumbent and incumbent.number):
                continue
            mlflow.MlflowClient().set_registered_model_alias(version.name, alias, str(version.number))
        if incumbent is None:
            return f"registered as {version}, its {alias}"
        return f"registered as {version}, its {alias} in place of version {incumbent.number}: {reason}"


def promote(version: Version, reason: str, against: Version | None, page: str = "") -> None:
    """Make a version the champion, remembering the former one.

    Args:
        version: what becomes champion.
        reason: why, in words.
        against: the champion that it was compared with; None where there was none.
        page: what the version's page says of it, in Markdown, above what somebody wrote there before.

    Raises:
        UserError: another version became champion meanwhile.
    """
    use_store()
    with store_errors(), store_lock():
        known = versions(version.name)
        now, alias = _holder(known, "champion", version.task), _alias(known, "champion", version.task)
        if (now and now.number) != (against and against.number):
            raise UserError(f"{now} became champion meanwhile: promote {version} again, to be compared with that")
        client = mlflow.MlflowClient()
        if now:
            _remember(client, version.name, alias, [*_former_champions(client, now, alias), str(now.number)])
        client.set_model_version_tag(version.name, str(version.number), "promoted_because", reason)
        _describe_version(client, version, page)
        client.set_registered_model_alias(version.name, alias, str(version.number))


def roll_back(name: str, task: str | None = None) -> tuple[int, int]:
    """Give the champion's alias back to the champion of the task before; return the numbers (demoted, restored).

    Raises:
        UserError: there is no champion, or none before it.
    """
    use_store()  # which may have to make it, and that takes the lock as well
    with store_errors(), store_lock():
        known = versions(name)
        demoted, alias = _holder(known, "champion", task), _alias(known, "champion", task)
        if demoted is None:
            raise UserError(f"{name} has no champion to roll back from; there are {_describe(known)}")
        client = mlflow.MlflowClient()
        former = _former_champions(client, demoted, alias)
        if not former:
            raise UserError(f"{demoted} is the first champion: there is none to roll back to")
        client.set_registered_model_alias(name, alias, former[-1])
        _remember(client, name, alias, former[:-1])
    return demoted.number, int(former[-1])


def _files_digest(kept: Path) -> str:
    """Return the digest of all that MLflow keeps, but for the note that it adds itself whenever it loads a version."""
    return files_digest(kept, leave_out=["registered_model_meta"])


def _names(client: mlflow.MlflowClient) -> list[str]:
    return sorted(model.name for model in client.search_registered_models(max_results=1000))


def _history_tag(alias: str) -> str:
    """Return the tag of a registered model that lists, oldest first, those that bore a champion's alias before."""
    return FORMER_CHAMPIONS + alias.removeprefix("champion")


def _former_champions(client: mlflow.MlflowClient, champion: Version, alias: str) -> list[str]:
    """Return the champions before this one, which a kill in the middle of a change may have left as the last."""
    numbers = client.get_registered_model(champion.name).tags.get(_history_tag(alias), "").split(",")
    while numbers and numbers[-1] in ("", str(champion.number)):
        numbers.pop()
    return numbers


def _remember(client: mlflow.MlflowClient, name: str, alias: str, numbers: list[str]) -> None:
    client.set_registered_model_tag(name, _history_tag(alias), ",".join(numbers))


def _describe_version(client: mlflow.MlflowClient, version: Version, page: str, longest: int = 5000) -> None:
    """Put a text on top of a version's page, unless it stands there; a database of MLflow's takes 5000 characters.

    What stood there stays whole: of the text as many paragraphs are kept as there is room for.
    """
    before, seam = client.get_model_version(version.name, str(version.number)).description or "", "\n\n---\n\n"
    room = longest - len(before) - len(seam)
    paragraphs = page.split("\n\n")
    while paragraphs and len("\n\n".join(paragraphs)) > room:
        paragraphs.pop()
    if paragraphs and page not in before:
        text = seam.join(part for part in ("\n\n".join(paragraphs), before) if part)
        client.update_model_version(version.name, str(version.number), text)


def _describe(known: list[Version]) -> str:
    return ", ".join(f"{v.number}{''.join(f' (@{alias})' for alias in v.aliases)}" for v in known) or "none"
