"""`swarmtwin experiment name=pictures`: draws what other commands computed, from the folders that they left."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from rich.console import Console

from swarmtwin.diagnosis.report.page import draw_diagnosis
from swarmtwin.dynamics.error_plots import draw_training
from swarmtwin.errors import UserError
from swarmtwin.files import PROVENANCE, new_folder, read_provenance
from swarmtwin.generators.quality_plots import draw_synthesis
from swarmtwin.policies.reward_plots import draw_learning
from swarmtwin.policies.rollout_plots import draw_rollout
from swarmtwin.robot import StrictModel
from swarmtwin.simulation.evaluation_plots import draw_evaluation
from swarmtwin.studies.dynamics.comparison_plots import draw_comparison
from swarmtwin.studies.reality_gap.gap_plots import draw_gaps
from swarmtwin.studies.synthetic.error_plots import draw_cases
from swarmtwin.studies.training_grid.grid_plots import draw_grid
from swarmtwin.studies.transfer.transfer_plots import draw_transfer
from swarmtwin.tracking.runs import keep_with_run
from swarmtwin.transitions.displacement_plots import draw_preparation

DRAWINGS: dict[str, Callable[[Path, Path], None]] = {
    "prepare": draw_preparation,
    "generate": draw_synthesis,
    "train": draw_training,
    "learn": draw_learning,
    "evaluate": draw_evaluation,
    "rollout": draw_rollout,
    "diagnose": draw_diagnosis,
    "experiment dynamics": draw_comparison,
    "experiment synthetic": draw_cases,
    "experiment transfer": draw_transfer,
    "experiment table5": draw_gaps,
    "experiment table6": draw_gaps,
    "experiment training_grid": draw_grid,
}
"""What draws the output of a command; each is given that folder and one to draw into."""


class Options(StrictModel):
    """Options; their defaults stand in conf/experiment/pictures.yaml."""

    name: Literal["pictures"]
    folder: Path
    output: Path
    overwrite: bool


def run(options: Options) -> dict[str, Any]:
    """Draw what one command left, or what several left in one folder, and keep it with their runs; return where.

    Raises:
        UserError: there is nothing that can be drawn, a file of it is missing or damaged, or the output is taken.
    """
    drawings = {folder: _drawing(folder) for folder in _made_folders(options.folder)}
    settings = options.model_dump(mode="json")
    with new_folder(options.output, "experiment", settings, options.overwrite, inputs=[options.folder]) as output:
        for folder, draw in drawings.items():
            place = output / folder.relative_to(options.folder)
            place.mkdir(exist_ok=True)
            draw(folder, place)
            keep_with_run(folder, place)
    Console().print(f"pictures: {options.output}", highlight=False, soft_wrap=True)
    return {"output": str(options.output)}


def _made_folders(folder: Path) -> list[Path]:
    """Return a folder that swarmtwin made, or those in it."""
    if (folder / PROVENANCE).exists():
        return [folder]
    found = sorted(file.parent for file in folder.glob(f"*/{PROVENANCE}"))
    if not found:
        raise UserError(f"{folder} holds no output of swarmtwin: name a folder that one of its commands left")
    return found


def _drawing(folder: Path) -> Callable[[Path, Path], None]:
    """Return what draws a folder, by the command that made it."""
    command, options = read_provenance(folder)
    made_by = f"experiment {options.get('study', options['name'])}" if command == "experiment" else command
    if made_by not in DRAWINGS:
        raise UserError(f"{folder} was made by swarmtwin {made_by}, of which there are no pictures: leave it out")
    return DRAWINGS[made_by]
