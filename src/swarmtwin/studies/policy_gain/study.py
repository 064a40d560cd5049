"""`swarmtwin experiment name=policy_gain`: what a policy gains if it goes on learning in the extended simulation."""

import json
import shutil
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
from rich.console import Console

from swarmtwin.diagnosis.result import DiagnosisResult
from swarmtwin.diagnosis.saved_diagnosis import RESIDUALS
from swarmtwin.errors import UserError
from swarmtwin.files import CHECKPOINTS, check_output, new_folder, write_text
from swarmtwin.learning.parallel import run_side_by_side
from swarmtwin.learning.progress_bars import stage_bar
from swarmtwin.policies.algorithm import AlgorithmConfig, algorithm_config
from swarmtwin.policies.initial_policy import InitialPolicy
from swarmtwin.policies.rollout_comparison import check_count
from swarmtwin.standin.effects import parse_effects
from swarmtwin.standin.session import require_stand_in
from swarmtwin.studies.policy_gain.diagnosed_robots import AS_LEARNED, FamilyDiagnosis, extension_of
from swarmtwin.studies.policy_gain.options import Options
from swarmtwin.studies.policy_gain.table import draw_gains, gain_table
from swarmtwin.studies.policy_gain.trials import Trial, Trials
from swarmtwin.studies.reality_gap.learned_policies import Candidate, Learned, learn_in, load_candidate
from swarmtwin.studies.stand_in_families import Family, chosen_families, live_vehicles_of
from swarmtwin.tracking.runs import TrackedRun, tracked_run
from swarmtwin.world.motion import Motion
from swarmtwin.world.task import task_config

NOTHING, BEGUN = "nothing", "begun"
QUANTITIES = ("success", "reward")


def run(options: Options) -> dict[str, Any]:
    """Record, diagnose, learn and try; save tables, policies and the picture; return mean successes and gains.

    Raises:
        UserError: a robot without a stand-in or a family that there is not, an effect that makes no sense, too few
            vehicles or roll-outs, or the output is taken.
    """
    settings = options.model_dump(mode="json")
    check_output(options.output, "experiment", options.overwrite)
    algorithm, families = _checked(options)
    title = f"What policies gain by extended simulations: {options.robot.name}, task {options.task['name']}"
    with (
        new_folder(options.output, "experiment", settings, options.overwrite, resumable=True) as folder,
        tracked_run("transfer", "policy gain", settings, seed=options.seed) as tracked,
    ):
        work = folder / CHECKPOINTS / "simulations"
        _diagnose(options, families, work)
        lines: list[dict[str, Any]] = []
        trials: list[pd.DataFrame] = []
        found: dict[tuple[str, str], str] = {}
        for family in families:
            tried = _FamilyTrials(options, algorithm, family, work / family, folder)
            lines += tried.lines
            trials += tried.trials
            found |= {(family, name): said for name, said in tried.found.items()}
        shutil.copytree(work, folder / "simulations", ignore=shutil.ignore_patterns(RESIDUALS))
        table = pd.DataFrame(lines)
        table.to_csv(folder / "table.csv", index=False, float_format="%.5f")
        pd.concat(trials).to_csv(folder / "trials.csv", index=False)
        shown = gain_table(title, table, found)
        write_text(folder / "report.md", f"# {shown.markdown().removeprefix('## ')}\n![successes](gains.png)\n")
        write_text(folder / "metrics.json", json.dumps(_metrics(lines, found), indent=1) + "\n")
        draw_gains(folder, folder)
        headline = _track(tracked, table)
        tracked.folder(folder, "policy_gain")
    Console().print(shown.drawn())
    Console().print(f"tables, policies and the picture: {options.output}", highlight=False, soft_wrap=True)
    return {**headline, "output": str(options.output)}


def _checked(options: Options) -> tuple[AlgorithmConfig, tuple[Family, ...]]:
    check_count(options.rollouts)
    require_stand_in(options.robot)
    families = chosen_families(options.families)
    asked = task_config(options.task, "task").build(options.robot, options.robot.arena_mm).vehicles
    if len(options.vehicles) < asked:
        raise UserError(f"vehicles are {len(options.vehicles)}, the task is for {asked}: give {asked} ids or more")
    for name, effects in options.hidden.items():
        if name in (AS_LEARNED, NOTHING, BEGUN):
            raise UserError(f"hidden: {name!r} names what is compared with: give it another name")
        parsed = parse_effects(effects, options.robot, asked)
        for family in families:
            live_vehicles_of(family)(options.robot, options.vehicles[:asked], 1, 0, parsed)
    return algorithm_config(options.policy, "policy"), families


def _diagnose(options: Options, families: Sequence[Family], work: Path) -> None:
    jobs = [FamilyDiagnosis(family, options, work / family) for family in families]
    done: list[str] = []
    total = len(jobs) * len(options.hidden)
    with stage_bar("recording and diagnosing") as bar:
        bar("robots", 0, total)

        def report(family: str, name: str) -> None:
            done.append(name)
            bar(f"{family}: {name}", len(done), total)

        run_side_by_side(jobs, report, options.processes)


class _FamilyTrials:
    """The policies of a family's simulations, learned and tried on its robots.

    All begin in the simulation as it was; each seed then goes on for as long again, in that one or in an extended one.

    Attributes:
        lines: of table.csv.
        trials: of trials.csv.
        found: what the diagnosis said, by what was hidden.
    """

    def __init__(self, options: Options, algorithm: AlgorithmConfig, family: Family, work: Path, output: Path) -> None:
        self._options, self._algorithm, self._family, self._output = options, algorithm, family, output
        self.trials: list[pd.DataFrame] = []
        self.found: dict[str, str] = {}
        self._start_from: dict[int, InitialPolicy] = {}
        _, begun = self._learned(BEGUN, work / AS_LEARNED)
        self._start_from = {
            result.seed: InitialPolicy(f"{family} {BEGUN}, seed {result.seed}", result.weights)
            for result in begun.seeds
            if result.weights
        }
        before = self._learned(AS_LEARNED, work / AS_LEARNED)
        self.lines = [self._line(NOTHING, self._tried(NOTHING, AS_LEARNED, before), None)]
        for name in options.hidden:
            extended, diagnosis = extension_of(work, name)
            self.found[name] = _said(diagnosis)
            as_learned = self._tried(name, AS_LEARNED, before)
            after = self._learned(name, extended) if extended else None
            self.lines.append(self._line(name, as_learned, self._tried(name, "extended", after) if after else None))

    def _learned(self, name: str, simulation: Path) -> tuple[Candidate, Learned]:
        candidate = load_candidate(f"{self._family} {name}", str(simulation), self._options)
        return candidate, learn_in(candidate, self._options, self._output, self._start_from)

    def _tried(self, hidden: str, learned_in: str, policies: tuple[Candidate, Learned]) -> Trials | None:
        candidate, learned = policies
        options, task = self._options, candidate.task
        effects = parse_effects(options.hidden.get(hidden, ()), options.robot, task.vehicles)
        motion: Callable[[], Motion] = partial(
            live_vehicles_of(self._family),
            options.robot,
            options.vehicles[: task.vehicles],
            options.rollouts,
            options.seed,
            effects,
            planned_steps=task.steps,
        )
        trial = Trial(task, self._algorithm, motion, options.rollouts, options.seed)
        trials = Trials.of(learned.seeds, trial, options.processes)
        if trials:
            rows = pd.DataFrame(trials.rows())
            about = {"family": self._family, "hidden": hidden, "simulation": learned_in}
            self.trials.append(rows.assign(**about)[[*about, *rows.columns]])
        return trials

    def _line(self, hidden: str, before: Trials | None, after: Trials | None) -> dict[str, Any]:
        line: dict[str, Any] = {"family": self._family, "hidden": hidden}
        for quantity in QUANTITIES:
            figures = {
                f"before_{quantity}": before.mean(quantity) if before else None,
                f"after_{quantity}": after.mean(quantity) if after else None,
                f"{quantity}_gain": after.gain(quantity, before) if after and before else None,
            }
            for name, figure in figures.items():
                value, low, high = figure or (float("nan"),) * 3
                line |= {name: value, f"{name}_low": low, f"{name}_high": high}
        return line


def _said(diagnosis: DiagnosisResult) -> str:
    return "\n".join(cause.name.replace("_", " ") for cause in diagnosis.causes) or diagnosis.verdict.replace("_", " ")


def _metrics(lines: Sequence[dict[str, Any]], found: dict[tuple[str, str], str]) -> dict[str, Any]:
    """Return table.csv as plain data: by family, then by what was hidden; null where nothing was tried."""
    metrics: dict[str, Any] = {}
    for line in lines:
        family, hidden = line["family"], line["hidden"]
        known = {name: None if value != value else value for name, value in line.items()}
        metrics.setdefault(family, {})[hidden] = {**known, "found": found.get((family, hidden))}
    return metrics


def _track(tracked: TrackedRun, table: pd.DataFrame) -> dict[str, float]:
    """Track each family's figures; return their means over all that is hidden."""
    hidden = table[table.hidden != NOTHING]
    names = ("before_success", "after_success", "success_gain", "reward_gain")
    for row in table.to_dict("records"):
        known = {name: row[name] for name in names if row[name] == row[name]}
        tracked.metrics({f"{row['family']}/{row['hidden']}/{name}": value for name, value in known.items()})
    return {name: float(hidden[name].mean()) for name in names}
