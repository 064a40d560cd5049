"""`swarmtwin experiment name=synthetic`: every case beside CR-Net-R on all real data, at equal steps."""

import json

import pandas as pd
import pytest

from swarmtwin.dynamics.training import train_seeds
from swarmtwin.errors import UserError
from swarmtwin.studies.synthetic.trainings import CASES, chosen_cases

EXPERIMENT = (
    "experiment",
    "name=synthetic",
    "transitions=prepared",
    "train_vehicle=reference",
    "other_vehicle=other_vehicle",
    "generators=none",
    "generator.mean_model_steps=60",
    "generator.noise_steps=60",
    "generator.batch_size=64",
    "crnet.steps=12",
    "mlp.steps=40",
    "ensemble.steps=12",
    "recipe.batch_size=128",
    "part=0.5",
    "few=300",
    "synthetic=1500",
)


@pytest.mark.end_to_end
@pytest.mark.usefixtures("prepared")
def test_the_table_compares_with_the_model_on_all_real_data(swarmtwin, workshop):
    cases = "cases=[generator,ensemble,generator_as_many,mixture_50,mlp_real_part,mlp_generator_few,real_few_epochs]"
    answer = swarmtwin(*EXPERIMENT, cases, "seeds=2", "output=out")
    assert answer.status == 0, answer.error
    table = pd.read_csv(workshop / "out" / "table.csv")
    train = table[table.recording == "train_vehicle"].set_index("case")
    assert set(table.recording) == {"train_vehicle", "other_vehicle"}
    assert (train.seeds == 2).all()
    assert train.real["generator"] == train.real["ensemble"] == train.real["real"]
    assert set(train.inputs) == {"command"}
    assert train.learned_from["generator_as_many"] == train.learned_from["real"]
    assert train.real["mlp_generator_few"] == pytest.approx(300, abs=30)
    steps = train.steps[["real", "ensemble", "generator", "generator_as_many", "mixture_50"]]
    assert steps.max() <= 1.7 * steps.min()
    assert train.steps["real_few_epochs"] < train.steps["real"]
    metrics = json.loads((workshop / "out" / "metrics.json").read_text())
    errors = [seed["one_step"]["position_mm"]["mean"] for seed in metrics["mixture_50"]["train_vehicle"]]
    assert train.position_mm["mixture_50"] == pytest.approx(sum(errors) / 2)
    assert "×1.000" in answer.shown
    assert (workshop / "out" / "errors.png").exists()


@pytest.mark.usefixtures("prepared")
def test_a_trained_generator_is_taken_where_there_is_one(swarmtwin, monkeypatch):
    quick = ("generator.mean_model_steps=60", "generator.noise_steps=60", "generator.batch_size=64")
    made = ("generate", "robot=mgr", "transitions=prepared", "pictures=false", "output=none/residual_diffusion")
    assert swarmtwin(*made, *quick).status == 0

    def refuse(*arguments):
        raise AssertionError("trained anew")

    monkeypatch.setattr("swarmtwin.studies.synthetic.trainings.fit", refuse)
    assert swarmtwin(*EXPERIMENT, "cases=[mlp_generator]", "pictures=false", "output=out").status == 0


@pytest.mark.usefixtures("prepared")
def test_a_model_is_taken_that_came_of_the_very_same_training_and_no_other(swarmtwin, workshop, monkeypatch):
    quick = ("recipe.batch_size=128", "seeds=1", "register=false", "pictures=false")
    made = ("train", "model=crnet", "transitions=prepared", *quick)
    assert swarmtwin(*made, "model.steps=12", "output=same").status == 0
    assert swarmtwin(*made, "model.steps=24", "output=longer").status == 0
    assert swarmtwin(*made, "model.steps=12", "seed=2", "output=other_seed").status == 0
    trained = []

    def counted(jobs, *arguments):
        trained.append([(job.config.name, len(job.transitions), job.seed) for job in jobs])
        return train_seeds(jobs, *arguments)

    monkeypatch.setattr("swarmtwin.studies.synthetic.study.train_seeds", counted)
    call = (*EXPERIMENT, "cases=[mlp_real]", "models=[nowhere,longer,other_seed,same]", "seeds=2", "pictures=false")
    assert swarmtwin(*call, "output=taken").status == 0
    assert swarmtwin(*call, "models=[longer]", "output=trained").status == 0
    assert [sorted(name for name, _, _ in jobs) for jobs in trained] == [
        ["mlp", "mlp"],
        ["crnet", "crnet", "mlp", "mlp"],
    ]
    tables = [(workshop / name / "table.csv").read_bytes() for name in ("taken", "trained")]
    assert tables[0] == tables[1]


def test_cases_are_known_by_name(robots):
    mgr, mur = robots["mgr"], robots["mur"]
    assert set(chosen_cases("all", mur)) == set(CASES)
    assert set(CASES) - set(chosen_cases("all", mgr)) == {"real_walls", "real_walls_part", "mlp_walls"}
    assert list(chosen_cases(("mlp_real",), mgr)) == ["real", "mlp_real"]
    with pytest.raises(UserError, match=r"^cases: no such case: 'mlp_rael': did you mean 'mlp_real'\?"):
        chosen_cases(("mlp_rael",), mgr)


def test_without_transitions_the_remedy_is_named(swarmtwin, workshop):
    answer = swarmtwin(*EXPERIMENT, "output=out")
    assert answer.status == 2
    assert "prepared/preparation.json is missing: name a folder that swarmtwin prepare made" in answer.error
    assert not (workshop / "out").exists()
