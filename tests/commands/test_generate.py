"""`swarmtwin generate`: real → generator → synthetic → simulation, also where there is no recording."""

import json

import mlflow
import numpy as np
import pandas as pd
import pytest
import yaml

from swarmtwin.dynamics.provenance import Provenance
from swarmtwin.files import folder_digest
from swarmtwin.tracking import registry
from swarmtwin.tracking.store import use_store
from swarmtwin.transitions import load_preparation, load_transitions

QUICK = ("generator.mean_model_steps=40", "generator.noise_steps=40", "generator.batch_size=64")
WITH_PICTURES = ("generate", "robot=mgr", "recording=reference", *QUICK)
GENERATE = (*WITH_PICTURES, "pictures=false")
TRAIN = ("train", "model=mlp", "model.steps=60", "recipe.batch_size=128", "seeds=1", "pictures=false")


def runs():
    use_store()
    return mlflow.search_runs(experiment_names=["swarmtwin/generator"], output_format="list")


def test_the_whole_way_to_a_simulation_on_a_machine_without_recordings(swarmtwin, workshop):
    assert swarmtwin(*GENERATE, "count=700", "output=made").status == 0
    (workshop / "reference").rename(workshop / "elsewhere")
    drawing = ("generate", "from=made/generator", "count=500", "seed=7", "pictures=false", "output=drawn")
    assert swarmtwin(*drawing).status == 0
    preparation = load_preparation(workshop / "drawn" / "transitions")
    assert preparation.origin == "synthetic"
    assert preparation.generator.digest == folder_digest(workshop / "made" / "generator")
    assert len(load_transitions(workshop / "drawn" / "transitions")) == 500
    assert swarmtwin(*TRAIN, "transitions=drawn/transitions", "output=simulation").status == 0

    provenance = Provenance.read(workshop / "simulation")
    assert (provenance.origin, provenance.generator.seed) == ("synthetic", 7)
    tags = registry.find_version("models:/mgr-dynamics@challenger").tags
    assert (tags["origin"], tags["generator"]) == ("synthetic", "residual_diffusion")

    (workshop / "elsewhere").rename(workshop / "reference")
    evaluation = ("evaluate", "simulation=simulation", "recording=reference", "output=evaluation")
    assert swarmtwin(*evaluation).status == 0
    metrics = json.loads((workshop / "evaluation" / "metrics.json").read_text())
    assert metrics["held_out_runs"] is True
    unseen = metrics["transitions"]
    assert 0 < unseen < 0.3 * sum(load_preparation(workshop / "made" / "transitions").transitions.values()) + 100


def test_what_generate_leaves_is_whole_tracked_and_the_same_for_the_same_seed(swarmtwin, workshop):
    assert swarmtwin(*WITH_PICTURES, "seed=3", "output=first").status == 0
    assert swarmtwin(*GENERATE, "seed=3", "output=second").status == 0
    for name in ("generator/weights.safetensors", "generator/generator.yaml", "quality.json", "history.csv"):
        assert (workshop / "first" / name).read_bytes() == (workshop / "second" / name).read_bytes(), name
    assert {path.name for path in (workshop / "first").iterdir()} == {
        "generator",
        "transitions",
        "quality.json",
        "marginals.csv",
        "quality.png",
        "history.csv",
        "history.png",
        "provenance.json",
    }
    description = yaml.safe_load((workshop / "first" / "generator" / "generator.yaml").read_text())
    learned = description["lineage"]["transitions"]
    transitions = load_transitions(workshop / "first" / "transitions")
    assert {split: len(transitions.part(split)) for split in learned} == learned
    assert len(pd.read_csv(workshop / "first" / "history.csv")) >= 40
    run = runs()[0]
    quality = json.loads((workshop / "first" / "quality.json").read_text())
    assert run.data.metrics["recall"] == quality["synthetic"]["recall"]
    assert run.data.tags["seed"] == "3"
    drawn = ("generate", "from=first/generator", "seed=3", "pictures=false", "output=again")
    assert swarmtwin(*drawn).status == 0
    again = load_transitions(workshop / "again" / "transitions")
    np.testing.assert_array_equal(again.displacement, transitions.displacement)


def test_less_real_data_can_be_asked_for(swarmtwin, workshop):
    assert swarmtwin(*GENERATE, "real=300", "count=600", "output=made").status == 0
    preparation = load_preparation(workshop / "made" / "transitions")
    assert 270 <= preparation.generator.real_transitions <= 330
    assert sum(preparation.transitions.values()) == 600


def test_a_mixture_trains_and_says_so(swarmtwin, workshop):
    assert swarmtwin(*GENERATE, "output=made").status == 0
    mixture = ("recording=reference", "synthetic=made/transitions", "real_share=0.4")
    assert swarmtwin(*TRAIN, *mixture, "output=mixed", "register=false").status == 0
    provenance = Provenance.read(workshop / "mixed")
    assert provenance.origin == "mixed"
    assert provenance.vehicles == ("1",)


def test_a_sweep_is_one_parent(swarmtwin, workshop):
    sweep = ("robot=mgr", "recording=reference", "generator=gan", "generator.steps=20", "seed=1,2", "count=300")
    assert swarmtwin("generate", "-m", *sweep, "pictures=false").status == 0
    parents = {run.data.tags.get("mlflow.parentRunId") for run in runs()}
    assert len(runs()) == 3
    assert len(parents) == 2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((), "say of which robot: robot=..., or give a generator's folder: from=..."),
        (("from=nowhere",), "no generator in nowhere: generator.yaml is missing; name a folder that generate made"),
        (("robot=mgr", "recording=reference", "real=150"), "transitions for training and"),
        (("robot=mgr", "recording=reference", "real=99999"), "real transitions for training and validation: ask for"),
        (("robot=mur", "recording=reference"), "the recording is of robot 'mgr', not of 'mur'"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_nothing(swarmtwin, workshop, options, message):
    answer = swarmtwin("generate", *options, "output=out")
    assert answer.status == 2
    assert message in answer.error
    assert "Traceback" not in answer.error
    assert not (workshop / "out").exists()


def test_a_given_generator_stands_alone(swarmtwin, workshop):
    assert swarmtwin(*GENERATE, "output=made").status == 0
    for options, message in (
        (("robot=mur",), "made/generator is a generator of robot 'mgr', not of 'mur': leave robot=... out"),
        (("recording=reference",), "from=... draws from a trained generator, which needs no recording=...: leave one"),
        (("real=300",), "from=... draws from a trained generator, which needs no real=...: leave one"),
    ):
        answer = swarmtwin("generate", "from=made/generator", *options, "output=out")
        assert answer.status == 2
        assert message in answer.error
        assert not (workshop / "out").exists()
    drawing = ("generate", "from=made/generator", "robot=mgr", "count=300", "pictures=false", "output=out")
    assert swarmtwin(*drawing).status == 0
    again = swarmtwin(*GENERATE[:2], "transitions=made/transitions", "output=third")
    assert "made/transitions holds synthetic transitions: a generator learns from real ones only" in again.error
    answer = swarmtwin(*TRAIN, "transitions=made/transitions", "model.situation=[command,previous_command]")
    assert answer.status == 2
    assert "the model looks at previous_command, which these transitions do not hold" in answer.error


def test_records_of_a_training_arrive_in_the_run_while_it_lasts_or_at_its_end(swarmtwin, workshop):
    for logger in ("mlflow", "none"):
        assert swarmtwin(*GENERATE, f"trainer.logger={logger}", f"output={logger}").status == 0
    history = pd.read_csv(workshop / "mlflow" / "history.csv")
    for run in runs()[:2]:
        for name in history.columns[1:]:
            kept = mlflow.MlflowClient().get_metric_history(run.info.run_id, name)
            assert [point.step for point in kept] == list(history["step"][history[name].notna()]), name


@pytest.mark.parametrize(
    ("option", "said"),
    [
        ("trainer=ddp_cpu", "one process"),
        ("trainer.patience_epochs=3", "no loss by which it could end early"),
        ("trainer.precision=16", "trainer.precision"),
    ],
)
def test_a_trainer_that_a_generator_cannot_have_is_refused(swarmtwin, option, said):
    answer = swarmtwin(*GENERATE, option, "output=out")
    assert answer.status == 2
    assert said in answer.error


def test_a_generator_learns_in_16_bits_and_shows_lightning_s_bar(swarmtwin, workshop):
    answer = swarmtwin(*GENERATE, "trainer.precision=bf16-mixed", "trainer.progress_bar=rich", "output=out")
    assert answer.status == 0
    assert len(pd.read_csv(workshop / "out" / "history.csv")) >= 40
