"""The tasks there are: every file in `tasks/`, found by its name."""

import importlib
import pkgutil
from typing import Any

from swarmtwin.errors import UserError, near_miss
from swarmtwin.world import tasks
from swarmtwin.world.task import TaskConfig


def task_kinds() -> tuple[str, ...]:
    """Names of the files in `tasks/`, sorted."""
    return tuple(sorted(module.name for module in pkgutil.iter_modules(tasks.__path__)))


def config_class(kind: str) -> type[TaskConfig]:
    """Return the class that types the configuration of tasks of this kind.

    Raises:
        UserError: there is no such kind.
    """
    if kind not in task_kinds():
        raise UserError(f"no such kind of task: {kind!r}: {near_miss(kind, task_kinds())}")
    module = importlib.import_module(f"{tasks.__name__}.{kind}")
    config: type[TaskConfig] = module.Config
    return config


def task_config(content: Any, where: str) -> TaskConfig:
    """Validate a task's configuration, as a mapping with its `kind`, read from `where`.

    Raises:
        UserError: no or an unknown kind, an unknown field, a wrong value.
    """
    if not isinstance(content, dict) or not isinstance(content.get("kind"), str):
        raise UserError(f"{where}: field 'kind' is missing: it says which task; {near_miss('', task_kinds())}")
    return config_class(content["kind"]).parse(content, where)
