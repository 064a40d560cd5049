"""How a model is named: by its folder, or by what the registry calls it. Looked at without the registry."""

import re
from pathlib import Path
from typing import NamedTuple, Self

from swarmtwin.errors import UserError


class ModelReference(NamedTuple):
    """The parts of `models:/NAME@ALIAS` or `models:/NAME/VERSION`; one of alias and version is None."""

    name: str
    alias: str | None
    version: int | None

    @classmethod
    def parse(cls, text: str) -> Self:
        """Take a reference apart.

        Raises:
            UserError: it is malformed.
        """
        parts = re.fullmatch(r"models:/(?P<name>[^/@]+)(@(?P<alias>[^/@]+)|/(?P<version>\d+))", text)
        if not parts:
            raise UserError(f"{text!r} names no model: write models:/NAME@ALIAS or models:/NAME/VERSION")
        return cls(parts["name"], parts["alias"], int(parts["version"]) if parts["version"] else None)


def named_folder(text: str) -> Path | None:
    """Return the folder that a model is named by; None where it is named as the registry calls it.

    Raises:
        UserError: there is no such folder, or the reference is malformed.
    """
    if text.startswith("models:"):
        ModelReference.parse(text)
        return None
    if not Path(text).is_dir():
        raise UserError(f"no model folder {text}: give a folder, models:/NAME@ALIAS or models:/NAME/VERSION")
    return Path(text)
