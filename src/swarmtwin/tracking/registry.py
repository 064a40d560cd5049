"""Registered models: versions of `<robot>-dynamics`, the newest as `challenger`, the promoted one as `champion`."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import mlflow
from mlflow.exceptions import MlflowException

from swarmtwin.errors import UserError
from swarmtwin.files import folder_digest
from swarmtwin.tracking.model_reference import ModelReference, named_folder
from swarmtwin.tracking.store import store_errors, store_lock, use_store

CHALLENGER, CHAMPION = "challenger", "champion"
FORMER_CHAMPIONS = "former_champions"


@dataclass(frozen=True)
class Version:
    """One version of a registered model: its number, the aliases it carries, where its files lie, and its tags."""

    name: str
    number: int
    aliases: tuple[str, ...]
    source: str
    tags: Mapping[str, str]

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
                folder = Path(mlflow.artifacts.download_artifacts(self.source))
            except (MlflowException, OSError) as error:
                if Path(self.source.removeprefix("file://")).is_dir() or "://" in self.source.removeprefix("file://"):
                    raise
                raise UserError(
                    f"the files of {self} are not where the registry says, {self.source}: bring them back, or register "
                    "the model's folder anew"
                ) from error
        stated, found = self.tags.get("digest"), folder_digest(folder)
        if stated and stated != found:
            raise UserError(
                f"the files of {self} in {folder} are not those that were registered: their digest is {found}, the "
                f"registry says {stated}; bring the old ones back, or register the model's folder anew"
            )
        return folder


def register(name: str, folder: Path, source: str, run_id: str | None, tags: Mapping[str, str]) -> Version:
    """Register the model in `folder`, kept at the URI `source`, as a new version of `name` and as its challenger.

    Args:
        name: the registered model, `<robot>-dynamics` or `<robot>-policy`.
        folder: the model as its command left it; its digest identifies the version.
        source: where MLflow keeps the copy.
        run_id: the run that made it.
        tags: what people should read beside the version's number in the UI: the kind of model, its errors.
    """
    tags = {**tags, "digest": folder_digest(folder)}
    with store_errors():
        use_store()
        client = mlflow.MlflowClient()
        with store_lock():
            if name not in _names(client):
                client.create_registered_model(name)
        number = client.create_model_version(name, source, run_id, tags=tags).version
        client.set_registered_model_alias(name, CHALLENGER, number)
    return Version(name, int(number), (CHALLENGER,), source, tags)


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
        entries.append(Version(name, int(entry.version), aliases, entry.source or "", entry.tags))
    return sorted(entries, key=lambda version: version.number, reverse=True)


def champion(name: str) -> Version | None:
    """Return the promoted version, None where there is none yet."""
    return next((version for version in versions(name) if CHAMPION in version.aliases), None)


def version_of(name: str, folder: Path) -> Version | None:
    """Return the newest version of `name` that holds the same content as `folder`, None where there is none."""
    digest = folder_digest(folder)
    return next((version for version in versions(name) if version.tags.get("digest") == digest), None)


def find_version(reference: str) -> Version:
    """Return the version that `models:/NAME@ALIAS` or `models:/NAME/VERSION` names.

    Raises:
        UserError: the reference is malformed, or there is no such name, alias or version.
    """
    wanted = ModelReference.parse(reference)
    known = versions(wanted.name)
    if not known:
        with store_errors():
            names = ", ".join(_names(mlflow.MlflowClient())) or "none yet: train one first"
        raise UserError(f"no registered model {wanted.name!r}; registered: {names}")
    for version in known:
        if wanted.alias in version.aliases or version.number == wanted.version:
            return version
    raise UserError(f"{reference}: no such version; there are {_describe(known)}")


def model_folder(reference: str) -> Path:
    """Return the folder of a model given as a folder, `models:/NAME@ALIAS` or `models:/NAME/VERSION`.

    Raises:
        UserError: there is no such folder, name, alias or version.
    """
    return named_folder(reference) or find_version(reference).folder()


def promote(version: Version, reason: str, against: Version | None) -> None:
    """Make a version the champion, remembering the former one.

    Args:
        version: what becomes champion.
        reason: why, in words.
        against: the champion that it was compared with; None where there was none.

    Raises:
        UserError: another version became champion meanwhile.
    """
    use_store()
    with store_errors(), store_lock():
        former = champion(version.name)
        if (former and former.number) != (against and against.number):
            raise UserError(f"{former} became champion meanwhile: promote {version} again, to be compared with that")
        client = mlflow.MlflowClient()
        if former:
            _remember(client, version.name, [*_former_champions(client, version.name), str(former.number)])
        client.set_model_version_tag(version.name, str(version.number), "promoted_because", reason)
        client.set_registered_model_alias(version.name, CHAMPION, str(version.number))


def roll_back(name: str) -> tuple[int, int]:
    """Give the champion's alias back to the champion before; return the numbers (demoted, restored).

    Raises:
        UserError: there is no champion, or none before it.
    """
    use_store()  # which may have to make it, and that takes the lock as well
    with store_errors(), store_lock():
        demoted = champion(name)
        if demoted is None:
            raise UserError(f"{name} has no champion to roll back from; there are {_describe(versions(name))}")
        client = mlflow.MlflowClient()
        former = _former_champions(client, name)
        if not former:
            raise UserError(f"{demoted} is the first champion: there is none to roll back to")
        client.set_registered_model_alias(name, CHAMPION, former[-1])
        _remember(client, name, former[:-1])
    return demoted.number, int(former[-1])


def _names(client: mlflow.MlflowClient) -> list[str]:
    return sorted(model.name for model in client.search_registered_models(max_results=1000))


def _former_champions(client: mlflow.MlflowClient, name: str) -> list[str]:
    return [number for number in client.get_registered_model(name).tags.get(FORMER_CHAMPIONS, "").split(",") if number]


def _remember(client: mlflow.MlflowClient, name: str, numbers: list[str]) -> None:
    client.set_registered_model_tag(name, FORMER_CHAMPIONS, ",".join(numbers))


def _describe(known: list[Version]) -> str:
    return ", ".join(f"{v.number}{''.join(f' (@{alias})' for alias in v.aliases)}" for v in known) or "none"
