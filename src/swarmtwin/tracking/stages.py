"""The stages of `dvc.yaml` that run a command, one for each robot, model and policy, as DVC multiplies them out."""

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dvc.dependency import ParamsDependency
from dvc.repo import Repo
from dvc.stage import PipelineStage


@dataclass(frozen=True)
class Stage:
    """A stage with its places filled in.

    Attributes:
        name: DVC's name of it, `<template>@<items>`.
        items: what fills its places, such as `{"robot": "mgr"}`.
        arguments: of `swarmtwin`: the command, then its options.
        deps: files and folders that it hangs on.
        params: parameter files; of each the keys that it hangs on, empty for all.
        outs: files and folders that it leaves.
        upstream: names of the stages whose outputs it reads, and of those whose outputs these read.
    """

    name: str
    items: Mapping[str, str]
    arguments: tuple[str, ...]
    deps: tuple[str, ...]
    params: Mapping[str, list[str]]
    outs: tuple[str, ...]
    upstream: tuple[str, ...]

    @property
    def template(self) -> str:
        """The name it has in `dvc.yaml`."""
        return self.name.partition("@")[0]

    @property
    def code_file(self) -> str:
        """The file in `artifacts/code/<robot>/` that tells which code it hangs on."""
        return self.name.replace("@", "-")

    @property
    def options(self) -> dict[str, str]:
        """The options of its command."""
        return dict(argument.split("=", 1) for argument in self.arguments[1:])

    @property
    def config_name(self) -> str:
        """The file in `conf/` that its command begins with."""
        return f"experiment/{self.options['name']}" if self.arguments[0] == "experiment" else self.arguments[0]

    @property
    def module(self) -> str:
        """The module that its command runs."""
        folder, _, study = self.config_name.partition("/")
        return f"swarmtwin.studies.{study}.study" if study else f"swarmtwin.commands.{folder}"


def read_stages(repository: Path) -> dict[str, Stage]:
    """Return every stage of a repository's `dvc.yaml` that runs a command of swarmtwin, by name.

    Pipelines in folders below are not among them.
    """
    file = str((repository / "dvc.yaml").resolve())
    with Repo(str(repository)) as repo:
        graph = repo.index.graph
        nodes = [node for node in graph if str(Path(node.path).resolve()) == file and _runs_command(node)]
        definitions = nodes[0].dvcfile.resolver.definitions  # every node's own would parse the file once more
        return {node.name: _stage(node, graph, definitions) for node in nodes}


def _runs_command(node: Any) -> bool:
    return isinstance(node, PipelineStage) and isinstance(node.cmd, str) and "swarmtwin" in shlex.split(node.cmd)


def _stage(node: Any, graph: Any, definitions: Mapping[str, Any]) -> Stage:
    """Return a stage of DVC's; `graph` leads from each to those that it reads, `definitions` are the file's entries."""
    words = shlex.split(node.cmd)
    upstream = [node]
    for reader in upstream:  # which grows meanwhile
        upstream += [other for other in graph.successors(reader) if other not in upstream]
    parameters = [entry for entry in node.deps if isinstance(entry, ParamsDependency)]
    return Stage(
        name=node.name,
        items={place: str(value) for place, value in _items(node.name, definitions).items()},
        arguments=tuple(words[words.index("swarmtwin") + 1 :]),
        deps=tuple(entry.def_path for entry in node.deps if entry not in parameters),
        params={entry.def_path: list(entry.params) for entry in parameters},
        outs=tuple(entry.def_path for entry in node.outs),
        upstream=tuple(other.name for other in upstream[1:] if _runs_command(other)),
    )


def _items(name: str, definitions: Mapping[str, Any]) -> dict[str, Any]:
    """Return what fills a stage's places, by their names in its matrix."""
    template, _, key = name.partition("@")
    if not key:
        return {}
    chosen: dict[str, Any] = definitions[template].normalized_iterable[key]
    return chosen
