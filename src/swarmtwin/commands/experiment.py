"""`swarmtwin experiment name=NAME`: a study, each of them one folder in studies/ and one file in conf/experiment/."""

from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

from swarmtwin.errors import UserError, near_miss


def studies() -> list[str]:
    """Return the names of the studies: the folders of `swarmtwin.studies` that hold a module `study`."""
    folder = Path(str(files("swarmtwin.studies")))
    return sorted(file.parent.name for file in folder.glob("*/study.py"))


def chosen_study(arguments: Sequence[str]) -> str | None:
    """Return the study that `name=...` chooses; None where only help is asked for, and on none of them.

    Raises:
        UserError: none is chosen, or there is no such study.
    """
    known = studies()
    chosen = [argument.partition("=")[2] for argument in arguments if argument.startswith("name=")]
    if not chosen:
        if "--help" in arguments:
            return None
        raise UserError(f"say which: name=..., {near_miss('', known)}")
    if chosen[-1] not in known:
        raise UserError(f"no such experiment: {chosen[-1]!r}: {near_miss(chosen[-1], known)}")
    return chosen[-1]
