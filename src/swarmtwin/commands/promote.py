"""`swarmtwin promote`: the gate that a registered model passes to become the champion, and the way back."""

import shlex
from pathlib import Path
from typing import Annotated, Any

from hydra.core.hydra_config import HydraConfig
from pydantic import Field
from rich.console import Console

from swarmtwin.errors import UserError
from swarmtwin.policies.policy_folder import TaskName
from swarmtwin.robot import Robot, StrictModel
from swarmtwin.studies.promotion import PolicyGate, promote, roll_back
from swarmtwin.tracking.models import ModelKind


class Options(StrictModel):
    """Options of `swarmtwin promote`; their defaults stand in conf/promote.yaml."""

    robot: Robot
    what: ModelKind
    candidate: Annotated[str, Field(coerce_numbers_to_str=True)]
    recording: Path
    baseline: Path | None
    task: TaskName
    policy_gate: PolicyGate
    rollback: bool


def run(options: Options) -> dict[str, Any]:
    """Promote the candidate or refuse it, saying why; or roll back; return what was answered.

    Raises:
        RefusedError: the gate refuses.
        UserError: there is no such candidate, nothing to measure it on, or no champion before.
    """
    if options.what == "dynamics" and options.task.name is not None:
        raise UserError("task=... is of policies: leave it out, or add what=policy")
    if options.rollback:
        answer = roll_back(options.what, options.robot, options.task.name)
    else:
        answer = promote(
            options.what,
            options.candidate,
            options.robot,
            options.recording,
            options.baseline,
            options.task.name,
            options.policy_gate,
            _command(),
        )
    Console().print(answer, highlight=False)
    return {"output": answer}


def _command() -> str | None:
    """Return the command as it was typed; None where `run` is called by other code."""
    if not HydraConfig.initialized():
        return None
    return shlex.join(["swarmtwin", "promote", *HydraConfig.get().overrides.task])
