"""`swarmtwin tune`: one study, shared by processes and continued by later calls."""

import mlflow
import optuna
import pytest
import yaml
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState

from swarmtwin.tracking import use_store

SEARCH = ("tune", "recording=reference", "model=kinematic", "recipe.epochs=3", "recipe.batch_size=256")


def study(workshop):
    """The study in the storage that the command chose."""
    backend = JournalFileBackend(str(workshop / "outputs" / "tune" / "mgr-kinematic.journal"))
    return optuna.load_study(study_name="mgr-kinematic", storage=optuna.storages.JournalStorage(backend))


def complete(workshop):
    return study(workshop).get_trials(states=[TrialState.COMPLETE])


def space(**options):
    """Replace the space that is searched."""
    ranges = ", ".join(f"recipe.{name}: {found}" for name, found in options.items())
    return "~space", f"+space={{{ranges}}}"


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

    best = min(trials, key=lambda trial: trial.value)
    kept = yaml.safe_load((workshop / "outputs" / "tune" / "mgr-kinematic.yaml").read_text())
    assert kept == {"loss": best.value, **best.params}
    assert f"recipe.batch_size={best.params['recipe.batch_size']}" in answer.shown

    use_store()
    runs = mlflow.search_runs(experiment_names=["dynamics"], output_format="list")
    parents = {run.info.run_id: [] for run in runs if run.data.tags.get("kind") == "study"}
    for run in runs:
        if run.info.run_id not in parents:
            parents[run.data.tags["mlflow.parentRunId"]].append(run.data.metrics["validation_loss"])
    assert sorted(len(children) for children in parents.values()) == [2, 5]
    assert sorted(loss for losses in parents.values() for loss in losses) == sorted(trial.value for trial in trials)


def test_the_same_seed_searches_the_same_values(swarmtwin, workshop):
    for name in ("one", "two"):
        assert swarmtwin(*SEARCH, "workers=1", "trials=3", f"storage={name}.journal", "study=same").status == 0
    found = []
    for name in ("one", "two"):
        storage = optuna.storages.JournalStorage(JournalFileBackend(str(workshop / f"{name}.journal")))
        found.append(optuna.load_study(study_name="same", storage=storage).get_trials())
    assert [(trial.params, trial.value) for trial in found[0]] == [(trial.params, trial.value) for trial in found[1]]


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


def test_a_search_in_which_every_trial_fails_ends(swarmtwin, workshop):
    hopeless = space(learning_rate="{choices: [1.0e30]}")
    answer = swarmtwin(*SEARCH, *hopeless, "model=mlp", "study=mgr-kinematic", "workers=1", "trials=2")
    assert answer.status == 1
    assert answer.error.splitlines()[-1] == (
        "swarmtwin tune: study 'mgr-kinematic': no trial finished: widen or shift the space"
    )
    assert [trial.state for trial in study(workshop).get_trials()] == [TrialState.FAIL] * 2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            space(batch_sze="{low: 8, high: 16}"),
            "space: no option 'recipe.batch_sze': did you mean 'recipe.batch_size'?",
        ),
        (space(batch_size="{low: 8}"), "options: field 'space.recipe.batch_size': Value error, give low and high, or"),
        (["trials=0"], "options: field 'trials': Input should be greater than or equal to 1, got 0"),
        (["workers=0"], "options: field 'workers': Input should be greater than or equal to 1, got 0"),
        (["recording=elsewhere"], "no recording folder elsewhere"),
    ],
)
def test_a_mistake_is_one_line_and_starts_no_study(swarmtwin, workshop, options, message):
    answer = swarmtwin(*SEARCH, "workers=1", *options)
    assert answer.status == 1
    assert answer.error.startswith(f"swarmtwin tune: {message}")
    assert len(answer.error.strip().splitlines()) == 1
    assert not (workshop / "outputs").exists()
