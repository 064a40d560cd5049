"""`hydra/launcher=ray`: the runs of a sweep as jobs of a Ray cluster, by joblib's Ray backend."""

import os
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from hydra.core.utils import JobReturn
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig

from swarmtwin.errors import UserError
from swarmtwin.extras import install_command

PASSED_ON = ("SWARMTWIN_", "MLFLOW_", "DVC_", "OMP_NUM_THREADS")
"""How variables begin that a run needs on whichever machine: where plug-ins and runs are, and of which sweep it is."""


class RayLauncher(Launcher):
    """Runs each job of a sweep in the folder that the sweep was called in, on any machine of the cluster.

    Attributes:
        address: of the cluster; None: one on this machine, as long as the sweep lasts.
        n_jobs: runs at a time; −1: as many as the cluster has cores.
    """

    def __init__(self, address: str | None, n_jobs: int) -> None:
        self.address = address
        self.n_jobs = n_jobs

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Take what Hydra gives every launcher."""
        self.hydra_context, self.task_function, self.config = hydra_context, task_function, config

    def launch(self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int) -> Sequence[JobReturn]:
        """Run all jobs, and return what each came to, in their order.

        Raises:
            UserError: Ray is not installed.
        """
        if find_spec("ray") is None:
            raise UserError(f"hydra/launcher=ray needs Ray, which is not installed here: {install_command('ray')}")
        import joblib
        import ray
        from hydra.core.singleton import Singleton
        from hydra_plugins.hydra_joblib_launcher._core import execute_job
        from ray.util.joblib import register_ray

        Path(str(self.config.hydra.sweep.dir)).mkdir(parents=True, exist_ok=True)
        told = {name: value for name, value in os.environ.items() if name.startswith(PASSED_ON)}
        shared = (self.hydra_context, self.config, self.task_function, Singleton.get_state())
        jobs = [
            joblib.delayed(_run_there)(Path.cwd(), told, execute_job, initial_job_idx + index, list(overrides), *shared)
            for index, overrides in enumerate(job_overrides)
        ]
        register_ray()
        ray.init(address=self.address, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
        try:
            with joblib.parallel_backend("ray", n_jobs=self.n_jobs):
                return joblib.Parallel(n_jobs=self.n_jobs, batch_size=1)(jobs)
        finally:
            ray.shutdown()


def _run_there(folder: Path, environment: Mapping[str, str], execute: Callable[..., JobReturn], *job: Any) -> JobReturn:
    """Run a job in a folder and with environment variables as where the sweep was called."""
    os.chdir(folder)
    os.environ.update(environment)
    return execute(*job)
