"""Sweeps: every command and every study takes `-m`, and ends with a table whose first row is the best run."""

import re
import shutil
from importlib.resources import files
from pathlib import Path

import hydra
import mlflow
import pytest
from rich.console import Console

from swarmtwin.commands.catalogue import COMMANDS, Ranking
from swarmtwin.commands.experiment import experiments, study_module
from swarmtwin.commands.sweep_table import keep_row, read_rows, sweep_table
from swarmtwin.configuration import config_folder
from swarmtwin.tracking.store import use_store

SOURCE = Path(str(files("swarmtwin")))
MODULES = [
    *(f"commands/{command.module}.py" for name, command in COMMANDS.items() if name != "experiment"),
    *sorted({f"{study_module(name).removeprefix('swarmtwin.').replace('.', '/')}.py" for name in experiments()}),
]
ERRORS = Ranking(("position_mm", "orientation_deg"))


def lines(table):
    """The cells of a table as it prints, a list for each line that holds any."""
    console = Console(width=200)
    with console.capture() as shown:
        console.print(table)
    return [line.split() for line in shown.get().splitlines() if line.strip(" ─")]


@pytest.mark.parametrize("module", MODULES)
def test_every_command_and_study_returns_its_headline_figures(module):
    assert "\ndef run(options: Options) -> dict[str, Any]:\n" in (SOURCE / module).read_text()


NAMES = [*(name for name in COMMANDS if name != "experiment"), *(f"experiment/{name}" for name in experiments())]


def tracked_in(config_name):
    """The experiments of MLflow's that a command or a study says itself that its runs belong to."""
    room, _, study = config_name.partition("/")
    module = study_module(study) if study else f"swarmtwin.commands.{COMMANDS[room].module}"
    file = SOURCE.parent / f"{module.replace('.', '/')}.py"
    imported = re.findall(r"^from (swarmtwin\.studies\.\w+\.\w+) import", file.read_text(), re.MULTILINE)
    texts = [(SOURCE.parent / f"{one.replace('.', '/')}.py").read_text() for one in imported]
    return set(re.findall(r'\btracked_run\(\s*"(\w+)"', "".join([file.read_text(), *texts])))


@pytest.mark.parametrize("name", NAMES)
def test_what_makes_runs_is_swept_under_a_parent_in_their_experiment(name):
    with hydra.initialize_config_dir(str(config_folder()), version_base="1.3"):
        callbacks = hydra.compose(name, return_hydra_config=True).hydra.callbacks
    assert {callback.experiment for callback in callbacks.values()} == tracked_in(name)


def test_the_best_run_comes_first_and_the_failed_last(tmp_path):
    keep_row(tmp_path, 0, ["robot=mgr", "model=none"], {"failed": "no such model"})
    keep_row(tmp_path, 1, ["robot=mgr", "model=gru"], {"position_mm": 3.5, "orientation_deg": 4.0, "output": "b"})
    keep_row(tmp_path, 2, ["robot=mgr", "model=mlp"], {"position_mm": 3.0, "orientation_deg": 5.0, "output": "c"})
    _, units, headings, *rows = lines(sweep_table(read_rows(tmp_path), ERRORS))
    assert (units, headings) == (["position", "orientation"], ["model", "mm", "°", "output"])  # the robot was not swept
    assert [row[0] for row in rows] == ["gru", "mlp", "none"]  # 17 % more position error, 25 % more orientation error
    assert rows[0] == ["gru", "3.5", "4", "b"]
    assert " ".join(rows[2]) == "none failed: no such model"


def test_the_highest_is_the_best_where_it_is_a_success(tmp_path):
    for number, success in enumerate((0.2, 0.9, 0.5)):
        keep_row(tmp_path, number, [f"seed={number}"], {"success": success})
    rows = lines(sweep_table(read_rows(tmp_path), Ranking(("success",), highest_first=True)))[2:]
    assert [row[0] for row in rows] == ["1", "2", "0"]


def test_runs_of_which_none_is_better_keep_their_order(tmp_path):
    for number in (10, 9):
        keep_row(tmp_path, number, [f"seed={number}"], {"transitions": number})
    assert [row[0] for row in lines(sweep_table(read_rows(tmp_path), Ranking()))[2:]] == ["9", "10"]


def test_a_sweep_of_trainings_ends_with_its_table(swarmtwin, workshop):
    quick = ("recording=reference", "recipe.batch_size=256", "seeds=1", "register=false", "pictures=false")
    answer = swarmtwin("train", "-m", *quick, "model=mlp", "model.steps=12,150", "output=out/${model.steps}")
    assert answer.status == 0
    table = answer.shown[answer.shown.index("2 runs, best first") :].splitlines()
    _, headings, *rows = [line.split() for line in table[1:] if line.strip(" ─")]
    assert headings == ["model.steps", "mm", "°", "s", "output"]
    assert [(row[0], row[-1]) for row in rows] == [("150", "out/150"), ("12", "out/12")]
    assert float(rows[0][1]) < float(rows[1][1])


def test_studies_are_swept_and_one_that_fails_does_not_keep_the_others(swarmtwin, model, workshop):
    model("kinematic", "artifacts/dynamics/mgr/kinematic")
    for recording in ("reference", "other_vehicle", "open_loop"):
        shutil.copytree(workshop / recording, workshop / "data" / "mgr" / recording)
    answer = swarmtwin("experiment", "-m", "name=overview,dynamics", "output=out_${name}")
    assert answer.status == 2
    assert answer.error.splitlines()[-1].startswith(
        "swarmtwin experiment: artifacts/comparison/mgr holds no comparison"
    )
    rows = [line.split() for line in answer.shown[answer.shown.index("2 runs") :].splitlines()]
    shown = {row[0]: row for row in rows if row and row[0] in ("overview", "dynamics")}
    assert shown["dynamics"][1] == "kinematic"
    assert shown["dynamics"][-1] == "out_dynamics"
    assert shown["overview"][1] == "failed:"
    assert (workshop / "out_dynamics" / "table.csv").exists()
    use_store()
    runs = mlflow.search_runs(experiment_names=["swarmtwin/dynamics"], output_format="list")
    parents = {run.info.run_name: run.data.tags.get("mlflow.parentRunId") for run in runs}
    (parent,) = (run for run in runs if run.data.tags.get("kind") == "sweep")
    assert parents == {parent.info.run_name: None, "mgr models compared": parent.info.run_id}
    assert parent.info.status == "FINISHED"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["name=dynamics,overview"], "name=dynamics,overview is a sweep: add -m"),
        (["-m", "name=dynamics,overvie"], "no such experiment: 'overvie': did you mean 'overview'?"),
    ],
)
def test_a_mistake_in_the_names_is_one_line(swarmtwin, arguments, message):
    answer = swarmtwin("experiment", *arguments, "output=out")
    assert (answer.status, answer.error.startswith(f"swarmtwin experiment: {message}")) == (2, True)
