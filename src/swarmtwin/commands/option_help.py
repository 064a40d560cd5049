"""What `swarmtwin COMMAND --help` shows: each option, its default and its sentence, as the files in conf/ have them."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import yaml
from rich.console import Console
from rich.table import Table
from rich.text import Text

from swarmtwin.configuration import config_files, config_folder

_ENTRY = re.compile(r'^(?P<indent> *)(?P<quote>"?)(?P<key>[\w.]+)(?P=quote):(?P<value>[^#]*)(#\s?(?P<sentence>.*))?$')
_COMMENT = re.compile(r"^(?P<indent>\s*)#\s?(?P<sentence>.*)$")


@dataclass
class Option:
    """An option: its full name, its default as written, what it means."""

    name: str
    default: str
    sentence: str


@dataclass(frozen=True)
class ConfigFile:
    """A configuration as its file states it.

    Attributes:
        summary: the comment that it begins with.
        choices: what it takes from each group of files, by the group's name.
        options: its own, in order; those within others by dotted names.
    """

    summary: str
    choices: dict[str, str]
    options: list[Option]

    @classmethod
    def read(cls, file: Path) -> "ConfigFile":
        """Read a configuration. What an option means stands after it, or above it where files are long."""
        lines = file.read_text().splitlines()
        length = next((number for number, line in enumerate(lines) if not line.startswith("#")), len(lines))
        summary = " ".join(line[1:].strip() for line in lines[:length] if "@package" not in line)
        options = [one for one in _options(lines[length:]) if one.name.split(".")[0] not in ("defaults", "hydra")]
        return cls(summary, _choices(yaml.safe_load(file.read_text())), options)


def _choices(content: object) -> dict[str, str]:
    entries = content.get("defaults", []) if isinstance(content, dict) else []
    taken = {name: choice for entry in entries if isinstance(entry, dict) for name, choice in entry.items()}
    return {str(name).lstrip("/"): str(choice) for name, choice in taken.items() if "override" not in str(name)}


def _options(lines: Sequence[str]) -> list[Option]:
    found: list[Option] = []
    parents: list[tuple[int, str]] = []
    above, column = "", -1  # comments since the last entry, and where the one after it begins
    item = None  # where the dash of a list stands that the lines are in: what an item is made of is no option
    for line in lines:
        if line.lstrip().startswith("- "):
            item = line.index("-")
        elif entry := _ENTRY.match(line):
            indent = len(entry["indent"])
            if item is not None and indent > item:
                continue
            item = None
            parents = [(depth, name) for depth, name in parents if depth < indent]
            parents.append((indent, entry["key"]))
            sentence = f"{above} {entry['sentence'] or ''}".strip()
            found.append(Option(".".join(name for _, name in parents), entry["value"].strip(), sentence))
            above, column = "", line.find("#")
        elif comment := _COMMENT.match(line):
            if found and len(comment["indent"]) == column:
                found[-1].sentence += f" {comment['sentence']}"
            else:
                above = f"{above} {comment['sentence']}".strip()
    return found


def show_help(command: str, config_name: str, arguments: Sequence[str], console: Console | None = None) -> None:
    """Print what a command does, what can be chosen and what can be set, with the choices that arguments make.

    Args:
        command: as it is called, `experiment name=dynamics` included.
        config_name: its configuration in conf/.
        arguments: of which `group=choice` is looked at.
        console: where to.
    """
    console = console or Console(highlight=False, markup=False)
    config = ConfigFile.read(config_folder() / f"{config_name}.yaml")
    console.print(f"{config.summary}\n\nusage: swarmtwin {command} option=value ...\n")
    said = dict(argument.split("=", 1) for argument in arguments if "=" in argument and not argument.startswith("-"))
    chosen = {name: said.get(name.partition("@")[0], choice) for name, choice in config.choices.items()}
    if chosen:
        console.print("choices, each a file in conf/")
        known = {name: ", ".join(sorted(config_files(name.partition("@")[0]))) for name in chosen}
        console.print(_columns([(f"{name}={choice}", known[name]) for name, choice in chosen.items()]))
    console.print("options")
    console.print(_option_columns(config.options))
    for name, choice in chosen.items():
        group, _, package = name.partition("@")
        if file := config_files(group).get(choice):
            part = ConfigFile.read(file)
            console.print(f"{name}={choice}: {part.summary}")
            console.print(_option_columns(part.options, "" if package == "_global_" else f"{package or group}."))
    console.print("A sweep is -m option=a,b,c, one run each. --cfg job prints the whole configuration.")


def _option_columns(options: Sequence[Option], prefix: str = "") -> Table:
    """Show options; of those that hold others, what they mean, and of those that must be given, that."""
    rows = []
    for one in options:
        default = {"???": "...", "": ""}.get(one.default, one.default)
        needed = "needed: " if one.default == "???" else ""
        rows.append((f"{prefix}{one.name}{'=' if one.default else ':'}{default}", f"{needed}{one.sentence}"))
    return _columns(rows)


def _columns(rows: Sequence[tuple[str, str]], widest: int = 48) -> Table:
    table = Table.grid(padding=(0, 2))
    table.add_column(max_width=widest, overflow="fold")
    table.add_column()
    for name, sentence in rows:
        table.add_row(Text(f"  {name}"), Text(sentence))
    table.add_row("", "")
    return table
