"""`swarmtwin tune`: one study, shared by processes and continued by later calls."""

import dataclasses
import multiprocessing
import os
import re
import shlex
import shutil
import signal
import sqlite3
import time
from pathlib import Path

import mlflow
import numpy as np
import optuna
import pytest
import yaml
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState

from swarmtwin.learning.tuning import SharedStudy
from swarmtwin.tracking.store import use_store
from swarmtwin.transitions import SPLITS, load_transitions
from swarmtwin.transitions.storage import write_transitions

STUDY = ("study=mgr-kinematic",)
SEARCH = ("tune", "recording=reference", "model=kinematic", "recipe.epochs=3", "recipe.batch_size=256", *STUDY)


@pytest.fixture
def drawn():
    """Pictures of the search, which all tests but those that look at them go without."""


@pytest.fixture(autouse=True)
def without_pictures(request, monkeypatch):
    """Draw none where a test does not ask for them: they take as long as the search."""
    if "drawn" not in request.fixturenames:
        monkeypatch.setattr("swarmtwin.studies.found_values.search_figures", lambda *_: {})


def study(workshop):
    """The study in the storage that the command chose."""
    return optuna.load_study(study_name="mgr-kinematic", storage=f"sqlite:///{workshop}/outputs/tune/mgr-kinematic.db")


def complete(workshop):
    return study(workshop).get_trials(states=[TrialState.COMPLETE])


def space(**options):
    """Replace the space that is searched."""
    ranges = ", ".join(f"recipe.{name}: {found}" for name, found in options.items())
    return "~space", f"+space={{{ranges}}}"


@pytest.mark.end_to_end
@pytest.mark.usefixtures("drawn")
def test_two_workers_share_a_study_and_a_later_call_continues_it(swarmtwin, workshop):
    assert swarmtwin(*SEARCH, "workers=2", "trials=5").status == 0
    first = complete(workshop)
    assert len(first) == 5
    assert len({trial.number for trial in first}) == 5
    answer = swarmtwin(*SEARCH, "workers=1", "trials=7")
    assert answer.status == 0
    trials = complete(workshop)
    assert len(trials) == 7
    assert [trial.params for trial in trials[:5]] == [trial.params for trial in first]
    rates = [trial.params["recipe.learning_rate"] for trial in trials]
    assert len(set(rates)) == 7

    best = min(trials, key=lambda trial: trial.value)
    kept = yaml.safe_load((workshop / "outputs" / "tune" / "mgr-kinematic.yaml").read_text())
    assert kept == {"loss": best.value, **best.params}
    assert f"recipe.batch_size={best.params['recipe.batch_size']}" in answer.shown

    use_store()
    runs = mlflow.search_runs(experiment_names=["swarmtwin/dynamics"], output_format="list")
    parents = {run.info.run_id: [] for run in runs if run.data.tags.get("kind") == "study"}
    for run in runs:
        if run.info.run_id not in parents:
            parents[run.data.tags["mlflow.parentRunId"]].append(run.data.metrics["validation_loss"])
    assert sorted(len(children) for children in parents.values()) == [2, 5]
    assert sorted(loss for losses in parents.values() for loss in losses) == sorted(trial.value for trial in trials)


@pytest.mark.usefixtures("drawn")
def test_what_was_found_are_configurations_that_name_their_study(swarmtwin, workshop):
    """They lie in a folder for --config-dir: `train` with them is the best trial again."""
    ranges = space(weight_decay="{low: 0.01, high: 0.2}")[1].removeprefix("+space={").removesuffix("}")
    searched = f"+space={{model.learning_rate: {{low: 0.01, high: 0.1, log: true}}, {ranges}}}"
    search = ("tune", "recording=reference", "model=kinematic", "recipe.epochs=3", "recipe.batch_size=256", "~space")
    answer = swarmtwin(*search, searched, "workers=1", "trials=4", "study=first try")
    assert answer.status == 0
    folder = workshop / "outputs" / "tune" / "first try"
    found = yaml.safe_load((workshop / "outputs" / "tune" / "first try.yaml").read_text())
    text = (folder / "model" / "first_try.yaml").read_text()
    assert text.startswith("# Found by study first try on recording reference (")
    assert "of 4, of which 4 were not broken off" in text
    assert f"its loss on validation runs {found['loss']:.6g}. Searched: model.learning_rate 0.01 to 0.1, log;" in text
    assert yaml.safe_load(text)["learning_rate"] == found["model.learning_rate"]
    assert (
        yaml.safe_load((folder / "recipe" / "first_try.yaml").read_text())["weight_decay"]
        == (found["recipe.weight_decay"])
    )
    (line,) = [line for line in answer.shown.splitlines() if line.startswith("as configurations: ")]
    command = shlex.split(line.removeprefix("as configurations: swarmtwin "))
    assert command[:2] == ["train", "--config-dir=outputs/tune/first try"]
    assert command[-2:] == ["model=first_try", "recipe=first_try"]
    assert swarmtwin(*command, "seeds=1", "register=false", "pictures=false", "output=out").status == 0
    (seed,) = yaml.safe_load((workshop / "out" / "model.yaml").read_text())["provenance"]["seeds"]
    loss = seed["position_mm"] + seed["orientation_deg"]
    assert loss == pytest.approx(found["loss"], rel=1e-6)

    use_store()
    (parent,) = mlflow.search_runs(
        experiment_names=["swarmtwin/dynamics"], filter_string="tags.kind = 'study'", output_format="list"
    )
    kept = {artifact.path for artifact in mlflow.MlflowClient().list_artifacts(parent.info.run_id, "study")}
    pictures = ("history", "importances", "parallel_coordinates")
    assert kept == {"study/model", "study/recipe", *(f"study/{name}.png" for name in pictures)}
    assert parent.data.metrics["best_loss"] == pytest.approx(found["loss"])


def test_a_generator_is_searched_as_a_model_is(swarmtwin, workshop):
    quick = ("what=generator", "generator=gan", "generator.steps=20", "workers=1", "study=gans")
    assert swarmtwin("tune", "recording=reference", *quick, "trials=1").status == 0
    answer = swarmtwin("tune", "recording=reference", *quick, "trials=2")
    assert answer.status == 0
    found = yaml.safe_load((workshop / "outputs" / "tune" / "gans.yaml").read_text())
    assert set(found) == {"loss", *(f"generator.{name}" for name in ("learning_rate", "beta1", "discriminator_steps"))}
    assert 0.4 < found["loss"] <= 1
    (line,) = [line for line in answer.shown.splitlines() if line.startswith("train with it: ")]
    command = shlex.split(line.removeprefix("train with it: swarmtwin "))
    assert swarmtwin(*command, "count=100", "pictures=false", "output=drawn").status == 0
    described = yaml.safe_load((workshop / "drawn" / "generator" / "generator.yaml").read_text())["generator"]
    assert described["learning_rate"] == found["generator.learning_rate"]
    assert described["steps"] == 20
    use_store()
    runs = mlflow.search_runs(experiment_names=["swarmtwin/generator"], filter_string="", output_format="list")
    assert sorted(run.info.run_name for run in runs if "kind" not in run.data.tags) == [
        *("gans trial 0", "gans trial 1", "mgr-gan")
    ]


def test_a_generator_without_a_space_is_told_how_to_give_it_one(swarmtwin):
    answer = swarmtwin("tune", "recording=reference", "what=generator", "~generator_space.gan", "generator=gan")
    assert answer.status == 2
    assert answer.error.splitlines()[-1] == (
        "swarmtwin tune: generator_space has no entry 'gan': known: residual_diffusion; add what to search of it, "
        "'+generator_space.gan={generator.OPTION: {low: ..., high: ...}}'"
    )


def journal(file):
    """The storage in a journal file, as Optuna reads it."""
    return optuna.storages.JournalStorage(JournalFileBackend(str(file)))


@pytest.mark.end_to_end
def test_two_workers_share_a_journal_and_a_later_call_continues_it(swarmtwin, workshop):
    for workers, trials in ((2, 3), (1, 4)):
        calls = (f"workers={workers}", f"trials={trials}")
        assert swarmtwin(*SEARCH, "storage=study.log", *calls).status == 0
        ended = optuna.load_study(study_name="mgr-kinematic", storage=journal("study.log")).get_trials()
        assert [trial.state for trial in ended] == [TrialState.COMPLETE] * trials
    assert len({trial.params["recipe.learning_rate"] for trial in ended}) == 4


@pytest.mark.parametrize("name", ["one.db", "sqlite:///one.db", "deep/in/one.db", "sqlite:///deep/in/one.db"])
def test_a_file_that_ends_in_db_is_a_database_in_a_folder_made_for_it(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    SharedStudy("s", name, {"robot": "mgr"}).open().add_trial(optuna.trial.create_trial(value=1.0))
    url = f"sqlite:///{name.removeprefix('sqlite:///')}"
    assert [trial.value for trial in optuna.load_study(study_name="s", storage=url).get_trials()] == [1.0]
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["one.db"]


@pytest.mark.parametrize("name", ["first try", "a?b", "100%", "{x}", "a#b"])
def test_any_name_of_a_study_makes_a_database_of_it(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    shared = SharedStudy.named(name, "mgr", None, {"robot": "mgr"})
    assert shared.open().study_name == name
    assert len(list((tmp_path / "outputs" / "tune").glob("*.db"))) == 1


def add_trials(shared, count, ready, failures):
    try:
        ready.wait()
        study = shared.open()
        for _ in range(count):
            trial = study.ask()
            study.tell(trial, trial.suggest_float("x", 0, 1))
    except BaseException as error:
        failures.put(repr(error))
        raise


def test_processes_that_begin_at_once_share_a_database_that_is_yet_to_be_made(tmp_path):
    """None finds half of the tables, and none gives up while another writes."""
    fork = multiprocessing.get_context("fork")
    processes, trials = 4, 5
    ready, failures = fork.Barrier(processes), fork.SimpleQueue()
    shared = SharedStudy("s", f"sqlite:///{tmp_path}/s.db", {"robot": "mgr"})
    workers = [fork.Process(target=add_trials, args=(shared, trials, ready, failures)) for _ in range(processes)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert failures.empty(), failures.get()
    ended = shared.open().get_trials(states=[TrialState.COMPLETE])
    assert sorted(trial.number for trial in ended) == list(range(processes * trials))
    assert [path.name for path in tmp_path.iterdir()] == ["s.db"]


@pytest.mark.parametrize("looked_at", ["get_trials", "user_attrs"])
def test_a_process_that_begins_between_two_looks_at_a_study_does_not_turn_another_away(
    tmp_path, monkeypatch, looked_at
):
    """Whether trials are there and what they are for are two queries: another process may add both in between."""
    shared = SharedStudy("s", f"sqlite:///{tmp_path}/s.db", {"robot": "mgr"})
    original = getattr(optuna.Study, looked_at)

    def begin_meanwhile(study, *args, **options):
        seen = original.fget(study) if isinstance(original, property) else original(study, *args, **options)
        monkeypatch.setattr(optuna.Study, looked_at, original)
        shared.open().add_trial(optuna.trial.create_trial(value=1.0))
        return seen

    slow = property(begin_meanwhile) if isinstance(original, property) else begin_meanwhile
    monkeypatch.setattr(optuna.Study, looked_at, slow)
    assert len(shared.open().trials) == 1


@pytest.mark.usefixtures("drawn")
def test_the_advice_is_a_complete_command(swarmtwin, workshop):
    options = ("model.steps=40", "split.seed=3", "device=cpu")
    search = ("tune", "recording=reference", "model=kinematic", *options, *space(batch_size="{choices: [256]}"))
    answer = swarmtwin(*search, "workers=1", "trials=1", "study=advised")
    assert answer.status == 0
    (advice,) = [line for line in answer.shown.splitlines() if line.startswith("train with it: ")]
    command = shlex.split(advice.removeprefix("train with it: swarmtwin "))
    assert swarmtwin(*command, "seeds=1", "register=false", "pictures=false", "output=out").status == 0
    kept = yaml.safe_load((workshop / "outputs" / "tune" / "advised.yaml").read_text())
    described = yaml.safe_load((workshop / "out" / "model.yaml").read_text())
    assert described["model"]["steps"] == 40
    (chosen,) = described["provenance"]["seeds"]
    shown = next(line for line in answer.shown.splitlines() if line.split()[:1] == ["0"]).split()
    assert shown[1:4] == [f"{kept['loss']:.4g}", f"{chosen['position_mm']:.4g}", f"{chosen['orientation_deg']:.4g}"]


def test_what_is_chosen_never_looks_at_the_test_split(swarmtwin, workshop):
    """Tuning, training and a generator's quality are the same where the test split holds other numbers."""
    assert swarmtwin("prepare", "recording=reference", "output=clean", "pictures=false").status == 0
    shutil.copytree("clean", "altered")
    transitions = load_transitions("clean")
    in_test = transitions.split == SPLITS.index("test")
    assert in_test.any()
    garbage = {
        name: np.where(in_test[:, None], 50 - 3 * getattr(transitions, name), getattr(transitions, name))
        for name in ("command", "previous_command", "pose", "displacement")
    }
    write_transitions(Path("altered/transitions.parquet"), dataclasses.replace(transitions, **garbage))
    quick = ("generator.mean_model_steps=20", "generator.noise_steps=20", "generator.members=2", "pictures=false")
    for name in ("clean", "altered"):
        data = f"transitions={name}"
        tune = ("tune", data, "model=mlp", "model.steps=12", "trials=2", "workers=1", f"study={name}")
        assert swarmtwin(*tune).status == 0
        train = ("train", data, "model=mlp", "model.steps=12", "seeds=2", "pictures=false", "register=false")
        assert swarmtwin(*train, f"output={name}-model").status == 0
        assert swarmtwin("generate", "robot=mgr", data, *quick, "count=300", f"output={name}-drawn").status == 0
    for clean in (
        "outputs/tune/clean.yaml",
        *(f"clean-model/{file}" for file in ("model.yaml", "weights.safetensors", "history.csv")),
        *(f"clean-drawn/{file}" for file in ("quality.json", "history.csv", "generator/weights.safetensors")),
        "clean-drawn/transitions/transitions.parquet",
    ):
        assert Path(clean).read_bytes() == Path(clean.replace("clean", "altered")).read_bytes(), clean


def test_no_heading_is_cut_off_in_a_narrow_window(swarmtwin, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    answer = swarmtwin(*SEARCH, "workers=1", "trials=1")
    assert "…" not in answer.shown
    for word in ("learning_rate", "weight_decay", "batch_size", "position", "orientation"):
        assert word in answer.shown


@pytest.mark.usefixtures("drawn")
def test_a_hopeless_trial_is_broken_off_and_counts(swarmtwin, workshop):
    rates = space(learning_rate="{choices: [0.01, 1.0e-7]}")
    search = (*SEARCH, *rates, "recipe.epochs=5", "recipe.batch_size=512", "workers=1")
    assert swarmtwin(*search, "trials=1").status == 0
    for rate in (*[0.01] * 9, 1.0e-7):
        study(workshop).enqueue_trial({"recipe.learning_rate": rate})
    assert "of 11 trials, 1 broken off early" in " ".join(swarmtwin(*search, "trials=11").shown.split())
    last = study(workshop).get_trials()[-1]
    assert (last.state, list(last.intermediate_values)) == (TrialState.PRUNED, [2])
    study(workshop).enqueue_trial({"recipe.learning_rate": 1.0e-7})
    assert swarmtwin(*search, "trials=12", "prune=false").status == 0
    assert study(workshop).get_trials()[-1].state == TrialState.COMPLETE


def test_the_same_seed_searches_the_same_values(swarmtwin, workshop):
    """In a database as in a journal."""
    found = []
    for name in ("one.db", "two.journal"):
        assert swarmtwin(*SEARCH, "workers=1", "trials=3", f"storage={name}", "study=same").status == 0
        storage = journal(name) if name.endswith(".journal") else f"sqlite:///{name}"
        found.append(optuna.load_study(study_name="same", storage=storage).get_trials())
    assert [(trial.params, trial.value) for trial in found[0]] == [(trial.params, trial.value) for trial in found[1]]


def test_what_a_kill_left_unfinished_is_drawn_again(swarmtwin, workshop):
    for name, calls in (("whole", 1), ("killed", 2)):
        for call in range(1, calls + 1):
            trials = f"trials={3 if call == calls else 1}"
            assert swarmtwin(*SEARCH, "workers=1", trials, f"storage={name}.db", "study=same").status == 0
            if call < calls:
                optuna.load_study(study_name="same", storage=f"sqlite:///{name}.db").ask()
    found = []
    for name in ("whole", "killed"):
        same = optuna.load_study(study_name="same", storage=f"sqlite:///{name}.db")
        ended = same.get_trials(states=[TrialState.COMPLETE])
        found.append([(trial.params, trial.value) for trial in ended])
    assert found[0] == found[1]


def test_a_study_that_is_complete_trains_nothing_more(swarmtwin, workshop):
    for _ in range(2):
        assert swarmtwin(*SEARCH, "workers=1", "trials=2").status == 0
    assert len(study(workshop).get_trials()) == 2


def test_values_stay_within_the_space(swarmtwin, workshop):
    narrow = space(learning_rate="{low: 0.001, high: 0.002, log: true}", batch_size="{choices: [64, 256]}")
    assert swarmtwin(*SEARCH, *narrow, "workers=1", "trials=4").status == 0
    for trial in complete(workshop):
        assert set(trial.params) == {"recipe.learning_rate", "recipe.batch_size"}
        assert 0.001 <= trial.params["recipe.learning_rate"] <= 0.002
        assert trial.params["recipe.batch_size"] in (64, 256)


def die(target, *arguments):
    """Let a process run something that ends with its death."""
    process = multiprocessing.get_context("fork").Process(target=target, args=arguments)
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL


def write_and_die(database):
    """Leave a transaction that has reached the file, and is not committed."""
    connection = sqlite3.connect(database)
    connection.execute("PRAGMA cache_spill = 1")
    connection.execute("PRAGMA cache_size = 1")
    connection.execute("BEGIN")
    connection.execute("UPDATE trial_values SET value = -1.0")
    connection.execute(
        "CREATE TABLE half AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n LIMIT 5000) "
        "SELECT i, randomblob(100) FROM n"
    )
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_process_that_was_killed_while_it_wrote_the_database_is_in_nobodys_way(tmp_path):
    """Neither its lock nor the transaction that it left unfinished."""
    shared = SharedStudy("s", f"sqlite:///{tmp_path}/s.db", {"robot": "mgr"})
    shared.open().add_trial(optuna.trial.create_trial(value=1.0))
    die(write_and_die, tmp_path / "s.db")
    assert (tmp_path / "s.db-journal").stat().st_size
    started = time.monotonic()
    shared.open().add_trial(optuna.trial.create_trial(value=2.0))
    assert time.monotonic() - started < 5
    assert [trial.value for trial in shared.open().get_trials()] == [1.0, 2.0]
    assert [path.name for path in tmp_path.iterdir()] == ["s.db"]


def hold(shared):
    backend = shared.open()._storage._backend
    backend._lock.acquire()
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_process_that_was_killed_while_it_wrote_the_journal_is_in_nobodys_way(tmp_path):
    """Neither its lock nor the line that it left unfinished."""
    shared = SharedStudy("s", str(tmp_path / "s.journal"), {"robot": "mgr"})
    shared.open().add_trial(optuna.trial.create_trial(value=1.0))
    die(hold, shared)
    with (tmp_path / "s.journal").open("a") as journal:
        journal.write('{"op_code": 4, "wor')
    started = time.monotonic()
    shared.open().add_trial(optuna.trial.create_trial(value=2.0))
    assert time.monotonic() - started < 5
    assert [trial.value for trial in shared.open().get_trials()] == [1.0, 2.0]
    assert [path.name for path in tmp_path.iterdir()] == ["s.journal"]


def test_a_search_in_which_every_trial_fails_ends(swarmtwin, workshop, caplog):
    hopeless = space(learning_rate="{choices: [1.0e30]}")
    answer = swarmtwin(*SEARCH, *hopeless, "model=mlp", "study=mgr-kinematic", "workers=1", "trials=2")
    assert answer.status == 2
    assert answer.error.splitlines()[-1] == (
        "swarmtwin tune: study 'mgr-kinematic': no trial finished: widen or shift the space"
    )
    assert [trial.state for trial in study(workshop).get_trials()] == [TrialState.FAIL] * 2
    dead = [message for message in caplog.messages if "is dead" in message]
    assert [message.partition(":")[0] for message in dead] == ["trial 0 failed", "trial 1 failed"]
    assert not [record for record in caplog.records if record.exc_info]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            space(batch_sze="{low: 8, high: 16}"),
            "space: no option 'recipe.batch_sze': did you mean 'recipe.batch_size'?",
        ),
        (space(batch_size="{low: 8}"), "options: field 'space.recipe.batch_size': Value error, give low and high, or"),
        (
            space(batch_size="{low: 8, choices: [8]}"),
            "options: field 'space.recipe.batch_size': Value error, give low and high, or choices",
        ),
        (
            space(learning_rate="{low: 0.1, high: 0.1}"),
            "options: field 'space.recipe.learning_rate': Value error, low 0.1 must be below high 0.1",
        ),
        (
            space(weight_decay="{low: 0, high: 1, log: true}"),
            "options: field 'space.recipe.weight_decay': Value error, log needs a low above 0, got 0",
        ),
        (space(batch_size="{choices: []}"), "options: field 'space.recipe.batch_size.choices': Tuple should have at"),
        (
            space(batch_size="{choices: [64, many]}"),
            "space: recipe: field 'batch_size': Input should be a valid integer, unable to parse string as an integer",
        ),
        (
            space(batch_size="{low: 8.5, high: 16}"),
            "space: recipe.batch_size takes whole numbers: give such as low and",
        ),
        (
            space(batch_size="{low: 1, high: 16}"),
            "space: recipe: field 'batch_size': Input should be greater than or equal to 2, got 1",
        ),
        (
            space(learning_rate="{low: -1, high: 1}"),
            "space: recipe: field 'learning_rate': Input should be greater than 0, got -1",
        ),
        (["storage=foo://place"], "storage foo://place cannot be opened (Can't load plugin: sqlalchemy.dialects:foo):"),
        (
            ["storage=mysql://me:secret@place/studies"],
            "storage mysql://me:***@place/studies cannot be opened (Failed to import DB access module",
        ),
        (
            ["storage=reference"],
            "storage reference cannot be opened (it is a folder): name a database by its URL, sqlite:///study.db, or",
        ),
        (["storage=reference/recording.yaml"], "storage reference/recording.yaml cannot be opened (Expecting value"),
        (["storage=sqlite:///reference"], "storage sqlite:///reference cannot be opened (it is a folder)"),
        (
            ["storage=sqlite:///reference/recording.yaml"],
            "storage sqlite:///reference/recording.yaml cannot be opened ((sqlite3.DatabaseError) file is not a",
        ),
        (["trials=0"], "options: field 'trials': Input should be greater than or equal to 1, got 0"),
        (["workers=0"], "options: field 'workers': Input should be greater than or equal to 1, got 0"),
        (["recording=elsewhere"], "no recording folder elsewhere"),
    ],
)
def test_a_mistake_is_one_line_and_starts_no_study(swarmtwin, workshop, options, message):
    answer = swarmtwin(*SEARCH, "workers=1", *options)
    assert answer.status == 2
    assert answer.error.startswith(f"swarmtwin tune: {message}")
    assert "Traceback" not in answer.error
    assert len([line for line in answer.error.splitlines() if "transitions kept" not in line]) == 1
    assert not (workshop / "outputs").exists()


@pytest.mark.end_to_end
def test_failures_of_two_workers_count(swarmtwin, workshop):
    hopeless = space(learning_rate="{low: 1.0e29, high: 1.0e30}")
    assert swarmtwin(*SEARCH, *hopeless, "model=mlp", "workers=2", "trials=3").status == 2
    assert [trial.state for trial in study(workshop).get_trials()] == [TrialState.FAIL] * 3


def test_a_trial_that_a_kill_left_behind_is_not_counted(swarmtwin, workshop):
    assert swarmtwin(*SEARCH, "workers=1", "trials=1").status == 0
    study(workshop).ask()
    assert swarmtwin(*SEARCH, "workers=1", "trials=2").status == 0
    assert [trial.state.name for trial in study(workshop).get_trials()] == ["COMPLETE", "RUNNING", "COMPLETE"]


def test_a_study_left_unnamed_is_one_of_its_own_for_all_that_changes_its_losses(swarmtwin, workshop):
    common = [*SEARCH[:-1], "workers=1", "trials=1"]
    narrow = space(learning_rate="{low: 0.001, high: 0.002}")
    changes = [
        [],
        ["recording=other_vehicle"],
        ["recipe.epochs=2"],
        ["recipe.weight_decay=0.2", *narrow],
        narrow,
        ["split.seed=2"],
        ["split.fractions={train: 0.7, validation: 0.2, test: 0.1}"],
        ["robot.largest_displacement.turn_rad=1.3"],
        ["recording=pair", "vehicles=1"],
        ["recording=pair", "vehicles=2"],
    ]
    databases = set()
    for change in changes:
        assert swarmtwin(*common, *change).status == 0
        found = {path.stem for path in (workshop / "outputs" / "tune").glob("*.db")}
        assert len(found - databases) == 1, change
        databases |= found
    assert all(re.fullmatch("mgr-kinematic-[0-9a-f]{8}", name) for name in databases)
    for same in ([], ["seed=2"], ["recipe.weight_decay=0.3"], ["trials=2"]):
        assert swarmtwin(*common, *same).status == 0
    assert {path.stem for path in (workshop / "outputs" / "tune").glob("*.db")} == databases


def test_a_named_study_takes_no_trials_of_anything_else(swarmtwin, workshop):
    assert swarmtwin(*SEARCH, "workers=1", "trials=1").status == 0
    answer = swarmtwin(*SEARCH, "recording=other_vehicle", "recipe.epochs=2", "workers=1", "trials=2")
    assert answer.status == 2
    assert answer.error.splitlines()[-1] == (
        "swarmtwin tune: study 'mgr-kinematic' in sqlite:///outputs/tune/mgr-kinematic.db was made for another "
        "recipe, data: choose another study=..., or leave it out"
    )
    assert len(study(workshop).get_trials()) == 1


@pytest.mark.parametrize(
    ("option", "found", "kind"),
    [
        ("weight_decay", "{low: 0, high: 1}", float),
        ("learning_rate", "{low: 0, high: 1}", float),
        ("weight_decay", "{low: 0.0, high: 2.0}", float),
        ("epochs", "{low: 1, high: 3}", int),
        ("batch_size", "{low: 8.0, high: 16.0}", int),
        ("batch_size", "{low: 128, high: 256, log: true}", int),
    ],
)
def test_an_option_that_takes_fractions_is_searched_among_them(swarmtwin, workshop, option, found, kind):
    swarmtwin(*SEARCH, *space(**{option: found}), "workers=1", "trials=2")
    values = [trial.params[f"recipe.{option}"] for trial in study(workshop).get_trials()]
    assert len(values) == 2
    assert all(type(value) is kind for value in values)
    assert kind is int or not any(value.is_integer() for value in values)
