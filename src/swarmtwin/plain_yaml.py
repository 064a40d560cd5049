"""YAML files as plain data: bounded in size, in depth and in what aliases expand to; nothing in them is code."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from swarmtwin.errors import UserError
from swarmtwin.files import check_regular


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


_SafeLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # in C, ten times as quick, where PyYAML has it


class _UniqueKeys(_SafeLoader):
    """Plain data in which no key stands twice: the last one would hold, and nobody would know."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        names = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        if twice := [name for name, count in Counter(names).items() if count > 1]:
            raise yaml.MarkedYAMLError(problem=f"{twice[0]!r} stands twice", problem_mark=node.start_mark)
        mapping: dict[Any, Any] = super().construct_mapping(node, deep)
        return mapping


def read_yaml(path: Path, bounds: Bounds | None = None) -> Any:
    """Return the content of a YAML file.

    Raises:
        UserError: it is no regular file, or beyond the bounds.
        OSError, yaml.YAMLError: it is not there or cannot be read; it is no YAML, or a key stands twice.
    """
    bounds = bounds or Bounds()
    check_regular(path)
    if (size := path.stat().st_size) > bounds.size:
        raise UserError(f"{path} holds {size} bytes, more than {bounds.size}: is it the right file?")
    content = path.read_bytes()
    _check_bounds(content, path, bounds)
    loader = _UniqueKeys(content)
    try:
        return loader.get_single_data()
    finally:
        loader.dispose()


def _check_bounds(content: bytes, path: Path, bounds: Bounds) -> None:
    """Refuse content that would take too long, or too deep a stack, to build or to walk through."""
    sizes: dict[str, int] = {}  # nodes behind each anchor
    open_collections: list[tuple[str | None, int]] = []  # anchor, and nodes up to there
    nodes = 0
    for event in yaml.parse(content, Loader=_SafeLoader):
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
