"""YAML files as plain data: bounded in size, in depth and in what aliases expand to; nothing in them is code."""

import stat
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from swarmtwin.errors import UserError


@dataclass(frozen=True)
class Bounds:
    """How large a YAML file may be, far beyond what any of ours is.

    Attributes:
        size: bytes.
        depth: collections in collections.
        nodes: values, those behind aliases counted as often as they are named.
    """

    size: int = 10_000_000
    depth: int = 50
    nodes: int = 1_000_000


def read_yaml(path: Path, bounds: Bounds | None = None) -> Any:
    """Return the content of a YAML file.

    Raises:
        UserError: it is no regular file, or beyond the bounds.
        OSError, yaml.YAMLError: it is not there or cannot be read; it is no YAML.
    """
    bounds = bounds or Bounds()
    about = path.stat()
    if not stat.S_ISREG(about.st_mode) and not stat.S_ISDIR(about.st_mode):
        raise UserError(f"{path} is no regular file: put a copy of the file's content there")
    if about.st_size > bounds.size:
        raise UserError(f"{path} holds {about.st_size} bytes, more than {bounds.size}: is it the right file?")
    content = path.read_bytes()
    _check_bounds(content, path, bounds)
    return yaml.safe_load(content)


def _check_bounds(content: bytes, path: Path, bounds: Bounds) -> None:
    """Refuse content that would take too long, or too deep a stack, to build or to walk through."""
    sizes: dict[str, int] = {}  # nodes behind each anchor
    open_collections: list[tuple[str | None, int]] = []  # anchor, and nodes up to there
    nodes = 0
    for event in yaml.parse(content, Loader=yaml.SafeLoader):
        if isinstance(event, yaml.AliasEvent):
            nodes += sizes.get(event.anchor or "", 0)
        elif isinstance(event, yaml.ScalarEvent):
            nodes += 1
            if event.anchor:
                sizes[event.anchor] = 1
        elif isinstance(event, yaml.CollectionStartEvent):
            open_collections.append((event.anchor, nodes))
            nodes += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = open_collections.pop()
            if anchor:
                sizes[anchor] = nodes - before
        if len(open_collections) > bounds.depth:
            raise UserError(f"{path}: more than {bounds.depth} lists or mappings in each other: make it flatter")
        if nodes > bounds.nodes:
            raise UserError(f"{path}: more than {bounds.nodes} values, aliases included: make it smaller")
