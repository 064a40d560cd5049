"""The learning algorithms there are: every file in `algorithms/`, found by its name."""

import importlib
import pkgutil
from typing import Any

from swarmtwin.errors import UserError, near_miss
from swarmtwin.policies import algorithms
from swarmtwin.policies.algorithm import AlgorithmConfig


def algorithm_names() -> tuple[str, ...]:
    """Names of the algorithms, sorted."""
    return tuple(sorted(module.name for module in pkgutil.iter_modules(algorithms.__path__)))


def algorithm_config(content: Any, where: str) -> AlgorithmConfig:
    """Validate an algorithm's configuration, as a mapping with its `name`, read from `where`.

    Raises:
        UserError: no or an unknown name, an unknown field, a wrong value.
    """
    if not isinstance(content, dict) or not isinstance(content.get("name"), str):
        known = near_miss("", algorithm_names())
        raise UserError(f"{where}: field 'name' is missing: it says which algorithm; {known}")
    if content["name"] not in algorithm_names():
        raise UserError(f"no such algorithm: {content['name']!r}: {near_miss(content['name'], algorithm_names())}")
    config: type[AlgorithmConfig] = importlib.import_module(f"{algorithms.__name__}.{content['name']}").Config
    return config.parse(content, where)
