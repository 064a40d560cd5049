"""Pictures of a simulation measured on a recording."""

from pathlib import Path

from swarmtwin.dynamics.error_plots import scatter_figure
from swarmtwin.simulation.evaluation_folder import OPEN_LOOP, load_one_step
from swarmtwin.simulation.open_loop_plots import runs_figure
from swarmtwin.simulation.open_loop_storage import load_open_loop


def draw_evaluation(made: Path, output: Path) -> None:
    """Draw into `output` what `swarmtwin evaluate` left in `made`: whole runs, and displacements one by one.

    Raises:
        UserError: the runs are missing or damaged.
    """
    runs_figure(*load_open_loop(made / OPEN_LOOP)).savefig(output / "runs.png")
    scatter_figure(*load_one_step(made)).savefig(output / "scatter.png")
