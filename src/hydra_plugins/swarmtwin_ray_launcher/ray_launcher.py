"""`hydra/launcher=ray`: the runs of a sweep as jobs of a Ray cluster, by joblib's Ray backend."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from hydra.core.utils import JobReturn
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig

from swarmtwin.learning.ray_cluster import CalledFrom, ray_cluster


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
            UserError: Ray is not installed, or no cluster answers.
        """
        with ray_cluster(self.address, "hydra/launcher=ray"):
            import joblib
            from hydra.core.singleton import Singleton
            from hydra_plugins.hydra_joblib_launcher._core import execute_job
            from ray.util.joblib import register_ray

            Path(str(self.config.hydra.sweep.dir)).mkdir(parents=True, exist_ok=True)
            shared = (self.hydra_context, self.config, self.task_function, Singleton.get_state())
            jobs = [
                joblib.delayed(_run_there)(CalledFrom.here(), execute_job, initial_job_idx + index, list(own), *shared)
                for index, own in enumerate(job_overrides)
            ]
            register_ray()
            with joblib.parallel_backend("ray", n_jobs=self.n_jobs):
                return joblib.Parallel(n_jobs=self.n_jobs, batch_size=1)(jobs)


def _run_there(place: CalledFrom, execute: Callable[..., JobReturn], *job: Any) -> JobReturn:
    """Run a job as where the sweep was called."""
    place.go()
    return execute(*job)
