"""What a command is to read, looked at before what computes is imported: torch and MLflow take seconds.

An option names the same kind of thing in every command, so one table says what must be there. What is inside is for
those to judge who read it.
"""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from pydantic import ConfigDict, Field

from swarmtwin.configuration import config_files
from swarmtwin.errors import UserError, near_miss
from swarmtwin.files import PROVENANCE, check_holds, check_regular
from swarmtwin.recordings.reading import look_into
from swarmtwin.robot import Robot, Seed, StrictModel
from swarmtwin.tracking.model_reference import named_folder
from swarmtwin.transitions import SplitOptions
from swarmtwin.transitions.inputs import Vehicles, preparation_of, training_folder
from swarmtwin.transitions.preparation import TRANSITIONS_FILE


class EarlyOptions(StrictModel):
    """The options of all commands that their inputs are judged by; left out where a command has none."""

    model_config = ConfigDict(extra="ignore")

    vehicles: Vehicles = None
    reference_vehicles: Vehicles = None
    split: SplitOptions = Field(default=None)  # type: ignore[assignment]
    seed: Seed = 0
    robot: Robot = Field(default=None)  # type: ignore[assignment]


def check_inputs(command: str, content: Mapping[str, Any]) -> None:
    """Check that all that the options of a command name as inputs is there, and of the kind that it should be.

    Args:
        command: its name.
        content: of its configuration.

    Raises:
        UserError: something is missing, or is another kind of folder or of another robot; or an option that all
            commands share makes no sense.
    """
    options = EarlyOptions.parse({name: value for name, value in content.items() if value is not None}, "options")
    for name in content.get("robots", ()):
        if str(name) not in config_files("robot"):
            raise UserError(f"robots: no such robot: {name!r}: {near_miss(str(name), config_files('robot'))}")
        if "artifacts" in content:
            _check_compared(Path(content["artifacts"]) / "comparison" / str(name))
    for name, named in (content.get("simulations") or {}).items():
        if isinstance(named, str):
            _compared_simulation(str(name), named, options.robot)
    left_out = _check_choice(command, content, options)
    for option, check in INPUTS.items():
        value: Any = content
        for part in option.split("."):
            value = value.get(part) if isinstance(value, Mapping) else None
        for named in value if option in SEVERAL and isinstance(value, list) else [value]:
            if isinstance(named, str) and option not in left_out:
                check(named, options.robot)


def _check_choice(command: str, content: Mapping[str, Any], options: EarlyOptions) -> set[str]:
    """Check that a command which can read this or that is given one of them; return the options that it will not read.

    Raises:
        UserError: it is given neither, and the pipeline has left nothing either.
    """
    if command == "promote":
        registered = str(content["candidate"]).isdigit() or content["candidate"] == "challenger"
        unread = {"candidate": registered or content["rollback"]}
        unread["recording"] = unread["baseline"] = content["rollback"] or content["what"] != "dynamics"
        return {name for name, left_out in unread.items() if left_out}
    if command == "diagnose" and content["reference"] is None and content["simulation"] is None:
        raise UserError("give reference=DIR, a recording in which nothing is wrong, or simulation=FOLDER|models:/...")
    if command == "track" and not Path(content["commands"]).exists():
        columns = ", ".join(("time_s", "vehicle", *options.robot.command_columns))
        raise UserError(f"commands {content['commands']} is missing: name a CSV file with {columns}")
    if command == "learn" and content["simulation"] is None:
        folder = Path("artifacts/dynamics") / options.robot.name / "crnet_synthetic"
        if not folder.is_dir():
            raise UserError(f"no simulation in {folder}: run `dvc repro` first, or give simulation=...")
    if command == "generate" and not content["from"] and options.robot is None:
        raise UserError("say of which robot: robot=..., or give a generator's folder: from=...")
    if command == "rollout" and "simulation" not in content["on"]:
        return {"simulation"}
    if content.get("from"):
        return {"transitions", "recording"}  # which is a mistake that the command explains
    if {"transitions", "recording"} <= content.keys():
        transitions, recording = (content[name] and Path(content[name]) for name in ("transitions", "recording"))
        training_folder(options.robot, transitions, recording, options.vehicles)
    return set()


def _recording(named: str, robot: Robot) -> None:
    look_into(Path(named), robot)


def _transitions(named: str, robot: Robot) -> None:
    if Path(named).is_relative_to("artifacts") and not Path(named).is_dir():
        raise UserError(f"no transitions in {named}: run `dvc repro` first, or give transitions=...")
    preparation_of(Path(named), robot)
    check_holds(Path(named), TRANSITIONS_FILE, "transitions", "prepare")


def _model(named: str, robot: Robot, file: str = "model.yaml", holds: str = "model", made_by: str = "train") -> None:
    if folder := named_folder(named):
        check_holds(folder, file, holds, made_by)
        check_regular(folder / file)
        text = (folder / file).read_text(errors="replace") if (folder / file).is_file() else ""
        found = re.search(r"^robot:\n(?: .*\n)*?  name: (\w+)\n", text, re.MULTILINE)
        if found and found[1] != robot.name:
            raise UserError(f"{folder} is a {holds} of robot {found[1]!r}: add robot={found[1]}")


def _compared_simulation(name: str, named: str, robot: Robot) -> None:
    if Path(named).is_relative_to("artifacts") and not Path(named).is_dir():
        raise UserError(f"no simulation in {named}: run `dvc repro` first, or give simulations.{name}=...")
    _model(named, robot)


def _policy(named: str, robot: Robot) -> None:
    _model(named, robot, "policy.yaml", "policy", "learn")


def _rolled_out_policy(named: str, robot: Robot) -> None:
    if named != "scripted":
        _policy(named, robot)


def _candidate(named: str, robot: Robot) -> None:
    if folder := named_folder(named):
        (_policy if (folder / "policy.yaml").exists() else _model)(named, robot)


def _generator(named: str, robot: Robot | None) -> None:
    check_holds(Path(named), "generator.yaml", "generator", "generate")


def _models(named: str, robot: Robot) -> None:
    if not Path(named).is_dir():
        raise UserError(f"no folder {named} with models: run `dvc repro` first")
    if not any(Path(named).glob("*/model.yaml")):
        raise UserError(f"{named} holds no model folder: run `dvc repro` first")


def _policies(named: str, robot: Robot) -> None:
    if not Path(named).is_dir():
        raise UserError(f"no folder {named} with policies: run `dvc repro` first, or swarmtwin learn")
    if not any(Path(named).glob("*/policy.yaml")):
        raise UserError(f"{named} holds no policy of robot {robot.name!r}: run `dvc repro` first, or swarmtwin learn")


def _check_compared(folder: Path) -> None:
    if not (folder / "table.csv").exists():
        raise UserError(f"{folder} holds no comparison of models: run `dvc repro` first")


def _output(named: str, robot: Robot | None) -> None:
    if not (Path(named) / PROVENANCE).exists() and not any(Path(named).glob(f"*/{PROVENANCE}")):
        raise UserError(f"{named} holds no output of swarmtwin: name a folder that one of its commands left")


def _drive(named: str, robot: Robot) -> None:
    if not Path(named).exists():
        raise UserError(f"drive {named} is missing: name a CSV file with {', '.join(robot.command_columns)}")


def _foreign(named: str, robot: Robot) -> None:
    if not Path(named).exists():
        raise UserError(f"there is nothing at path={named}: name what is to be imported")


def _password_file(named: str, robot: Robot | None) -> None:
    if not Path(named).is_file():
        raise UserError(f"broker.password_file {named} is missing: name a file whose first line is the password")


def _certificate(named: str, robot: Robot | None) -> None:
    if not Path(named).is_file():
        raise UserError(f"broker.ca_file {named} is missing: name the certificate of the broker's authority")


def _video(named: str, robot: Robot) -> None:
    if not Path(named).exists():
        raise UserError(f"there is nothing at video={named}: name a video file or a folder of pictures")


def _killed(named: str, robot: Robot) -> None:
    output = Path(named).absolute()
    if not output.with_name(f".{output.name}.partial").is_dir():
        raise UserError(f"there is nothing to recover for {named}: no deployment to it was killed")


def _calibration(named: str, robot: Robot) -> None:
    if not Path(named).exists():
        raise UserError(f"no calibration {named}: make one with `swarmtwin calibrate`")


SEVERAL = ("reference",)
"""Options that may name several inputs, in a list."""

INPUTS: Mapping[str, Callable[[str, Any], None]] = {
    "from": _generator,
    "simulation": _model,
    "policy.folder": _rolled_out_policy,
    "candidate": _candidate,
    "transitions": _transitions,
    "synthetic": _transitions,
    "baseline": _transitions,
    "models": _models,
    "policies": _policies,
    "folder": _output,
    "recording": _recording,
    "reference": _recording,
    "measured": _recording,
    "train_vehicle": _recording,
    "other_vehicle": _recording,
    "open_loop": _recording,
    "path": _foreign,
    "drive": _drive,
    "broker.password_file": _password_file,
    "broker.ca_file": _certificate,
    "video": _video,
    "recover": _killed,
    "first_policy": _policy,
    "calibration": _calibration,
}
