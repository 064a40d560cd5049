"""The stages of `dvc.yaml`, and the code that each of them computes with, followed from its command through imports.

`make dependencies` (`python -m swarmtwin.tracking.pipeline`) writes the `src/...` lines of every stage's `deps:`; a
test compares. Folders of data and artifacts, and parameters, stand in `dvc.yaml` as they are written there by hand.
The module is in `tracking/` because it answers the question of that room, what a result came from; it reads the other
rooms as text and imports none of them.

What a stage hangs on:

- the module of its command, `swarmtwin/commands/<command>.py` or `swarmtwin/studies/<name>/study.py`, and whatever that
  imports, wherever in the file the import stands; not the dispatcher `swarmtwin/commands/app.py`, which only parses.
- of plug-ins, those that its configuration chooses: a stage with `model=crnet` hangs on `dynamics/models/crnet.py` and
  not on `gru.py`. Where it chooses none, those that the stages chose whose outputs it reads; where neither does, or
  where it reads what several of them left, the whole folder.
- pictures and reports, the modules of `PRESENTATION`, only where nothing comes after it: no later stage reads the
  picture that a training leaves beside its weights, so a line in a plot makes no model stale.
"""

import ast
import itertools
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import yaml

PRESENTATION = ("*_plots.py", "plotting.py", "progress_bars.py", "report/*", "rendering/*", "*.jinja")
"""Files that only draw, print or lay out what other modules have computed, as patterns of their paths' ends."""


@dataclass(frozen=True)
class Stage:
    """A stage with its places filled in: for one robot, one model, one policy.

    Attributes:
        template: the name it has in `dvc.yaml`; DVC's own is `<template>@<items>`.
        items: what fills its places, such as `{"item.robot": "mgr"}`.
        arguments: of `swarmtwin`: the command, then its options.
        deps: files and folders that it hangs on, as `dvc.yaml` states them.
        params: parameter files; of each the keys that it hangs on, None for all.
        outs: files and folders that it leaves.
    """

    template: str
    items: Mapping[str, str]
    arguments: tuple[str, ...]
    deps: tuple[str, ...]
    params: Mapping[str, Sequence[str] | None]
    outs: tuple[str, ...]

    @property
    def name(self) -> str:
        """DVC's name of it."""
        values = [self.items["key"]] if "key" in self.items else list(self.items.values())
        return f"{self.template}@{'-'.join(values)}" if values else self.template

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

    def reads(self, other: "Stage") -> bool:
        """Say whether it reads what another stage leaves, or a part of it."""
        pairs = itertools.product(map(Path, self.deps), map(Path, other.outs))
        return any(dep.is_relative_to(out) or out.is_relative_to(dep) for dep, out in pairs)


def read_stages(repository: Path) -> list[Stage]:
    """Return every stage of the repository's `dvc.yaml`, its matrices multiplied out."""
    pipeline = yaml.safe_load((repository / "dvc.yaml").read_text())
    values: dict[str, Any] = {}
    for entry in pipeline["vars"]:
        values |= yaml.safe_load((repository / entry).read_text()) if isinstance(entry, str) else entry
    return [stage for name, content in pipeline["stages"].items() for stage in _multiplied_out(name, content, values)]


def _multiplied_out(template: str, content: Mapping[str, Any], values: Mapping[str, Any]) -> Iterator[Stage]:
    """Fill in a stage's places with each of its items in turn."""
    form = content.get("do", {key: value for key, value in content.items() if key != "matrix"})
    for items in _items(content, values):
        stage = filled_in(form, {**values, **items})
        words = shlex.split(stage["cmd"])
        yield Stage(
            template=template,
            items={place: str(value) for place, value in items.items()},
            arguments=tuple(words[words.index("swarmtwin") + 1 :]),
            deps=tuple(stage["deps"]),
            params={file: keys for entry in stage.get("params", ()) for file, keys in entry.items()},
            outs=tuple(path for out in stage["outs"] for path in ([out] if isinstance(out, str) else out)),
        )


def _items(content: Mapping[str, Any], values: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return what fills a stage's places, one mapping for each stage that comes of it."""
    if "foreach" in content:
        entries = filled_in(content["foreach"], values).items()
        return [{"key": key} | {f"item.{name}": value for name, value in item.items()} for key, item in entries]
    matrix = filled_in(content.get("matrix", {}), values)
    places = [f"item.{name}" for name in matrix]
    return [dict(zip(places, chosen, strict=True)) for chosen in itertools.product(*matrix.values())]


def filled_in(content: Any, values: Mapping[str, Any]) -> Any:
    """Fill in the places `${...}` of a piece of `dvc.yaml`, in its keys as well; unknown ones stay."""
    if isinstance(content, dict):
        return {filled_in(key, values): filled_in(value, values) for key, value in content.items()}
    if isinstance(content, list):
        return [filled_in(value, values) for value in content]
    if not isinstance(content, str):
        return content
    if whole := re.fullmatch(r"\$\{([\w.]+)\}", content):
        return values.get(whole[1], content)
    return re.sub(r"\$\{([\w.]+)\}", lambda place: str(values.get(place[1], place[0])), content)


class PluginKind(NamedTuple):
    """A `PluginRegistry` as it stands in the code.

    Attributes:
        package: the plug-in package.
        group: the folder in `conf/` whose files choose a plug-in; None where nothing does.
        field: of those files, the one that names the plug-in.
    """

    package: str
    group: str | None
    field: str


class Code:
    """The package `swarmtwin` as text: which module imports which.

    Attributes:
        source: the folder that holds the package.
    """

    def __init__(self, source: Path) -> None:
        self.source = source
        files = {file.relative_to(source): file for file in sorted((source / "swarmtwin").rglob("*.py"))}
        self._files = {
            ".".join(path.with_suffix("").parts).removesuffix(".__init__"): file for path, file in files.items()
        }
        self._trees = {module: ast.parse(file.read_text()) for module, file in self._files.items()}

    def path(self, module: str) -> Path:
        """Return the file of a module, relative to the repository."""
        return self._files[module].relative_to(self.source.parent)

    @cached_property
    def empty_files(self) -> set[Path]:
        """The files that hold nothing but a docstring, as the `__init__.py` of most folders does."""
        return {
            self.path(module)
            for module, tree in self._trees.items()
            if all(isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) for node in tree.body)
        }

    @cached_property
    def plugin_kinds(self) -> dict[str, list[PluginKind]]:
        """The registries of plug-ins, by the module that makes them."""
        return {module: kinds for module in self._files if (kinds := list(self._registries(module)))}

    def plugins(self, kind: PluginKind) -> dict[str, str]:
        """Return the modules of all plug-ins of a kind, by name."""
        modules = (module for module in self._files if module.rpartition(".")[0] == kind.package)
        return {module.rpartition(".")[2]: module for module in modules}

    def reached(self, start: str, chosen: Mapping[PluginKind, Sequence[str]], leave_out: Sequence[str]) -> set[Path]:
        """Return the files that a module is made of: itself, what it imports, and so on.

        Args:
            start: the module.
            chosen: of a kind of plug-ins, the names of those to follow; of a kind that is not in it, all.
            leave_out: patterns of files that are neither taken nor followed.

        Returns:
            modules and the other files that they name and that lie beside them, relative to the repository.
        """
        waiting, modules, files = [start], set(), set()
        while waiting:
            module = waiting.pop()
            if module in modules or module not in self._files or _matches(self.path(module), leave_out):
                continue
            modules.add(module)
            files |= {self.path(module), *self._named_files[module]}
            waiting += self._imports[module]
            for kind in self.plugin_kinds.get(module, ()):
                plugins = self.plugins(kind)
                waiting += [plugins[name] for name in chosen.get(kind, plugins) if name in plugins]
        return {file for file in files - self.empty_files if not _matches(file, leave_out)}

    @cached_property
    def _imports(self) -> dict[str, list[str]]:
        return {module: self._imported(module) for module in self._trees}

    @cached_property
    def _named_files(self) -> dict[str, list[Path]]:
        """The files beside each module, such as templates, whose names stand in it."""
        found = {}
        for module, tree in self._trees.items():
            texts = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)}
            others = (file for file in self._files[module].parent.iterdir() if file.suffix not in ("", ".py"))
            found[module] = [file.relative_to(self.source.parent) for file in others if file.name in texts]
        return found

    def _imported(self, module: str) -> list[str]:
        """Return the modules of the package that a module imports, and the packages that they are in.

        Imports for type checkers alone are left out. So are the package itself and `commands`, which hold what a
        version is and what commands there are.
        """
        names = []
        for node in _run_nodes(self._trees[module]):
            if isinstance(node, ast.Import):
                names += [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module:
                names += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        inside = [name for name in names if name.startswith("swarmtwin.") and name in self._files]
        packages = {name.rsplit(".", depth)[0] for name in (*inside, module) for depth in range(1, name.count(".") + 1)}
        return [*inside, *(packages - {"swarmtwin", "swarmtwin.commands"})]

    def _registries(self, module: str) -> Iterator[PluginKind]:
        """Find the calls `PluginRegistry(package, noun, group=..., field=...)` in a module."""
        tree = self._trees[module]
        packages = {
            alias.asname or alias.name: f"{node.module}.{alias.name}"
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom)
            for alias in node.names
        }
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "PluginRegistry":
                options = {word.arg: ast.literal_eval(word.value) for word in node.keywords}
                assert isinstance(node.args[0], ast.Name), f"{module}: PluginRegistry wants the package by its name"
                yield PluginKind(packages[node.args[0].id], options["group"], options.get("field", "name"))


def _run_nodes(node: ast.AST) -> Iterator[ast.AST]:
    """Walk through the nodes of a tree, without those under `if TYPE_CHECKING`."""
    yield node
    if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
        return
    for child in ast.iter_child_nodes(node):
        yield from _run_nodes(child)


def _matches(file: Path, patterns: Sequence[str]) -> bool:
    return any(file.match(pattern) for pattern in patterns)


class Pipeline:
    """A repository's `dvc.yaml`, its configuration and its code, as they are when they are first asked for.

    Attributes:
        repository: its folder.
        source: its code.
        stages: by name.
    """

    def __init__(self, repository: Path) -> None:
        self.repository = repository
        self.source = Code(repository / "src")
        self.stages = {stage.name: stage for stage in read_stages(repository)}

    @cached_property
    def choices(self) -> dict[str, dict[str, set[str]]]:
        """The files in `conf/` that each stage's configuration is composed of, by their folder.

        They are those in the defaults list that its command begins with, as Hydra reads it, unless an option names
        another.
        """
        names = {stage.config_name for stage in self.stages.values()}
        lists = {name: self._configuration(name)["defaults"] for name in names}
        found: dict[str, dict[str, set[str]]] = {name: {} for name in self.stages}
        for name, stage in self.stages.items():
            for entry in lists[stage.config_name]:
                (group, choice), *_ = entry.items() if isinstance(entry, dict) else [("", None)]
                group = group.removeprefix("/")
                choice = stage.options.get(group, choice)
                if choice is not None and not group.startswith("override "):
                    found[name].setdefault(group.partition("@")[0], set()).add(choice)
        return found

    @cached_property
    def upstream(self) -> dict[str, set[str]]:
        """The stages whose outputs each stage reads, and those whose outputs these read."""
        read = {
            name: {other for other in self.stages if other != name and stage.reads(self.stages[other])}
            for name, stage in self.stages.items()
        }
        while True:
            further = {name: above.union(*(read[other] for other in above)) for name, above in read.items()}
            if further == read:
                return read
            read = further

    def is_last(self, name: str) -> bool:
        """Say whether no other stage reads what a stage leaves."""
        return not any(name in above for above in self.upstream.values())

    @cached_property
    def code(self) -> dict[str, set[Path]]:
        """The files of code that each stage hangs on, relative to the repository."""
        kinds = {kind for kinds in self.source.plugin_kinds.values() for kind in kinds}
        own = {kind: self._chosen_plugins(kind) for kind in kinds}
        return {
            name: self.source.reached(
                stage.module,
                {kind: names for kind in kinds if (names := self._followed_plugins(name, own[kind]))},
                () if self.is_last(name) else PRESENTATION,
            )
            for name, stage in self.stages.items()
        }

    def _chosen_plugins(self, kind: PluginKind) -> dict[str, set[str]]:
        """Return the plug-ins of a kind that the configuration of each stage chooses."""
        if kind.group is None:
            return {name: set() for name in self.stages}
        files = set().union(*(choices.get(kind.group, set()) for choices in self.choices.values()))
        plugin = {file: self._configuration(f"{kind.group}/{file}")[kind.field] for file in files}
        return {name: {plugin[file] for file in self.choices[name].get(kind.group, ())} for name in self.stages}

    def _followed_plugins(self, name: str, chosen: Mapping[str, set[str]]) -> list[str]:
        """Return a stage's own plug-ins or those of the stages that it reads; none where they are not to be told."""
        if chosen[name]:
            return sorted(chosen[name])
        by_template: dict[str, set[str]] = {}
        for other in self.upstream[name]:
            by_template.setdefault(self.stages[other].template, set()).update(chosen[other])
        several = any(len(names) > 1 for names in by_template.values())
        return [] if several else sorted(set().union(*by_template.values()))

    def _configuration(self, name: str) -> dict[str, Any]:
        content: dict[str, Any] = yaml.safe_load((self.repository / "conf" / f"{name}.yaml").read_text())
        return content

    def code_of_template(self, template: str) -> list[str]:
        """Return the lines of code in the `deps:` of a stage as `dvc.yaml` spells it, for all its items at once.

        A file that only some items hang on is told by the item's place in its name, `models/${item.model}.py`; where
        its name does not follow from the item, all hang on it. A folder stands for all that is in it.
        """
        items = {name: stage.items for name, stage in self.stages.items() if stage.template == template}
        files = {name: self.code[name] for name in items}
        shared = set.intersection(*files.values())
        lines = set()
        for file in sorted(set.union(*files.values()) - shared):
            places = (f"${{{place}}}" for place, value in _items_of(file, files, items) if value == file.stem)
            forms = (str(file.with_name(f"{place}{file.suffix}")) for place in places)
            fitting = (
                form for form in forms if all(Path(filled_in(form, items[name])) in files[name] for name in files)
            )
            if form := next(fitting, None):
                lines.add(form)
            else:
                shared.add(file)
        return sorted(lines | {str(path) for path in self._folders(shared)})

    def _folders(self, files: set[Path]) -> set[Path]:
        """Put a folder in the place of its files where all that it holds is among them."""
        whole = {}
        for folder in sorted({parent for file in files for parent in file.parents if len(parent.parts) > 2}):
            inside = {
                file.relative_to(self.repository)
                for file in (self.repository / folder).rglob("*")
                if file.is_file() and "__pycache__" not in file.parts
            } - self.source.empty_files
            if inside <= files and not any(parent in whole for parent in folder.parents):
                whole[folder] = inside
        return (files - set().union(*whole.values())) | set(whole)


def _items_of(
    file: Path, files: Mapping[str, set[Path]], items: Mapping[str, Mapping[str, str]]
) -> Iterator[tuple[str, str]]:
    """Go through the items of the stages that hang on a file."""
    for name, used in files.items():
        if file in used:
            yield from items[name].items()


def with_code(text: str, code: Mapping[str, Sequence[str]]) -> str:
    """Return the text of a `dvc.yaml` with other lines of code in its stages' `deps:`; the rest stays as it is.

    Args:
        text: of the file.
        code: of each stage, as the file names it, the lines.
    """
    lines, stage, indent = [], "", None
    for line in text.splitlines():
        if name := re.fullmatch(r"  (\w+):", line):
            stage = name[1]
        if indent is not None and not line.startswith(f"{indent}- "):
            lines += [f"{indent}- {path}" for path in code[stage]]
            indent = None
        if indent is None or not line.startswith(f"{indent}- src/"):
            lines.append(line)
        if found := re.fullmatch(r"( +)deps:", line):
            indent = f"{found[1]}  "
    return "\n".join(lines) + "\n"


def with_dependencies(pipeline: Pipeline) -> str:
    """Return the text of a repository's `dvc.yaml` with the code that its stages hang on."""
    templates = dict.fromkeys(stage.template for stage in pipeline.stages.values())
    code = {template: pipeline.code_of_template(template) for template in templates}
    return with_code((pipeline.repository / "dvc.yaml").read_text(), code)


def main() -> None:
    """Write the code that stages hang on into `dvc.yaml` in the current folder."""
    (Path.cwd() / "dvc.yaml").write_text(with_dependencies(Pipeline(Path.cwd())))


if __name__ == "__main__":
    main()
