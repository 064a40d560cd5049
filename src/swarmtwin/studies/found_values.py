"""What a search for hyper-parameters found, as configurations to go on with, and pictures of how it went."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import optuna
import yaml

from swarmtwin.files import write_text
from swarmtwin.learning.tuning import Range, complete_trials, trials_done
from swarmtwin.studies.search_plots import search_figures
from swarmtwin.transitions import Preparation


def configuration_word(study: str) -> str:
    """Return the word by which a study's configurations are chosen: its name, without what options cannot hold."""
    return re.sub(r"\W+", "_", study, flags=re.ASCII)


def save_found(
    folder: Path,
    study: optuna.Study,
    options: Mapping[str, dict[str, Any]],
    space: Mapping[str, Range],
    preparation: Preparation,
) -> None:
    """Write `<group>/<study>.yaml` for each group that was searched in, and pictures, into a folder for --config-dir.

    Args:
        folder: made where it is missing; files of an earlier call are replaced.
        study: with at least one trial that gave a loss.
        options: all options of each group, the best values put in.
        space: what was searched.
        preparation: what was learned from.
    """
    word = configuration_word(study.study_name)
    for group in sorted({name.partition(".")[0] for name in space}):
        content = dict(options[group])
        if group == "recipe":  # the others' names say what they are configurations of
            content["name"] = word
        text = yaml.safe_dump(content, sort_keys=False)
        (folder / group).mkdir(parents=True, exist_ok=True)
        write_text(folder / group / f"{word}.yaml", _origin(study, space, preparation) + text)
    for name, figure in search_figures(study).items():
        figure.savefig(folder / f"{name}.png")


def _origin(study: optuna.Study, space: Mapping[str, Range], preparation: Preparation) -> str:
    """Say in comment lines which study found the values below them."""
    best = study.best_trial
    searched = "; ".join(f"{name} {found}" for name, found in space.items())
    seen = " ".join(preparation.recording.split())
    return (
        f"# Found by study {study.study_name} on recording {seen} ({preparation.digest[:12]}): trial {best.number} of "
        f"{trials_done(study)}, of which {len(complete_trials(study))} were not broken off or failed;\n"
        f"# its loss on validation runs {study.best_value:.6g}. Searched: {searched}.\n"
    )
