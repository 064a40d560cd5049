"""`swarmtwin experiment name=synthetic`: every case beside CR-Net-R on all real data, at equal steps."""

import json

import pandas as pd
import pytest

from swarmtwin.commands.experiments.synthetic_cases import CASES, chosen_cases
from swarmtwin.errors import UserError

EXPERIMENT = (
    "experiment",
    "name=synthetic",
    "transitions=prepared",
    "train_vehicle=reference",
    "other_vehicle=other_vehicle",
    "generators=none",
    "generator.trend_steps=60",
    "generator.noise_steps=60",
    "generator.batch_size=64",
    "crnet.steps=12",
    "mlp.steps=40",
    "recipe.batch_size=128",
    "part=0.5",
    "few=300",
    "synthetic=1500",
)


def test_the_table_compares_with_the_model_on_all_real_data(swarmtwin, workshop):
    swarmtwin("prepare", "recording=reference", "output=prepared")
    cases = "cases=[generator,generator_as_many,mixture_50,mlp_real_part,mlp_generator_few,real_few_epochs]"
    answer = swarmtwin(*EXPERIMENT, cases, "seeds=2", "output=out")
    assert answer.status == 0, answer.error
    table = pd.read_csv(workshop / "out" / "table.csv")
    train = table[table.recording == "train_vehicle"].set_index("case")
    assert set(table.recording) == {"train_vehicle", "other_vehicle"}
    assert (train.seeds == 2).all()
    assert train.real["generator"] == train.real["real"]
    assert train.learned_from["generator_as_many"] == train.learned_from["real"]
    assert train.real["mlp_generator_few"] == pytest.approx(300, abs=30)
    steps = train.steps[["real", "generator", "generator_as_many", "mixture_50"]]
    assert steps.max() <= 1.7 * steps.min()
    assert train.steps["real_few_epochs"] < train.steps["real"]
    metrics = json.loads((workshop / "out" / "metrics.json").read_text())
    errors = [seed["one_step"]["position_mm"]["mean"] for seed in metrics["mixture_50"]["train_vehicle"]]
    assert train.position_mm["mixture_50"] == pytest.approx(sum(errors) / 2)
    assert "×1.000" in answer.shown
    assert (workshop / "out" / "errors.png").exists()


def test_a_trained_generator_is_taken_where_there_is_one(swarmtwin, workshop, monkeypatch):
    swarmtwin("prepare", "recording=reference", "output=prepared")
    quick = ("generator.trend_steps=60", "generator.noise_steps=60", "generator.batch_size=64")
    made = swarmtwin("generate", "robot=mgr", "transitions=prepared", *quick, "output=none/diffusion")
    assert made.status == 0

    def refuse(*arguments):
        raise AssertionError("trained anew")

    monkeypatch.setattr("swarmtwin.commands.experiments.synthetic_cases.fit", refuse)
    assert swarmtwin(*EXPERIMENT, "cases=[mlp_generator]", "output=out").status == 0


def test_cases_are_known_by_name():
    assert set(chosen_cases("all")) == set(CASES)
    assert list(chosen_cases(("mlp_real",))) == ["real", "mlp_real"]
    with pytest.raises(UserError, match=r"^cases: no such case: 'mlp_rael': did you mean 'mlp_real'\?"):
        chosen_cases(("mlp_rael",))


def test_without_transitions_the_remedy_is_named(swarmtwin, workshop):
    answer = swarmtwin(*EXPERIMENT, "output=out")
    assert answer.status == 1
    assert "no transitions in prepared: run `dvc repro` first, or give transitions=..." in answer.error
    assert not (workshop / "out").exists()
