"""Runs the cases of the study on all cores; one that was interrupted goes on where it stopped."""

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from swarmtwin.commands.experiments.hidden_effects_cases import Case, Plan
from swarmtwin.commands.experiments.hidden_effects_examination import examine
from swarmtwin.commands.experiments.hidden_effects_results import Result, append_result, read_results
from swarmtwin.commands.experiments.hidden_effects_sessions import reference_session
from swarmtwin.gap.reference import Reference
from swarmtwin.processes import Report, run_side_by_side
from swarmtwin.robot import Robot, StrictModel
from swarmtwin.trainer import one_thread

BATCH = 16
"""Most cases that one process examines against one reference."""


class ReferenceOptions(StrictModel):
    """How much the simulation is learned from."""

    runs: int
    steps: int


@dataclass(frozen=True)
class Batch:
    """Cases that are compared with the same reference."""

    robot: Robot
    plan: Plan
    options: ReferenceOptions
    number: int
    cases: tuple[Case, ...]
    with_baselines: bool

    @property
    def seed(self) -> int:
        """The reference's seed."""
        return int(self.plan.rng("reference", self.robot.name, self.number).integers(2**31))

    def run(self, report: Report | None) -> None:
        """Learn the reference and examine all cases; each result is reported as soon as it is there."""
        with one_thread(), _quiet():
            reference = learned_reference(self.robot, self.options, self.seed)
            for case in self.cases:
                result = examine(case, self.robot, reference, self.with_baselines)
                if report:
                    report(result)


@contextmanager
def _quiet() -> Iterator[None]:
    """Leave out the count of each session's transitions."""
    logger = logging.getLogger("swarmtwin.transitions")
    level = logger.level
    logger.setLevel(logging.WARNING)
    try:
        yield
    finally:
        logger.setLevel(level)


def learned_reference(robot: Robot, options: ReferenceOptions, seed: int) -> Reference:
    """Learn the simulation of vehicle 1 from a session with nothing wrong."""
    recorded = reference_session(robot, options.runs, options.steps, seed)
    return Reference.learn(recorded.transitions, recorded.recording.header.arena_mm, seed)


def run_cases(
    cases: Sequence[Case],
    robots: Sequence[Robot],
    plan: Plan,
    options: ReferenceOptions,
    with_baselines: bool,
    results_file: Path,
    advance: Callable[[int], None],
    processes: int | None,
) -> list[Result]:
    """Examine the cases that `results_file` does not know yet, and return the results of all, in order.

    Args:
        cases: of the study.
        robots: that they are about.
        plan: that they were drawn from.
        options: of the references.
        with_baselines: whether the other methods work on them as well.
        results_file: where each result is kept as soon as it is there.
        advance: called with how many cases are done.
        processes: how many at a time; null: one a core.
    """
    known = read_results(results_file, cases)
    advance(len(known))
    missing = [case for case in cases if case.key not in known]
    batches = list(_batches(missing, robots, plan, options, with_baselines))

    def keep(result: Result) -> None:
        append_result(results_file, result)
        known[result.case.key] = result
        advance(1)

    run_side_by_side(batches, keep, processes, preload=__name__)
    return [known[case.key] for case in cases]


def _batches(
    cases: Sequence[Case],
    robots: Sequence[Robot],
    plan: Plan,
    options: ReferenceOptions,
    with_baselines: bool,
) -> Iterator[Batch]:
    for robot in robots:
        for number in range(plan.references):
            own = [case for case in cases if case.robot == robot.name and case.reference == number]
            for first in range(0, len(own), BATCH):
                yield Batch(robot, plan, options, number, tuple(own[first : first + BATCH]), with_baselines)
