"""The package `swarmtwin` as text: what each module imports, and which plug-ins it may load by name."""

import ast
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple


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
    """All modules of the package, read once.

    Args:
        source: the folder that holds the package.

    Attributes:
        paths: the file of each module, relative to the repository.
        empty_files: those that hold nothing but a docstring, as the `__init__.py` of most folders does.
        plugin_kinds: the registries of plug-ins, by the module that makes them.
    """

    def __init__(self, source: Path) -> None:
        files = sorted(file.relative_to(source.parent) for file in (source / "swarmtwin").rglob("*.py"))
        names = [".".join(file.with_suffix("").parts[1:]).removesuffix(".__init__") for file in files]
        self.paths = dict(zip(names, files, strict=True))
        self.empty_files: set[Path] = set()
        self.plugin_kinds: dict[str, list[PluginKind]] = {}
        self._imports: dict[str, list[str]] = {}
        self._named: dict[str, list[Path]] = {}
        for module, file in self.paths.items():  # a tree at a time: kept, they would slow the garbage collector down
            tree = ast.parse((source.parent / file).read_text())
            if all(_is_docstring(node) for node in tree.body):
                self.empty_files.add(file)
            nodes = list(ast.walk(tree))
            self.plugin_kinds[module] = list(_registries(nodes))
            self._imports[module] = self._imported(module, nodes)
            self._named[module] = _named_files(source.parent, file, nodes)

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
            if module in modules or module not in self.paths or matches(self.paths[module], leave_out):
                continue
            modules.add(module)
            files |= {self.paths[module], *self._named[module]}
            waiting += self._imports[module]
            for kind in self.plugin_kinds[module]:
                plugins = [name for name in self.paths if name.rpartition(".")[0] == kind.package]
                names = chosen.get(kind)
                waiting += [name for name in plugins if names is None or name.rpartition(".")[2] in names]
        return {file for file in files - self.empty_files if not matches(file, leave_out)}

    def _imported(self, module: str, nodes: Sequence[ast.AST]) -> list[str]:
        """Return the modules of the package that a module imports, and the packages that they are in.

        The package itself and `commands` are left out: they hold what a version is and what commands there are.
        """
        names = []
        for node in nodes:
            if isinstance(node, ast.Import):
                names += [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module:
                names += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        inside = [name for name in names if name.startswith("swarmtwin.") and name in self.paths]
        packages = {name.rsplit(".", depth)[0] for name in (*inside, module) for depth in range(1, name.count(".") + 1)}
        return [*inside, *(packages - {"swarmtwin", "swarmtwin.commands"})]


def matches(file: Path, patterns: Sequence[str]) -> bool:
    """Say whether a file's path ends as one of the patterns does."""
    return any(file.match(pattern) for pattern in patterns)


def _is_docstring(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def _named_files(repository: Path, module: Path, nodes: Sequence[ast.AST]) -> list[Path]:
    """Return the files beside a module, such as templates, whose names stand in it."""
    texts = {node.value for node in nodes if isinstance(node, ast.Constant)}
    others = (file for file in (repository / module).parent.iterdir() if file.suffix not in ("", ".py"))
    return [file.relative_to(repository) for file in others if file.name in texts]


def _registries(nodes: Sequence[ast.AST]) -> Iterator[PluginKind]:
    """Find the calls `PluginRegistry(package, noun, group=..., field=...)` in a module."""
    imports = [(node.module, alias) for node in nodes if isinstance(node, ast.ImportFrom) for alias in node.names]
    packages = {alias.asname or alias.name: f"{module}.{alias.name}" for module, alias in imports}
    for node in nodes:
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "PluginRegistry":
            options = {word.arg: ast.literal_eval(word.value) for word in node.keywords}
            assert isinstance(node.args[0], ast.Name), "PluginRegistry wants the package by its name"
            yield PluginKind(packages[node.args[0].id], options["group"], options.get("field", "name"))
