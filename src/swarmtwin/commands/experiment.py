"""`swarmtwin experiment name=NAME`: a study, each of them one folder in studies/ and one file in conf/experiment/."""

from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

from swarmtwin.errors import UserError, near_miss


def studies() -> list[str]:
    """Return the names of the studies: the folders of `swarmtwin.studies` that hold a module `study`."""
    folder = Path(str(files("swarmtwin.studies")))
    return sorted(file.parent.name for file in folder.glob("*/study.py"))


def chosen_studies(arguments: Sequence[str]) -> list[str]:
    """Return the study that `name=...` chooses, or the several of a sweep; none where only help is asked for.

    Raises:
        UserError: none is chosen, there is no such study, or several are chosen without `-m`.
    """
    known = studies()
    given = [argument for argument in arguments if argument.startswith("name=")]
    if not given:
        if "--help" in arguments:
            return []
        raise UserError(f"say which: name=..., {near_miss('', known)}")
    chosen = [word.strip() for word in given[-1].partition("=")[2].split(",")]
    for name in chosen:
        if name not in known:
            raise UserError(f"no such experiment: {name!r}: {near_miss(name, known)}")
    if len(chosen) > 1 and not {"-m", "--multirun"} & set(arguments):
        raise UserError(f"{given[-1]} is a sweep: add -m")
    return chosen
