"""The dynamics models there are: every file in `models/`, found by its name."""

import importlib
import pkgutil
from typing import Any

from swarmtwin.dynamics import models
from swarmtwin.dynamics.model_config import ModelConfig
from swarmtwin.errors import UserError, near_miss


def model_names() -> tuple[str, ...]:
    """Names of the models, sorted."""
    return tuple(sorted(module.name for module in pkgutil.iter_modules(models.__path__)))


def config_class(name: str) -> type[ModelConfig]:
    """Return the class that types the configuration of model `name`.

    Raises:
        UserError: there is no such model.
    """
    if name not in model_names():
        raise UserError(f"no such dynamics model: {name!r}: {near_miss(name, model_names())}")
    module = importlib.import_module(f"{models.__name__}.{name}")
    config: type[ModelConfig] = module.Config
    return config


def model_config(content: Any, where: str) -> ModelConfig:
    """Validate a model's configuration, as a mapping with the model's `name`, read from `where`.

    Raises:
        UserError: no or an unknown name, an unknown field, a wrong value.
    """
    if not isinstance(content, dict) or not isinstance(content.get("name"), str):
        raise UserError(f"{where}: field 'name' is missing: it says which model; {near_miss('', model_names())}")
    return config_class(content["name"]).parse(content, where)
