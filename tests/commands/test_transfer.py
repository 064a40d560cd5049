"""`swarmtwin experiment name=transfer`: every policy of a robot, in its simulation and on stand-ins."""

import json

import pandas as pd
import pytest

from tiny_policies import save_seeker, simulation

TRANSFER = ("experiment", "name=transfer", "policies=policies", "count=12", "video=false")


@pytest.fixture
def policies(workshop, robots):
    """Two policies of the MGR, made by hand, and something that is none."""
    simulation(workshop / "kinematic", robots["mgr"])
    folder = workshop / "policies"
    (folder / "something").mkdir(parents=True)
    save_seeker(folder / "quick", source="kinematic")
    save_seeker(folder / "still", source="kinematic", speed=0.0)
    return folder


@pytest.mark.usefixtures("policies")
def test_every_policy_has_its_line_its_pictures_and_its_film(swarmtwin, workshop):
    answer = swarmtwin(*TRANSFER, "video=true", "speed=16", "output=out")
    assert answer.status == 0, answer.error
    table = pd.read_csv(workshop / "out" / "table.csv").set_index("policy")
    assert list(table.index) == ["quick", "still"]
    assert list(table.vehicles) == ["2 3", "2 3"]
    metrics = json.loads((workshop / "out" / "metrics.json").read_text())
    for name in table.index:
        reward = metrics[name]["stand_in"]["reward"]["mean"]
        assert table.loc[name, "stand_in_reward"] == pytest.approx(reward, abs=1e-4)
        assert (workshop / "out" / f"{name}.mp4").stat().st_size > 10_000
        assert (workshop / "out" / f"paths_{name}.png").exists()
    assert table.loc["still", "stand_in_reward"] < table.loc["quick", "stand_in_reward"]
    steps = pd.read_parquet(workshop / "out" / "rollouts.parquet")
    assert set(steps.policy) == {"quick", "still"}
    assert "quick" in answer.shown


@pytest.mark.usefixtures("policies")
@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["policies=nowhere"], "no folder nowhere with policies: run `dvc repro` first, or swarmtwin learn"),
        (["policies=reference"], "reference holds no policy of robot 'mgr': run `dvc repro` first, or swarmtwin learn"),
        (["robot=mur"], "policies holds no policy of robot 'mur': run `dvc repro` first, or swarmtwin learn"),
        (["count=3"], "3 roll-outs are too few for an interval: ask for 10 or more"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_nothing(swarmtwin, workshop, options, message):
    answer = swarmtwin(*TRANSFER, *options, "output=out")
    assert answer.status == 2
    assert answer.error == f"swarmtwin experiment: {message}\n"
    assert not (workshop / "out").exists()
