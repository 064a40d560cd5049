"""Tables 1 to 4 and figures 7 to 13 as commands: nothing is trained twice, and findings are made of what they left."""

import json
import shutil

import pandas as pd
import pytest

from swarmtwin.dynamics.training import TrainingJob

FIGURE9 = (
    "experiment",
    "name=figure9",
    "train_vehicle=reference",
    "other_vehicle=other_vehicle",
    "models=[mlp]",
    "recipe.batch_size=128",
    "scales.quick.steps=12",
    "scales.quick.seeds=2",
    "scales.quick.generator_epochs=[1,17]",
    "processes=1",
)


@pytest.fixture
def trained(monkeypatch):
    """The names and seeds of what is trained, in order; the third training is interrupted if that is set."""
    jobs, train = [], TrainingJob.run

    def run(job, report):
        if len(jobs) == trained.interrupted_after:
            raise KeyboardInterrupt
        jobs.append((job.config.name, job.seed))
        return train(job, report)

    def trained():
        return jobs

    trained.interrupted_after = None
    monkeypatch.setattr(TrainingJob, "run", run)
    return trained


@pytest.mark.end_to_end
def test_an_interrupted_experiment_goes_on_and_another_takes_what_is_there(swarmtwin, workshop, trained, monkeypatch):
    trained.interrupted_after = 3
    answer = swarmtwin(*FIGURE9, "output=all/figure9")
    assert answer.status == 130
    assert "finished trainings are kept in outputs/trainings, the same call goes on" in answer.error
    assert not (workshop / "all" / "figure9").exists()

    trained.interrupted_after = None
    answer = swarmtwin(*FIGURE9, "output=all/figure9")
    assert answer.status == 0, answer.error
    assert len(trained()) == 6  # three amounts of GAN, two seeds, each once

    monkeypatch.setattr("swarmtwin.studies.training_grid.training_jobs.fit", None)
    table4 = [one for one in FIGURE9 if not one.startswith(("name=", "scales.quick.generator_epochs"))]
    assert swarmtwin(*table4, "name=table3", "scales.quick.steps_at_low_rate=12", "output=all/table3").status == 0
    assert len(trained()) == 8  # another learning rate
    assert swarmtwin(*table4, "name=table1", "generators=[]", "output=all/table1").status == 0
    assert len(trained()) == 10  # the MLP given the commands before; that on real transitions is known

    table = pd.read_csv(workshop / "all" / "figure9" / "table.csv")
    assert set(table.recording) == {"train_vehicle", "other_vehicle"}
    assert set(table.seeds) == {2}
    real = table[table.generator.isna()]
    assert (real.position_mm > real.floor_command_position_mm).all()
    assert (real.floor_command_position_mm > real.floor_history_position_mm).all()
    again = pd.read_csv(workshop / "all" / "table1" / "table.csv")
    pd.testing.assert_series_equal(
        real.position_mm.reset_index(drop=True), again[again.title == "mlp-R"].position_mm.reset_index(drop=True)
    )
    for name in ("figure9", "table1"):
        report = (workshop / "all" / name / "report.md").read_text()
        assert f"![{name}.png]({name}.png)" in report
        assert (workshop / "all" / name / f"{name}.png").exists()

    (workshop / "all" / ".table2.partial").mkdir()
    shutil.copy(workshop / "all" / "table1" / "provenance.json", workshop / "all" / ".table2.partial")
    answer = swarmtwin("experiment", "name=findings", "folder=all", "output=page")
    assert answer.status == 0, answer.error
    page = (workshop / "page" / "findings.md").read_text()
    metrics = json.loads((workshop / "all" / "table1" / "metrics.json").read_text())
    (claim,) = metrics["claims"]
    assert "given the commands before as well, the plain MLP errs less" in page
    assert f"| {claim['judged']['verdict']} |" in page
    gain = json.loads((workshop / "page" / "metrics.json").read_text())["floor_gains"][0]
    assert f"{gain['command_mm']:.2f} → {gain['history_mm']:.2f}" in page
    assert {file.name for file in (workshop / "page").glob("*.png")} >= {"table1_table1.png", "figure9_figure9.png"}


def test_pictures_are_drawn_anew_from_the_folder(swarmtwin, workshop):
    quick = [one for one in FIGURE9 if not one.startswith(("name=", "scales.quick.generator_epochs"))]
    assert (
        swarmtwin(*quick, "name=table3", "scales.quick.steps_at_low_rate=12", "pictures=false", "output=out").status
        == 0
    )
    assert not list((workshop / "out").glob("*.png"))
    assert swarmtwin("experiment", "name=pictures", "folder=out", "output=drawn").status == 0
    assert (workshop / "drawn" / "table3.png").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("models=[crnt]",), "models: no such model: 'crnt': did you mean 'crnet'?"),
        (("generators=[gna]",), "generators: no such generator: 'gna': did you mean 'gan'?"),
        (("generators=[residual_diffusion]",), "has no batch_size, discriminator_steps and steps"),
        (("train_vehicle=nowhere",), "nowhere"),
    ],
)
def test_mistakes_are_said_in_one_line_before_anything_is_trained(swarmtwin, workshop, trained, options, message):
    answer = swarmtwin(*FIGURE9, *options, "output=out")
    assert answer.status == 2
    assert message in answer.error
    assert answer.error.strip().count("\n") <= 3  # what was read, and one line
    assert not trained()
    assert not (workshop / "out").exists()


def test_findings_of_nothing_name_the_experiments(swarmtwin, workshop):
    (workshop / "empty").mkdir()
    answer = swarmtwin("experiment", "name=findings", "folder=empty", "output=page")
    assert answer.status == 2
    assert "holds no output" in answer.error
