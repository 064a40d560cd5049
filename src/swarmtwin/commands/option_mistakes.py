"""What is wrong with the options as they were typed: one sentence with the remedy in place of Hydra's own words."""

import logging
import re
from collections.abc import Iterator, Sequence
from typing import Any, NoReturn

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import InterpolationResolutionError, MissingMandatoryValue

from swarmtwin.configuration import config_files, config_folder, config_folders
from swarmtwin.errors import UserError, near_miss

logger = logging.getLogger(__name__)


def check_overrides(arguments: Sequence[str]) -> None:
    """Check that arguments are options with values that Hydra can read; of one given twice, say which value holds.

    Raises:
        UserError: one is not.
    """
    parser = get_args_parser()
    parser.error = _refuse  # type: ignore[method-assign]
    typed, unknown = parser.parse_known_args(list(arguments))
    if unknown:
        dashed = unknown[0].lstrip("-")
        meant = f"write {dashed}, without dashes" if "=" in dashed else "options are written name=value, without dashes"
        raise UserError(f"unknown option {unknown[0]!r}: {meant}")
    overrides = [_parsed(argument) for argument in typed.overrides]
    for override in overrides:
        _check_value(override)
    given = {override.get_key_element().lstrip("+"): str(override.input_line) for override in overrides}
    for override in overrides:
        name, line = override.get_key_element().lstrip("+"), str(override.input_line)
        if given[name] != line:
            logger.warning("option %r is given twice: %s holds, not %s", name, given[name], line)


def _refuse(message: str) -> NoReturn:
    raise UserError(f"{message}: options are written name=value, without dashes; --help shows them")


def _parsed(argument: str) -> Override:
    try:
        return OverridesParser.create().parse_override(argument)
    except HydraException:
        pass
    name, equals, value = argument.partition("=")
    words = name.split() or ["NAME"]
    if not equals:
        meant = "=".join(words) if len(words) == 2 else f"{words[0]}=..."
        raise UserError(f"{argument!r} is no option with its value: write {meant}")
    if not re.fullmatch(r"[~+]*[\w./@-]+", name, re.ASCII):
        raise UserError(
            f"{argument!r} begins with what is no option's name: write {words[0]}=..., without spaces and accents"
        )
    if any(value.count(opening) != value.count(closing) for opening, closing in ("[]", "{}", "()")):
        raise UserError(f"option {name!r}: {value!r} has a bracket without its partner: write the missing one")
    if value.count("'") % 2 or value.count('"') % 2:
        raise UserError(f"option {name!r}: {value!r} has a quotation mark without its partner: write the missing one")
    quoted = value.replace("'", '"').replace('"', '\\"')
    raise UserError(
        f"option {name!r}: {value!r} holds what is no plain text to Hydra: put quotation marks around it, and others "
        f"around the whole for the shell: '{name}=\"{quoted}\"'"
    )


def _check_value(override: Override) -> None:
    name = override.get_key_element().lstrip("+~")
    if override.value() == "" and not override.is_delete():
        choices = ", ".join(sorted(config_files(name)))
        known = f": choose one of {choices}" if choices else f": write {name}=VALUE, or {name}=null for none"
        raise UserError(f"option {name!r} has no value{known}")


def explain(error: Exception, config_name: str, arguments: Sequence[str]) -> str:
    """Say in one line what a Hydra or OmegaConf error means and what to do, naming the option probably meant.

    `arguments` tell which choices of groups the options belong to.
    """
    text = str(error)
    if isinstance(error, MissingMandatoryValue):
        return f"option {error.full_key!r} is missing: add {error.full_key}=..."
    if isinstance(error, InterpolationResolutionError):
        return f"option {error.full_key!r} refers to another one that cannot be found: {text.splitlines()[0]}"
    if isinstance(error, MissingConfigException):
        if missing := re.search(r"Could not find '([^']+)/([^'/]*)'", text):
            group, choice = missing.groups()
            return f"no such {group}: {choice!r}: {near_miss(choice, config_files(group))}"
        return text.splitlines()[0]
    if unknown := re.search(r"Could not override '([^']+)'", text):
        option = unknown.group(1)
        config = _composed(config_name, arguments)
        last = option.rpartition(".")[2]
        paths = _paths(OmegaConf.to_container(config))
        if elsewhere := [repr(path) for path in paths if path.rpartition(".")[2] == last]:
            return f"unknown option {option!r}: did you mean {' or '.join(elsewhere[:3])}?"
        return f"unknown option {option!r}: {near_miss(*_unknown_and_known(config, option))}"
    if unfit := re.search(r"Error merging override (\S+?)=", text):
        option = unfit.group(1).lstrip("+")
        return f"option {option!r} {_shape(OmegaConf.select(_composed(config_name, arguments), option), option)}"
    if twice := re.search(r"(\S+) appears more than once in the final defaults list", text):
        return f"{twice[1]!r} is chosen already: write {twice[1]}=..., without +"
    if absent := re.search(r"Could not delete from config\. '([^']+)'", text):
        return f"'~{absent[1]}' takes away what has no value yet: give it one, {absent[1]}=..."
    if several := re.search(r"Ambiguous value for argument '([^=]+)=(.*)'", text):
        return f"'{several[1]}={several[2]}' names several: add -m for one run each, or write [{several[2]}] for a list"
    return " ".join(text.split())


def _shape(node: Any, option: str) -> str:
    """Say how an option is written, of which something of another shape was given."""
    if isinstance(node, DictConfig):
        parts = ", ".join(f"{option}.{key!s}=..." for key in node)
        return f"is made of parts: set them one by one, {parts}"
    if isinstance(node, ListConfig):
        return f"is a list: write {option}=[...]"
    return "holds a single value: give one"


def _composed(config_name: str, arguments: Sequence[str]) -> DictConfig:
    """Return a configuration with the choices of groups that arguments make."""
    shipped = {f"{file.parent.name}={file.stem}" for folder in config_folders() for file in folder.glob("*/*.yaml")}
    with hydra.initialize_config_dir(str(config_folder()), version_base="1.3"):
        config = hydra.compose(config_name)
        choices = [choice for choice in arguments if choice in shipped and choice.partition("=")[0] in config]
        return hydra.compose(config_name, choices)


def _paths(content: Any, prefix: str = "") -> Iterator[str]:
    """Yield the dotted names of all options in a configuration's plain content."""
    if isinstance(content, dict):
        for key, value in content.items():
            yield f"{prefix}{key!s}"
            yield from _paths(value, f"{prefix}{key!s}.")


def _unknown_and_known(config: DictConfig, option: str) -> tuple[str, list[str]]:
    """Return the first part of a dotted `option` that does not exist, and the options there are in its place."""
    parent = option.rpartition(".")[0]
    if parent and OmegaConf.select(config, parent) is None:
        return _unknown_and_known(config, parent)
    node = OmegaConf.select(config, parent) if parent else config
    prefix = f"{parent}." if parent else ""
    return option, [f"{prefix}{key!s}" for key in node] if isinstance(node, DictConfig) else []
