"""What Hydra calls at both ends of a sweep; it is loaded with every command, and MLflow only with a sweep."""

import atexit
from typing import TYPE_CHECKING, Any

from hydra.experimental.callback import Callback
from omegaconf import DictConfig

if TYPE_CHECKING:
    from swarmtwin.tracking.runs import Experiment


class SweepCallback(Callback):
    """Gives the runs of a Hydra sweep one parent run in the experiment of their command."""

    def __init__(self, experiment: "Experiment") -> None:
        self.experiment = experiment

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Open the parent before the first run starts; should the sweep break off, it is closed as failed."""
        from swarmtwin.tracking.runs import close_parent, open_parent

        name = " ".join(config.hydra.overrides.task) or "sweep"
        self.run_id = open_parent(self.experiment, name[:250], "sweep")
        atexit.register(close_parent, self.run_id, "FAILED")

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Close the parent after the last run ended."""
        from swarmtwin.tracking.runs import close_parent

        atexit.unregister(close_parent)
        close_parent(self.run_id, "FINISHED")
