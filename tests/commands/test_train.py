"""`swarmtwin train` leaves a whole model or none, the same for the same seed, tracked and registered."""

import json
import os
import signal
import subprocess

import mlflow
import numpy as np
import pandas as pd
import pyarrow.parquet
import pytest

from swarmtwin.dynamics.model_folder import load_evidence, read_description
from swarmtwin.dynamics.provenance import Provenance
from swarmtwin.dynamics.training_module import EpochHistory
from swarmtwin.errors import UserError
from swarmtwin.files import folder_digest
from swarmtwin.recordings.recognition import digests
from swarmtwin.tracking import registry
from swarmtwin.tracking.store import use_store
from swarmtwin.transitions import SPLITS, GeneratorOrigin, load_preparation, load_transitions
from swarmtwin.transitions.preparation import save_preparation

MLP = ("train", "recording=reference", "model=mlp", "model.steps=150", "recipe.batch_size=128", "pictures=false")
QUICK = ("train", "recording=reference", "recipe.epochs=2", "seeds=1", "register=false", "pictures=false")

WAIT_IN_EPOCH_5_OF_SEED_2 = """
import os, time
from swarmtwin.dynamics.training_module import EpochHistory

close_epoch = EpochHistory.on_train_epoch_end

def close_and_wait(self, *arguments):
    close_epoch(self, *arguments)
    if self.seed == 2 and len(self.errors) == 5:
        print(os.getpid(), flush=True)
        for _ in range(1200):  # one long sleep goes on if the signal comes just before it
            time.sleep(0.1)

EpochHistory.on_train_epoch_end = close_and_wait
"""


def runs():
    """The runs in this folder's store, the newest first."""
    use_store()
    return mlflow.search_runs(experiment_names=["swarmtwin/dynamics"], output_format="list")


def inputs_of(run):
    """Digest and profile of a run's datasets, by what they are for."""
    return {
        tag.value: (each.dataset.digest, json.loads(each.dataset.profile))
        for each in run.inputs.dataset_inputs
        for tag in each.tags
        if tag.key == "mlflow.data.context"
    }


def same_model(first, second):
    files = ("weights.safetensors", "model.yaml", "metrics.json", "history.csv")
    return all((first / name).read_bytes() == (second / name).read_bytes() for name in files)


def test_the_same_seed_gives_the_same_bytes_and_another_seed_does_not(swarmtwin, workshop, library):
    for seed in (1, 2):
        assert swarmtwin(*MLP, "seeds=1", "register=false", f"seed={seed}", f"output=seed-{seed}").status == 0
    assert same_model(workshop / "seed-1", library / "models" / "mlp")
    assert not same_model(workshop / "seed-2", library / "models" / "mlp")


@pytest.mark.end_to_end
@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGKILL])
def test_an_interrupted_training_leaves_no_model_and_continues_to_the_same_one(
    swarmtwin, program, workshop, monkeypatch, stop
):
    short = (*MLP, "model.steps=60")
    process = subprocess.Popen(
        [program, *short, "output=out"],
        env=os.environ | {"RUN_FIRST": WAIT_IN_EPOCH_5_OF_SEED_2},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    os.kill(int(process.stdout.readline()), stop)
    _, error = process.communicate(timeout=60)
    assert process.returncode == {signal.SIGINT: 130, signal.SIGKILL: 128 + signal.SIGKILL}[stop]
    assert "Traceback" not in error
    if stop == signal.SIGINT:
        assert f"interrupted; what was done is kept, the same call with output={workshop / 'out'} goes on" in error
    assert not (workshop / "out").exists()

    trained = []
    close_epoch = EpochHistory.on_train_epoch_end
    monkeypatch.setattr(
        EpochHistory, "on_train_epoch_end", lambda self, *a: (trained.append(self.seed), close_epoch(self, *a))
    )
    assert swarmtwin(*short, "output=out").status == 0
    epochs = len(pd.read_csv(workshop / "out" / "history.csv").query("seed == 2"))
    assert trained == [2] * (epochs - 5)
    assert swarmtwin(*short, "output=uninterrupted").status == 0
    assert same_model(workshop / "out", workshop / "uninterrupted")
    assert not (workshop / "out" / "checkpoints").exists()
    assert not list(workshop.glob(".out*"))
    assert sorted(run.info.status for run in runs()) == ["FINISHED", "FINISHED", "KILLED"]


def test_of_a_sweep_the_best_challenges_whichever_is_last(swarmtwin, workshop):
    assert swarmtwin("record", "vehicle=1", "runs=60", "steps=12", "seed=9", "output=short_runs").status == 0
    answer = swarmtwin(
        *(
            "train",
            "-m",
            "model=mlp",
            "model.steps=2,150,3",
            "recording=short_runs",
            "recipe.batch_size=128",
            "seeds=1",
            "pictures=false",
        ),
        "output=steps-${model.steps}",
    )
    assert answer.status == 0, answer.error
    said = " ".join(answer.shown.split())
    assert "mgr-dynamics version 2, its challenger in place of version 1: one-step error -" in said
    assert "mgr-dynamics version 3; version 2 stays challenger: one-step error +" in said
    assert registry.find_version("models:/mgr-dynamics@challenger").number == 2


def test_a_run_is_tracked_and_its_model_registered_as_challenger(swarmtwin, workshop):
    for seed in (4, 5):
        assert swarmtwin(*QUICK, "model=mlp", f"seed={seed}", "register=true", f"output=seed-{seed}").status == 0
    last, first = runs()
    assert [run.data.tags["seed"] for run in (first, last)] == ["4", "5"]
    assert (last.data.params["model.name"], last.data.params["recipe.epochs"]) == ("mlp", "2")
    assert "mlflow.parentRunId" not in last.data.tags
    errors = Provenance.read(workshop / "seed-5").chosen.errors
    assert last.data.metrics["validation_position_mm"] == errors["position_mm"]
    assert last.data.metrics["validation_orientation_deg"] == errors["orientation_deg"]
    metrics = json.loads((workshop / "seed-5" / "metrics.json").read_text())
    assert {name: metrics["validation"][name] for name in errors} == errors
    challenger = registry.find_version("models:/mgr-dynamics@challenger")
    assert challenger.number == 2
    assert challenger.tags["digest"] == folder_digest(workshop / "seed-5")
    assert folder_digest(challenger.folder()) == folder_digest(workshop / "seed-5")
    (output,) = last.outputs.model_outputs
    assert mlflow.MlflowClient().get_logged_model(output.model_id).artifact_location == challenger.source
    given = [inputs_of(run) for run in (first, last)]
    assert given[0] == given[1]
    assert {context: profile["runs"] for context, (_, profile) in given[0].items()} == {
        context: len(Provenance.read(workshop / "seed-5").runs[split])
        for context, split in (("training", "train"), ("validation", "validation"), ("test", "test"))
    }
    assert len({digest for digest, _ in given[0].values()}) == 3


def test_the_evidence_beside_a_model_is_every_run_that_it_was_not_fitted_to(swarmtwin, workshop):
    assert swarmtwin("prepare", "recording=pair", "pictures=false", "output=prepared").status == 0
    assert swarmtwin(*QUICK[:1], "transitions=prepared", *QUICK[2:], "model=mlp", "output=out").status == 0
    evidence, prepared = load_evidence(workshop / "out"), load_transitions(workshop / "prepared")
    in_evidence = {evidence.runs[index] for index in evidence.run}
    assert in_evidence == set(prepared.runs) - set(Provenance.read(workshop / "out").runs["train"])
    expected = prepared.where(prepared.split != SPLITS.index("train"))
    for name in ("command", "pose", "displacement", "neighbours", "time_s", "vehicle", "split"):
        np.testing.assert_array_equal(getattr(evidence, name), getattr(expected, name))
    assert evidence.neighbours.shape[1] == 1
    assert evidence.robot == prepared.robot


def test_the_evidence_goes_with_the_model_into_the_registry_and_does_not_change_its_digest(swarmtwin, workshop):
    assert swarmtwin(*QUICK, "model=kinematic", "register=true", "output=out").status == 0
    fetched = registry.find_version("models:/mgr-dynamics@challenger").folder()
    assert (fetched / "evidence.parquet").read_bytes() == (workshop / "out" / "evidence.parquet").read_bytes()
    digest = folder_digest(workshop / "out")
    (workshop / "out" / "evidence.parquet").unlink()
    assert folder_digest(workshop / "out") == digest
    assert load_evidence(workshop / "out") is None


def test_damaged_evidence_is_refused(workshop, model):
    file = model("mlp") / "evidence.parquet"
    file.write_bytes(file.read_bytes()[:-50])
    with pytest.raises(UserError) as refused:
        load_evidence(file.parent)
    assert str(refused.value).startswith(f"{file}: no transitions can be read (")
    assert str(refused.value).endswith("): train the model anew")


def test_synthetic_transitions_are_no_evidence_and_a_mixture_s_is_what_its_generator_has_not_seen(
    swarmtwin, workshop, prepared
):
    real, preparation = load_transitions(prepared), load_preparation(prepared)
    origin = GeneratorOrigin(name="gan", digest="d", seed=1, real_transitions=1)
    one_run = (min(digests(preparation.learned)), "transitions:AAAAAA==")
    lineage = {"synthetic": preparation.learned, "part": one_run, "elsewhere": (*preparation.learned, "another run")}
    for name, learned in lineage.items():
        (workshop / name).mkdir()
        changes = {"origin": "synthetic", "generator": origin, "learned": learned}
        save_preparation(workshop / name, real, preparation.model_copy(update=changes))
    quick = (*QUICK[2:], "model=kinematic")
    assert swarmtwin("train", "transitions=synthetic", *quick, "output=of-synthetic").status == 0
    assert load_evidence(workshop / "of-synthetic") is None
    for name in lineage:
        mixed = ("transitions=prepared", f"synthetic={name}", "real_share=0.5", *quick, f"output=of-{name}-mixed")
        assert swarmtwin("train", *mixed).status == 0
    assert load_evidence(workshop / "of-elsewhere-mixed") is None
    for name in ("synthetic", "part"):
        np.testing.assert_array_equal(load_evidence(workshop / f"of-{name}-mixed").time_s, real.part("test").time_s)


def test_a_network_may_look_at_neighbours(swarmtwin, workshop):
    swarmtwin("train", "recording=pair", *QUICK[2:], "model=mlp", "model.situation=[command,neighbours]", "output=out")
    assert read_description(workshop / "out").situation == ("command", "neighbours")


def test_without_registering_there_is_no_version(swarmtwin):
    assert "not registered" in swarmtwin(*QUICK, "model=kinematic").shown
    assert registry.versions("mgr-dynamics") == []


def test_a_sweep_is_one_parent_with_comparable_children(swarmtwin):
    assert swarmtwin("train", "-m", *QUICK[1:], "model=mlp,kinematic", "seed=7").status == 0
    children, parents = [], []
    for run in runs():
        (parents if run.data.tags.get("kind") == "sweep" else children).append(run)
    assert [parent.info.status for parent in parents] == ["FINISHED"]
    assert {child.data.tags["mlflow.parentRunId"] for child in children} == {parents[0].info.run_id}
    assert sorted(child.data.params["model.name"] for child in children) == ["kinematic", "mlp"]
    assert {child.data.tags["seed"] for child in children} == {"7"}
    assert len({frozenset(child.data.metrics) for child in children}) == 1
    assert len({child.data.tags["recording.digest"] for child in children}) == 1


@pytest.mark.end_to_end
def test_dead_seeds_are_flagged_replaced_and_never_the_model(swarmtwin, workshop, monkeypatch):
    monkeypatch.setenv("LOKY_MAX_CPU_COUNT", "1")  # in this process, also on a machine so busy that two seem worth it
    fcnn = ("model=fcnn", "model.steps=120", "recipe.batch_size=128", "register=false", "pictures=false")
    quick = ("trainer.logger=none", "trainer.checkpoint_epochs=30")
    answer = swarmtwin("train", "recording=reference", *fcnn, *quick, "seed=1", "seeds=6", "output=out")
    assert answer.status == 0
    provenance = Provenance.read(workshop / "out")
    dead = [outcome for outcome in provenance.seeds if outcome.dead]
    live = [outcome for outcome in provenance.seeds if not outcome.dead]
    assert dead, "none of the seeds that a final ReLU used to kill died: choose others"
    assert len(live) == 6
    assert provenance.chosen in live
    # A constant output errs by the spread of the motion itself, several times what a live network errs.
    for outcome in live:
        assert outcome.position_mm < 10
        assert outcome.orientation_deg < 10
    for outcome in dead:
        assert outcome.position_mm > 20 or outcome.orientation_deg > 30
    assert answer.shown.count("dead: constant output") == len(dead)
    assert runs()[0].data.metrics["dead_seeds"] == len(dead)


def test_where_every_seed_is_dead_nothing_is_left(swarmtwin, workshop):
    answer = swarmtwin(*QUICK, "model=mlp", "recipe.learning_rate=1e30", "output=out")
    assert answer.status == 2
    assert "mlp: every seed is dead (seed 1: the errors were no longer finite in epoch 1;" in answer.error
    assert not (workshop / "out").exists()
    assert [run.info.status for run in runs()] == ["FAILED"]


@pytest.mark.parametrize(
    ("options", "status", "message"),
    [
        (
            ["transitions=prepared", "recording=reference"],
            2,
            "give transitions=... or recording=..., not both",
        ),
        (
            [],
            2,
            "no transitions in artifacts/transitions/mgr: run `dvc repro` first, or give recording=... or "
            "transitions=...",
        ),
        (
            ["robot=mur", "transitions=prepared"],
            2,
            "prepared holds transitions of robot 'mgr': add robot=mgr",
        ),
        (
            ["robot=mur", "recording=reference"],
            2,
            "reference/recording.yaml: the recording is of robot 'mgr', not of 'mur': add robot=mgr, or choose "
            "another recording",
        ),
        (["recording=reference", "vehicles=[3]"], 2, "reference: no vehicle '3': known: 1"),
        (
            ["transitions=prepared", "vehicles=1"],
            2,
            "vehicles=... chooses from a recording: give recording=... as well",
        ),
        (
            ["model=mpl"],
            2,
            "no such model: 'mpl': did you mean 'mlp'? known: boosted_trees, cnn, ",
        ),
        (["model.layer=[3]", "model=mlp"], 2, "unknown option 'model.layer': did you mean 'model.layers'?"),
        (["recipe.epoch=3"], 2, "unknown option 'recipe.epoch': did you mean 'recipe.epochs'?"),
        (["recording=reference", "seeds=0"], 2, "options: field 'seeds': Input should be greater than or equal to 1"),
    ],
)
@pytest.mark.usefixtures("prepared")
def test_a_mistake_is_one_line_and_leaves_nothing(swarmtwin, workshop, options, status, message):
    answer = swarmtwin("train", *options, "output=out")
    assert answer.status == status
    assert answer.error.startswith(f"swarmtwin train: {message}")
    assert len(answer.error.strip().splitlines()) == 1
    assert not (workshop / "out").exists()
    assert runs() == []


def test_transitions_damaged_in_the_middle_are_refused_before_anything_is_learned(swarmtwin, workshop, prepared):
    file = prepared / "transitions.parquet"
    table = pyarrow.parquet.read_table(file)
    pyarrow.parquet.write_table(table, file, row_group_size=100, compression="zstd")
    damaged = pyarrow.parquet.read_metadata(file).row_group(4).column(table.column_names.index("turn_rad"))
    content = bytearray(file.read_bytes())
    start, length = damaged.data_page_offset, damaged.total_compressed_size
    content[start : start + length] = b"\xff" * length
    file.write_bytes(content)
    answer = swarmtwin("train", "transitions=prepared", *QUICK[2:], "model=mlp", "output=out")
    assert answer.status == 2
    assert answer.error.startswith("swarmtwin train: prepared/transitions.parquet: no transitions can be read (")
    assert answer.error.endswith("): make it again with swarmtwin prepare\n")
    assert not (workshop / "out").exists()
    assert runs() == []
