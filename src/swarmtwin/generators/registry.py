"""The generators there are: every file in `models/`, found by its name."""

import importlib
import pkgutil
from typing import Any

from swarmtwin.errors import UserError, near_miss
from swarmtwin.generators import models
from swarmtwin.generators.generator_config import GeneratorConfig


def generator_names() -> tuple[str, ...]:
    """Names of the generators, sorted."""
    return tuple(sorted(module.name for module in pkgutil.iter_modules(models.__path__)))


def config_class(name: str) -> type[GeneratorConfig]:
    """Return the class that types the configuration of generator `name`.

    Raises:
        UserError: there is no such generator.
    """
    if name not in generator_names():
        raise UserError(f"no such generator: {name!r}: {near_miss(name, generator_names())}")
    module = importlib.import_module(f"{models.__name__}.{name}")
    config: type[GeneratorConfig] = module.Config
    return config


def generator_config(content: Any, where: str) -> GeneratorConfig:
    """Validate a generator's configuration, as a mapping with the generator's `name`, read from `where`.

    Raises:
        UserError: no or an unknown name, an unknown field, a wrong value.
    """
    if not isinstance(content, dict) or not isinstance(content.get("name"), str):
        raise UserError(
            f"{where}: field 'name' is missing: it says which generator; {near_miss('', generator_names())}"
        )
    return config_class(content["name"]).parse(content, where)
