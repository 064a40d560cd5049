"""`swarmtwin experiment name=generators`: generators side by side, every one of them with the same columns."""

import json

import numpy as np
import pandas as pd
import pytest
import yaml

from swarmtwin.configuration import config_folder
from swarmtwin.generators.generator import generator_names
from swarmtwin.transitions import load_preparation

KEPT = ("gan", "gaussian_mixture")
DROPPED = [f"~generators.{name}" for name in generator_names() if name not in KEPT]
EXPERIMENT = (
    "experiment",
    "name=generators",
    "transitions=prepared",
    "generators.gan.steps=40",
    "generators.gaussian_mixture.components=10",
    "student.steps=60",
    "recipe.batch_size=128",
    "synthetic=900",
    *DROPPED,
)


@pytest.mark.end_to_end
@pytest.mark.usefixtures("prepared")
def test_each_generator_and_its_student_have_a_row_with_the_same_columns(swarmtwin, workshop):
    answer = swarmtwin(*EXPERIMENT, "+generators.gan_2={name: gan, epochs: 2}", "output=out")
    assert answer.status == 0, answer.error
    table = pd.read_csv(workshop / "out" / "table.csv").set_index("generator")
    assert list(table.index) == ["real", "gan", "gaussian_mixture", "gan_2"]
    quality = json.loads((workshop / "out" / "gan" / "quality.json").read_text())
    assert table.recall["gan"] == pytest.approx(quality["synthetic"]["recall"], rel=1e-4)
    assert table.recall["real"] == pytest.approx(quality["real"]["recall"], rel=1e-4)
    ratio = quality["synthetic"]["spread"]["turn_rad"] / quality["held_out_spread"]["turn_rad"]
    assert table.spread_turn_ratio["gan"] == pytest.approx(ratio, rel=1e-4)
    shared = table.drop(
        columns=["kind", "dead", "nearer_to_learned", "exact_copies", "redrawn_share", "generator_cpu_s"]
    )
    assert np.isfinite(shared[table.dead.isna()]).all().all()
    assert load_preparation(workshop / "out" / "gan" / "transitions").generator.name == "gan"
    history = pd.read_csv(workshop / "out" / "gan_2" / "history.csv")
    learned = load_preparation(workshop / "prepared").transitions["train"]
    assert history.step.max() == round(2 * learned / 96)
    assert "gaussian_mixture" in answer.shown
    few = (*EXPERIMENT, "~generators.gan", "judged_on=test", "output=test")
    assert swarmtwin(*few).status == 0
    on_test = pd.read_csv(workshop / "test" / "table.csv").set_index("generator")
    assert on_test.position_mm["real"] != table.position_mm["real"]
    assert on_test.precision["gaussian_mixture"] == table.precision["gaussian_mixture"]


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("judged_on=train", "field 'judged_on': Input should be 'validation' or 'test', got 'train'"),
        ("generators.gan.step=3", "unknown option 'generators.gan.step': did you mean 'generators.gan.steps'?"),
        ("+generators.mine={name: gna}", "no such generator: 'gna': did you mean 'gan'?"),
    ],
)
@pytest.mark.usefixtures("prepared")
def test_a_mistake_is_one_line_and_leaves_nothing(swarmtwin, workshop, option, message):
    answer = swarmtwin(*EXPERIMENT, option, "output=out")
    assert answer.status == 2
    assert message in answer.error
    assert not (workshop / "out").exists()


def test_every_shipped_generator_is_in_the_table():
    content = yaml.safe_load((config_folder() / "experiment" / "generators.yaml").read_text())
    listed = [
        value
        for entry in content["defaults"]
        if isinstance(entry, dict)
        for key, value in entry.items()
        if "/generator@" in key
    ]
    assert sorted(listed) == sorted(generator_names())
