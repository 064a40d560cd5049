"""`swarmtwin promote`: the gate that a registered model passes to become the champion, and the way back."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field
from rich.console import Console

from swarmtwin.robot import Robot, StrictModel
from swarmtwin.studies.promotion import ModelKind, PolicyGate, promote
from swarmtwin.tracking import registry


class Options(StrictModel):
    """Options of `swarmtwin promote`; their defaults stand in conf/promote.yaml."""

    robot: Robot
    what: ModelKind
    candidate: Annotated[str, Field(coerce_numbers_to_str=True)]
    recording: Path
    policy_gate: PolicyGate
    rollback: bool


def run(options: Options) -> dict[str, Any]:
    """Promote the candidate or refuse it, saying why; or roll back; return what was answered.

    Raises:
        RefusedError: the gate refuses.
        UserError: there is no such candidate, nothing to measure it on, or no champion before.
    """
    if options.rollback:
        name = f"{options.robot.name}-{options.what}"
        demoted, restored = registry.roll_back(name)
        answer = f"{name}: version {restored} is champion again, version {demoted} no longer"
    else:
        answer = promote(options.what, options.candidate, options.robot, options.recording, options.policy_gate)
    Console().print(answer, highlight=False)
    return {"output": answer}
