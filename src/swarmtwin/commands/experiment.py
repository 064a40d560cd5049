"""`swarmtwin experiment name=NAME`: a file in conf/experiment/, computed by the study, a folder in studies/.

The study has the experiment's name, unless the file names another (`study: training_grid`): several experiments may be
views of one study.
"""

from collections.abc import Sequence

import yaml

from swarmtwin.configuration import config_files
from swarmtwin.errors import UserError, near_miss


def experiments() -> list[str]:
    """Return the names of all experiments: the files in conf/experiment/, here and beside the user's plug-ins."""
    return sorted(config_files("experiment"))


def study_module(experiment: str) -> str:
    """Return the module that computes an experiment."""
    content = yaml.safe_load(config_files("experiment")[experiment].read_text())
    return f"swarmtwin.studies.{content.get('study', experiment)}.study"


def chosen_experiments(arguments: Sequence[str]) -> list[str]:
    """Return the experiment that `name=...` chooses, or the several of a sweep; none where only help is asked for.

    Raises:
        UserError: none is chosen, there is no such experiment, or several are chosen without `-m`.
    """
    known = experiments()
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
