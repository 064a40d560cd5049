"""What there is of something that one file adds: the files of a package, each ending in its `Config`, found by name."""

import importlib
import pkgutil
from types import ModuleType
from typing import Any, Generic, TypeVar

from swarmtwin.errors import UserError, near_miss
from swarmtwin.robot import StrictModel

Config = TypeVar("Config", bound=StrictModel)


class Kinds(Generic[Config]):
    """The kinds in a package: dynamics models, generators, tasks, algorithms.

    Args:
        package: holds one file a kind.
        noun: what people call one of them, in full: "dynamics model".
        which: the same in short, where the context is known: "model".
        field: of a configuration, which says its kind.
    """

    def __init__(self, package: ModuleType, noun: str, which: str, field: str = "name") -> None:
        self._package = package
        self._noun = noun
        self._which = which
        self._field = field

    def names(self) -> tuple[str, ...]:
        """Return the names of the files, sorted."""
        return tuple(sorted(module.name for module in pkgutil.iter_modules(self._package.__path__)))

    def config_class(self, name: str) -> type[Config]:
        """Return the class that types the configurations of kind `name`.

        Raises:
            UserError: there is no such kind.
        """
        if name not in self.names():
            raise UserError(f"no such {self._noun}: {name!r}: {near_miss(name, self.names())}")
        found: type[Config] = importlib.import_module(f"{self._package.__name__}.{name}").Config
        return found

    def config(self, content: Any, where: str) -> Config:
        """Validate a configuration, a mapping that says its kind, read from `where`.

        Raises:
            UserError: no or an unknown kind, an unknown field, a wrong value.
        """
        kind = content.get(self._field) if isinstance(content, dict) else None
        if not isinstance(kind, str):
            known = near_miss("", self.names())
            raise UserError(f"{where}: field {self._field!r} is missing: it says which {self._which}; {known}")
        return self.config_class(kind).parse(content, where)
