"""What a champion's page in MLflow's model registry says of it, in Markdown, and the pictures that it shows.

MLflow's interface keeps pictures in Markdown whose addresses are on its own server; they are written relative to it, so
that they are found wherever that is.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import PurePosixPath
from urllib.parse import quote, urlencode

import mlflow

from swarmtwin.tracking.registry import Version
from swarmtwin.tracking.store import store_errors, use_store


@dataclass(frozen=True)
class Evidence:
    """What a version became champion by, in words.

    Attributes:
        because: what was found, as the end of a sentence that begins "It became champion because".
        measured_on: the recording, the roll-outs or the deployments.
        compared_with: the champion before, or what stood in for one.
    """

    because: str
    measured_on: str
    compared_with: str


def champion_page(version: Version, evidence: Evidence, command: str | None, most_pictures: int = 6) -> str:
    """Return the page of a version that becomes champion.

    Args:
        version: as it was registered.
        evidence: that it is promoted by.
        command: that asks for it; None: not known.
        most_pictures: how many it shows; the run that made it, to which it links, has all of them.

    Raises:
        UserError: the tracking store cannot be used.
    """
    lines = [
        f"{_what_it_is(version)} It became champion because {evidence.because}.",
        "",
        f"- **Measured on** {evidence.measured_on}.",
        f"- **Compared with** {evidence.compared_with}.",
    ]
    if command:
        lines.append(f"- **Promoted by** {code(command)}")
    with store_errors():
        use_store()
        if version.run_id:
            lines.append(f"- **Made by** {_link_to_run(version.run_id)}.")
        pictures = dict(_pictures(version))
    shown = [f"![{name}]({address})" for name, address in pictures.items() if name.endswith(".png")][:most_pictures]
    films = [f"Film: [{name}]({address})" for name, address in pictures.items() if name.endswith(".mp4")]
    return "\n".join([*lines, *(text for one in (*shown, *films) for text in ("", one))])


def code(text: object) -> str:
    """Return what is typed, or a name, so that Markdown leaves it as it is."""
    fence = "``" if "`" in str(text) else "`"
    return f"{fence}{text}{fence}"


def _what_it_is(version: Version) -> str:
    robot = version.name.rpartition("-")[0]
    if version.task:
        algorithm, simulation = version.tags.get("algorithm"), version.tags.get("simulation")
        learned = f", learned by {algorithm} in the simulation {simulation}" if algorithm and simulation else ""
        return f"A policy of robot {code(robot)} for task {code(version.task)}{learned}."
    model, origin = version.tags.get("model"), version.tags.get("origin")
    kind = f", {code(model)}" if model else ""
    trained = f", trained on {origin} transitions" if origin else ""
    return f"A dynamics model of robot {code(robot)}{kind}{trained}."


def _link_to_run(run_id: str) -> str:
    run = mlflow.get_run(run_id)
    address = f"#/experiments/{run.info.experiment_id}/runs/{run_id}"
    return f"[the run {code(run.info.run_name)}]({address}), with its configuration, inputs, curves and pictures"


def _pictures(version: Version) -> Iterator[tuple[str, str]]:
    """Find files, each by its name and its address in the interface: those in the model, then those drawn since."""
    for place in ("", "data/model"):  # a copy of the model's folder, or an MLflow model around it
        for entry in mlflow.artifacts.list_artifacts(artifact_uri=f"{version.source}/{place}".rstrip("/")):
            name = PurePosixPath(entry.path).name
            asked = {"name": version.name, "version": version.number, "path": f"{place}/{name}".lstrip("/")}
            yield name, f"model-versions/get-artifact?{urlencode(asked, quote_via=quote)}"
    if version.run_id is None:
        return
    for place in ("figures", "pictures"):
        for entry in mlflow.MlflowClient().list_artifacts(version.run_id, place):
            asked = {"run_id": version.run_id, "path": entry.path}
            yield PurePosixPath(entry.path).name, f"get-artifact?{urlencode(asked, quote_via=quote)}"
