"""The page of a champion in MLflow's registry: its words, and addresses of pictures that MLflow's server answers."""

import json
from pathlib import Path

import mlflow
import pytest
from mlflow.server import app

from swarmtwin.tracking import registry
from swarmtwin.tracking.champion_page import Evidence, champion_page, code
from swarmtwin.tracking.runs import keep_folder, tracked_run

EVIDENCE = Evidence(
    because="its one-step error is 12.0% smaller (95 % interval 9.0% to 15.0% smaller) than that of the plain one",
    measured_on="10 runs of the recording `other`",
    compared_with="the plain one: there was no champion before it",
)


@pytest.fixture
def drawn(workplace):
    """A registered model that was drawn when it was trained, and of whose run something was drawn later."""
    folder, later = workplace / "model", workplace / "later"
    for place, name in ((folder, "errors by run.png"), (folder, "rollout.mp4"), (later, "paths.png")):
        place.mkdir(exist_ok=True)
        (place / name).write_bytes(f"drawn: {name}".encode())
    (folder / "model.yaml").write_text("one")
    with tracked_run("dynamics", "mgr mlp", {}) as run:
        source = run.folder(folder, "model")
    keep_folder(run.run_id, later, "pictures")
    return registry.register("mgr-dynamics", folder, source, run.run_id, {"model": "mlp", "origin": "real"})


def test_it_says_what_the_model_is_what_it_was_measured_on_against_whom_and_by_which_command(drawn):
    page = champion_page(drawn, EVIDENCE, "swarmtwin promote 'recording=other'")
    experiment = mlflow.get_experiment_by_name("swarmtwin/dynamics").experiment_id
    assert page.splitlines()[:6] == [
        "A dynamics model of robot `mgr`, `mlp`, trained on real transitions. It became champion because its one-step "
        "error is 12.0% smaller (95 % interval 9.0% to 15.0% smaller) than that of the plain one.",
        "",
        "- **Measured on** 10 runs of the recording `other`.",
        "- **Compared with** the plain one: there was no champion before it.",
        "- **Promoted by** `swarmtwin promote 'recording=other'`",
        f"- **Made by** [the run `mgr mlp`](#/experiments/{experiment}/runs/{drawn.run_id}), with its configuration, "
        "inputs, curves and pictures.",
    ]
    assert "Promoted by" not in champion_page(drawn, EVIDENCE, None)


def addresses(page):
    """What a page shows or links to, by name."""
    shown = [line.removeprefix("!").removeprefix("Film: ") for line in page.splitlines() if line.startswith(("!", "F"))]
    return {name.lstrip("["): address.rstrip(")") for name, address in (one.split("](") for one in shown)}


def test_its_pictures_have_addresses_that_the_server_of_the_interface_answers(drawn, workplace, monkeypatch):
    """Relative to it: asked of MLflow's own server, each is answered by the file."""
    pictures = addresses(champion_page(drawn, EVIDENCE, None))
    assert list(pictures) == ["errors by run.png", "paths.png", "rollout.mp4"]
    for role in ("FILE", "REGISTRY"):
        monkeypatch.setenv(f"_MLFLOW_SERVER_{role}_STORE", f"sqlite:///{workplace / 'mlflow.db'}")
    for kept in ("_tracking_store", "_model_registry_store"):
        monkeypatch.setattr(f"mlflow.server.handlers.{kept}", None)
    monkeypatch.setattr("mlflow.tracking._model_registry.utils._registry_uri", None)  # where the server sets its own
    monkeypatch.setenv("MLFLOW_REGISTRY_URI", "")
    server = app.test_client()
    for name, address in pictures.items():
        answer = server.get(f"/{address}")
        assert (answer.status_code, answer.data) == (200, f"drawn: {name}".encode()), address


def test_a_model_that_nobody_drew_or_tracked_has_a_page_as_well(workplace):
    folder = workplace / "policy"
    folder.mkdir()
    (folder / "policy.yaml").write_text(json.dumps({}))
    tags = {"task": "obstacle", "algorithm": "ddpg", "simulation": "crnet (synthetic)"}
    version = registry.register("mgr-policy", folder, folder.as_uri(), None, tags)
    page = champion_page(version, EVIDENCE, None)
    assert page.startswith(
        "A policy of robot `mgr` for task `obstacle`, learned by ddpg in the simulation crnet (synthetic). It became"
    )
    assert "Made by" not in page
    assert not addresses(page)


def test_of_many_pictures_the_first_are_shown(drawn, workplace):
    many = workplace / "many"
    many.mkdir()
    for number in range(9):
        (many / f"{number}.png").touch()
    keep_folder(drawn.run_id, many, "pictures")
    assert champion_page(drawn, EVIDENCE, None).count("![") == 6


def test_a_name_with_a_backtick_stays_a_name():
    assert code(Path("a`b")) == "``a`b``"
