"""Jobs on the machines of a Ray cluster, one on each of its cores."""

import contextlib
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self, TypeVar

from swarmtwin.errors import UserError
from swarmtwin.extras import require_extra

if TYPE_CHECKING:  # Hydra imports its launcher for every command
    from swarmtwin.learning.parallel import Job, Report

PASSED_ON = ("SWARMTWIN_", "MLFLOW_", "DVC_", "OMP_NUM_THREADS")
"""How variables begin that a job needs on whichever machine: where plug-ins and runs are, and of which sweep it is."""

Result = TypeVar("Result")


class CalledFrom(NamedTuple):
    """Where a command was called: its folder, which all machines see, and the variables that jobs need."""

    folder: Path
    environment: Mapping[str, str]

    @classmethod
    def here(cls) -> Self:
        """Return where this process is."""
        return cls(Path.cwd(), {name: value for name, value in os.environ.items() if name.startswith(PASSED_ON)})

    def go(self) -> None:
        """Go there.

        Raises:
            UserError: this machine does not see the folder.
        """
        if not self.folder.is_dir():
            raise UserError(
                f"a machine of the cluster does not see {self.folder}: call the command where all machines see it"
            )
        os.chdir(self.folder)
        os.environ.update(self.environment)


@contextlib.contextmanager
def ray_cluster(address: str | None, what: str) -> Iterator[None]:
    """Connect to a Ray cluster as long as the block lasts.

    Args:
        address: `ray://HOST:10001`, `HOST:6379`, or `auto` on one of its machines; None: one of this machine alone,
            which ends with the block.
        what: needs it, in a message.

    Raises:
        UserError: Ray is not installed, or no cluster answers there.
    """
    require_extra("ray", what)
    import ray

    try:
        ray.init(address=address, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    except (ConnectionError, ValueError, RuntimeError) as error:
        said = " ".join(str(error).split())
        raise UserError(f"{what}: no Ray cluster answers at {address or 'this machine'}: {said[:200]}") from None
    try:
        yield
    finally:
        ray.shutdown()


def run_on_cluster(jobs: "Sequence[Job[Result]]", report: "Report", address: str | None, what: str) -> list[Result]:
    """Run jobs on the cores of a Ray cluster, whose machines have swarmtwin installed as it is here.

    A job that is lost with its machine is run anew on another one.

    Args:
        jobs: in the order of the results.
        report: called in this process with all that a job has reported, when it has ended.
        address: of the cluster, as `ray_cluster` takes it.
        what: the option that asks for it, in a message.

    Raises:
        UserError: as of `ray_cluster`, a machine does not see this folder, or a job was lost again and again.
        Exception: a job or the report raised it.
    """
    with ray_cluster(address, what):
        import ray
        from ray.exceptions import RayError, RayTaskError

        place = CalledFrom.here()
        task = ray.remote(_run_there)
        waiting = {task.remote(job, place): number for number, job in enumerate(jobs)}
        results: dict[int, Result] = {}
        while waiting:
            (ended, *_), _ = ray.wait(list(waiting))
            try:
                reports, results[waiting.pop(ended)] = ray.get(ended)
            except RayTaskError as error:
                raise error.cause from error  # which tells where it was raised there
            except RayError as error:
                raise UserError(f"{what}: a job was lost on the cluster: {type(error).__name__}") from None
            for message in reports:
                report(*message)
    return [results[number] for number in range(len(jobs))]


def _run_there(job: "Job[Result]", place: CalledFrom) -> tuple[list[tuple[Any, ...]], Result]:
    """Run a job as where the command was called; return what it reported, and its result."""
    place.go()
    reports: list[tuple[Any, ...]] = []
    return reports, job.run(lambda *message: reports.append(message))
