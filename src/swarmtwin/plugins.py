"""Plug-ins: what is added by one file of code, found by its name, in this package or in a folder of the user's own.

Dynamics models, generators, mechanisms, tasks, algorithms, importers, kinematics and stand-ins are plug-ins. Each kind
has a folder in this package (`swarmtwin/dynamics/models/`), one file a plug-in, and each file ends in the class that a
`PluginRegistry` looks for, most often `Config`, which types the YAML that chooses it (`conf/model/<name>.yaml`).

Plug-ins of one's own need not lie in this package. `SWARMTWIN_PLUGINS=/path/to/mine` names a folder, or several apart
by `:` as in `PATH`, laid out like this package: `dynamics/models/`, `simulation/mechanisms/`, ..., and `conf/` beside
them. Code from outside is loaded from these folders alone: no configuration, model folder or recording can name one.
"""

import importlib
import os
import pkgutil
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType
from typing import Any, Generic, Protocol, Self, TypeVar, cast

from swarmtwin.errors import UserError, near_miss

PLUGIN_VARIABLE = "SWARMTWIN_PLUGINS"


def plugin_folders() -> tuple[Path, ...]:
    """Return the folders of plug-ins that the user names in `SWARMTWIN_PLUGINS`; none where it is not set.

    Raises:
        UserError: one of them is no folder.
    """
    folders = tuple(Path(name).expanduser() for name in os.environ.get(PLUGIN_VARIABLE, "").split(os.pathsep) if name)
    for folder in folders:
        if not folder.is_dir():
            raise UserError(f"{PLUGIN_VARIABLE} names {folder}, which is no folder: correct it, or unset the variable")
    return tuple(folder.resolve() for folder in folders)


def plugin_path(package: str, own_path: Iterable[str]) -> list[str]:
    """Return where the plug-ins of a package lie: its own folder, then the user's of the same name.

    A plug-in package sets its `__path__` to this, so that a plug-in from outside is imported, and pickled, under the
    package's name, also in other processes.

    Args:
        package: its full name, `__name__`: "swarmtwin.dynamics.models" looks for `dynamics/models/`.
        own_path: its `__path__` as Python set it.
    """
    inside = Path(*package.split(".")[1:])
    return [*own_path, *(str(folder / inside) for folder in plugin_folders() if (folder / inside).is_dir())]


class Typed(Protocol):
    """A class that makes a typed value of a configuration's content."""

    @classmethod
    def parse(cls, content: Any, where: str) -> Self:
        """Return the value that `content`, read from `where`, states."""


Plugin = TypeVar("Plugin")


class PluginRegistry(Generic[Plugin]):
    """The plug-ins of one kind: the files of a plug-in package, by name.

    Attributes:
        package: the plug-in package; each of its files is one plug-in.
        noun: what people call one of them, in full: "dynamics model".
        group: the folder in `conf/` whose files each choose one of them, "model"; None where no file of `conf/` does.
        field: of those files, the one that names the plug-in.
        ends_in: name of the class that each plug-in's file ends in.
    """

    def __init__(
        self, package: ModuleType, noun: str, group: str | None, field: str = "name", ends_in: str = "Config"
    ) -> None:
        self.package = package
        self.noun = noun
        self.group = group
        self.field = field
        self.ends_in = ends_in

    def names(self) -> tuple[str, ...]:
        """Return the names of all plug-ins, sorted.

        Raises:
            UserError: two files have the same name.
        """
        found = [module.name for folder in self.package.__path__ for module in pkgutil.iter_modules([folder])]
        if twice := [name for name, count in Counter(found).items() if count > 1]:
            folders = [folder for folder in self.package.__path__ if (Path(folder) / f"{twice[0]}.py").exists()]
            raise UserError(f"there are two {self.noun}s {twice[0]!r}, in {' and '.join(folders)}: rename one of them")
        return tuple(sorted(found))

    def plugin_class(self, name: str) -> type[Plugin]:
        """Return the class that the plug-in `name` ends in.

        Raises:
            UserError: there is no such plug-in, or its file ends in something else.
        """
        if name not in self.names():
            raise UserError(f"no such {self.noun}: {name!r}: {near_miss(name, self.names())}")
        module = importlib.import_module(f"{self.package.__name__}.{name}")
        found = getattr(module, self.ends_in, None)
        if not isinstance(found, type):
            raise UserError(f"{module.__file__}: no class {self.ends_in!r}: every {self.noun}'s file ends in one")
        return found

    def config(self, content: Any, where: str) -> Plugin:
        """Validate the configuration of a plug-in whose class is typed, a mapping that names the plug-in.

        Args:
            content: the mapping, as read from YAML.
            where: what it was read from, for errors.

        Raises:
            UserError: no or an unknown plug-in is named, or a field is unknown or its value wrong.
        """
        name = content.get(self.field) if isinstance(content, dict) else None
        if not isinstance(name, str):
            known = near_miss("", self.names())
            raise UserError(f"{where}: field {self.field!r} is missing: it says which {self.noun}; {known}")
        return cast(Plugin, cast(type[Typed], self.plugin_class(name)).parse(content, where))
