"""Configurations from outside (--config-dir, hydra.searchpath): plain data, which choose no code and no settings."""

import itertools
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import yaml

from swarmtwin.errors import UserError
from swarmtwin.plain_yaml import read_yaml


def check_outside_configs(arguments: Sequence[str], most_files: int = 1000) -> None:
    """Check every YAML file in the folders that arguments add to Hydra's search path.

    Code belongs into a folder of plug-ins, which the user names in `SWARMTWIN_PLUGINS` and trusts.

    Raises:
        UserError: a file is no plain data: it names code, Hydra's settings, another place in the configuration, or what
            is not in it; or it is damaged, or too large.
    """
    for folder in _folders(arguments):
        files = list(itertools.islice(sorted(folder.rglob("*.y*ml")), most_files + 1))
        if len(files) > most_files:
            raise UserError(f"{folder} holds more than {most_files} YAML files: name the folder itself")
        for file in files:
            _check(file)


def _folders(arguments: Sequence[str]) -> Iterator[Path]:
    for argument, following in itertools.zip_longest(arguments, arguments[1:], fillvalue=""):
        if argument in ("--config-dir", "-cd", "--config-path", "-cp"):
            yield Path(following)
        elif named := re.match(r"(?:--config-dir|-cd|--config-path|-cp)=(.+)", argument):
            yield Path(named[1])
        elif named := re.match(r"hydra\.searchpath=\[?([^\]]*)", argument):
            places = (place.strip(" '\"") for place in named[1].split(","))
            yield from (Path(place.removeprefix("file://")) for place in places if not place.startswith("pkg://"))


def _check(file: Path) -> None:
    try:
        content = read_yaml(file)
        text = file.read_text()
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise UserError(f"{file} is not valid YAML ({' '.join(str(error).split())}): correct it") from None
    if re.search(r"^\s*#\s*@package", text, re.MULTILINE):
        raise UserError(f"{file}: '# @package' moves it to another place in the configuration: take the line out")
    if isinstance(content, dict) and not _names_files(content.get("defaults", [])):
        raise UserError(f"{file}: 'defaults' is no list of other files' names: take it out, or write one")
    for key, value in _walk(content):
        if str(key).startswith("_") or "hydra" in str(key):
            raise UserError(f"{file}: {key!r} would choose code or settings of Hydra's: take it out")
        if key == "defaults" and "hydra" in str(value):
            raise UserError(f"{file}: {value!r} would choose settings of Hydra's: take it out")
        if isinstance(value, str) and "${" in value:
            raise UserError(f"{file}: {value!r} refers to what is not in the file: write the value out")


def _names_files(defaults: Any) -> bool:
    """Say whether it is a list as Hydra reads it: of names, and of groups with a name, with several or with none."""
    return isinstance(defaults, list) and all(isinstance(entry, str) or _is_choice(entry) for entry in defaults)


def _is_choice(entry: Any) -> bool:
    if not isinstance(entry, dict) or len(entry) != 1:
        return False
    ((group, names),) = entry.items()
    words = names if isinstance(names, list) else [] if names is None else [names]
    return isinstance(group, str) and all(isinstance(word, str) for word in words)


def _walk(content: Any, key: Any = "") -> Iterator[tuple[Any, Any]]:
    """Yield every key and value; items of a list under the key of the list."""
    yield key, content
    if isinstance(content, dict):
        for name, value in content.items():
            yield from _walk(value, name)
    elif isinstance(content, list):
        for value in content:
            yield from _walk(value, key)
