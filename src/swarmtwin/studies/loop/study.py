"""`swarmtwin experiment name=loop`: deploy, record, diagnose, extend, learn, judge, promote, deploy again."""

import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

import pandas as pd
import yaml
from pydantic import BeforeValidator, Field
from rich.console import Console

from swarmtwin.deploy.fleet.fleet import Fleet, FleetSettings
from swarmtwin.deploy.link.embedded_broker import EmbeddedBroker
from swarmtwin.errors import UserError
from swarmtwin.files import write_text
from swarmtwin.plain_yaml import read_yaml
from swarmtwin.robot import Positive, Robot, Seed, StrictModel
from swarmtwin.studies.loop.table import Stage, loop_table
from swarmtwin.transitions.inputs import as_texts

Count = Annotated[int, Field(ge=1)]


class Options(StrictModel):
    """Options; their defaults stand in conf/experiment/loop.yaml."""

    name: Literal["loop"]
    robot: Robot
    effects: str
    vehicles: Annotated[tuple[str, ...], BeforeValidator(as_texts), Field(min_length=1)]
    first_policy: Path
    simulation: Path
    reference: Path
    deployments: Count
    collect_runs: Count
    collect_steps: Count
    learn_steps: Count
    learn_seeds: Count
    least_success: Annotated[float, Field(ge=0, le=1)]
    firmware_timeout_s: Positive | None
    age_s: Positive
    seed: Seed
    output: Path


def run(options: Options) -> dict[str, Any]:
    """Go through the loop, going on where it was interrupted; save and show the table, return success before and after.

    Raises:
        UserError: a command answers so, or the diagnosis found nothing to extend the simulation by.
    """
    output = options.output
    output.mkdir(parents=True, exist_ok=True)
    extended, learned = output / "diagnosis" / "simulation", output / "policy"
    stages = [
        Stage(name="before", words="as learned", policy=str(options.first_policy), simulation=options.simulation),
        Stage(
            name="told", words="as learned, extended simulation", policy=str(options.first_policy), simulation=extended
        ),
        Stage(name="after", words="learned anew, extended simulation", policy=str(learned), simulation=extended),
    ]
    with _fleet(options) as fleet:
        _deploy(options, fleet, stages[0])
        _collect(options, fleet)
        _diagnose(options)
        _deploy(options, fleet, stages[1])
        _learn(options, extended, learned)
        _deploy(options, fleet, stages[2])
        is_champion = _promote(options, learned)
        champion = Stage(
            name="champion",
            words="the champion",
            policy=f"models:/{options.robot.name}-policy@champion",
            simulation=extended,
        )
        if is_champion:
            _deploy(options, fleet, champion, count=1)
    table = pd.DataFrame([row for stage in stages for row in _rows(options, stage)])
    table.to_csv(output / "deployments.csv", index=False)
    diagnosis = json.loads((output / "diagnosis" / "diagnosis.json").read_text())
    summary = _summary(table, stages, diagnosis)
    write_text(output / "metrics.json", json.dumps(summary, indent=1) + "\n")
    Console().print(loop_table(options.robot.title, stages, table, diagnosis))
    success = table.groupby("stage")["success"].mean()
    return {
        "success_before": float(success["before"]),
        "success_after": float(success["after"]),
        "output": str(output),
    }


class _RunningFleet:
    """A fleet and the address of its broker."""

    def __init__(self, fleet: Fleet, address: str, age_s: float) -> None:
        self.fleet = fleet
        ages = (f"safety.pose_age_s={age_s}", f"safety.picture_age_s={age_s}")
        self.arguments = (f"broker={address}", f"camera={fleet.camera_url}", "page.show=false", *ages)

    def place(self, seed: int) -> None:
        """Put the vehicles where this seed draws them."""
        self.fleet.place(self.fleet.draw_start(seed))


@contextmanager
def _fleet(options: Options) -> Iterator[_RunningFleet]:
    """Switch on a fleet that does what nobody else is told."""
    effects = _parsed(options.effects)
    settings = FleetSettings(
        effects=effects, seed=options.seed, firmware_timeout_s=options.firmware_timeout_s, session_s=3600.0
    )
    with (
        EmbeddedBroker(port=0) as broker,
        Fleet(options.robot, options.vehicles, broker.broker, 0, settings) as fleet,
    ):
        yield _RunningFleet(fleet, broker.broker.address, options.age_s)


def _parsed(effects: str) -> tuple[dict[str, Any], ...]:
    try:
        content = yaml.safe_load(effects)
    except yaml.YAMLError:
        content = None
    if not isinstance(content, list) or not all(isinstance(one, dict) for one in content):
        raise UserError(f"effects={effects!r} is no list of effects: effects='\"[{{name: battery_sag, loss: 0.3}}]\"'")
    return tuple(content)


def _deploy(options: Options, running: _RunningFleet, stage: Stage, count: int | None = None) -> None:
    for number in range(1, 1 + (count or options.deployments)):
        folder = options.output / "deployments" / stage.name / f"{number:02}"
        if (folder / "metrics.json").exists():
            continue
        running.place(1000 * options.seed + number)
        _swarmtwin(
            "deploy",
            f"robot={options.robot.name}",
            f"policy={stage.policy}",
            f"simulation={stage.simulation}",
            f"vehicles=[{','.join(options.vehicles)}]",
            *running.arguments,
            f"seed={number}",
            "compare=0",
            f"output={folder}",
            may_refuse=True,
        )


def _collect(options: Options, running: _RunningFleet, tries: int = 3) -> None:
    """Record the fleet; a recording that a safety stop cut short is laid aside, and another begun."""
    folder = options.output / "recording"
    for number in range(1, tries + 1):
        if folder.exists():
            return
        running.place(options.seed)
        status = _swarmtwin(
            "collect",
            f"robot={options.robot.name}",
            f"vehicles=[{','.join(options.vehicles)}]",
            f"runs={options.collect_runs}",
            f"steps={options.collect_steps}",
            *running.arguments,
            f"output={folder}",
            may_refuse=number < tries,
        )
        if status:
            folder.rename(folder.with_name(f"recording-stopped-{number}"))


def _diagnose(options: Options) -> None:
    folder = options.output / "diagnosis"
    if not folder.exists():
        _swarmtwin(
            "diagnose",
            f"robot={options.robot.name}",
            f"simulation={options.simulation}",
            f"reference={options.reference}",
            f"measured={options.output / 'recording'}",
            "register=false",
            f"output={folder}",
        )
    if not (folder / "simulation").exists():
        raise UserError(
            f"the diagnosis extends nothing (see {folder / 'report.html'}): collect more, or another effect"
        )


def _learn(options: Options, simulation: Path, folder: Path) -> None:
    if not folder.exists():
        _swarmtwin(
            "learn",
            f"robot={options.robot.name}",
            "task=collective",
            f"simulation={simulation}",
            f"policy.steps={options.learn_steps}",
            f"seeds={options.learn_seeds}",
            "register=false",
            f"output={folder}",
        )


def _promote(options: Options, policy: Path) -> bool:
    """Ask the gate; return whether the policy is the champion now."""
    done = sorted((options.output / "deployments" / "after").iterdir())
    status = _swarmtwin(
        "promote",
        f"robot={options.robot.name}",
        "what=policy",
        f"candidate={policy}",
        f"policy_gate.deployments=[{','.join(map(str, done))}]",
        f"policy_gate.fewest_deployments={len(done)}",
        f"policy_gate.least_success={options.least_success}",
        may_refuse=True,
    )
    return status == 0


def _swarmtwin(*arguments: str, may_refuse: bool = False) -> int:
    """Show a command and run it; return its status, 0 or, where it may answer "no", 3.

    Raises:
        UserError: it answers with a mistake, or "no" where it may not.
    """
    Console().print(f"\n$ swarmtwin {' '.join(arguments)}", highlight=False, soft_wrap=True, style="bold", markup=False)
    status = subprocess.run([sys.executable, "-m", "swarmtwin", *arguments], check=False).returncode
    if status == 130:
        raise KeyboardInterrupt("the same command goes on")
    if status and not (may_refuse and status == 3):
        raise UserError(f"swarmtwin {arguments[0]} ended with status {status}: see above; the same command goes on")
    return status


def _rows(options: Options, stage: Stage) -> list[dict[str, Any]]:
    """Return one row for each deployment of a stage."""
    rows = []
    for folder in sorted((options.output / "deployments" / stage.name).iterdir()):
        metrics = json.loads((folder / "metrics.json").read_text())
        control, robots = metrics["control"], metrics.get("robots") or {}
        about = read_yaml(folder / "deployment.yaml")
        rows.append(
            {
                "stage": stage.name,
                "deployment": folder.name,
                "success": bool(robots.get("success")) and control["ending"] == "done",
                "reward": robots.get("reward"),
                "collision": bool(robots.get("collision")),
                "reach_time_s": robots.get("reach_time_s"),
                "periods": control["periods"],
                "weakened": control["interventions"],
                "alarms": sum(control["alarms"].values()),
                "ending": control["ending"],
                "reason": control["reason"],
                "policy_digest": about["policy"]["digest"],
            }
        )
    return rows


def _summary(table: pd.DataFrame, stages: Sequence[Stage], diagnosis: dict[str, Any]) -> dict[str, Any]:
    by_stage = table.groupby("stage")
    return {
        "causes": diagnosis["causes"],
        "stages": {
            stage.name: {
                "deployments": len(by_stage.get_group(stage.name)),
                "success": float(by_stage.get_group(stage.name)["success"].mean()),
                "reward": float(by_stage.get_group(stage.name)["reward"].mean()),
            }
            for stage in stages
        },
    }
