"""`swarmtwin rollout`: the same starts in the simulation and on stand-ins, side by side."""

import json

import av
import numpy as np
import pandas as pd
import pytest

from swarmtwin.policies.policy_folder import load_policy
from swarmtwin.tracking.registry import folder_digest
from swarmtwin.world.rollout import chosen_world
from tiny_policies import save_seeker, simulation

ROLLOUT = ("rollout", "policy=seeker", "count=12", "video=false", "viewer=false")


@pytest.fixture
def seeker(workshop, robots):
    """A policy for two vehicles, made by hand, and the simulation it names."""
    digest = folder_digest(simulation(workshop / "kinematic", robots["mgr"]))
    return save_seeker(workshop / "seeker", source="kinematic", digest=digest)


@pytest.fixture
def undrawn(monkeypatch):
    """Leave the picture out."""
    monkeypatch.setattr("swarmtwin.commands.rollout.draw_rollout", lambda made, output: None)


@pytest.mark.usefixtures("seeker")
def test_both_worlds_start_alike_and_are_told_side_by_side(swarmtwin, workshop):
    answer = swarmtwin(*ROLLOUT, "video=true", "viewer=true", "speed=16", "output=out")
    assert answer.status == 0, answer.error
    files = sorted(path.name for path in (workshop / "out").iterdir())
    drawn = ["rollout.mp4", "rollouts.html", "rollouts.png"]
    assert files == sorted(["metrics.json", "provenance.json", "rollouts.npz", "rollouts.parquet", *drawn])
    metrics = json.loads((workshop / "out" / "metrics.json").read_text())
    assert metrics["simulation"]["rollouts"] == metrics["stand_in"]["rollouts"] == 12
    steps = pd.read_parquet(workshop / "out" / "rollouts.parquet")
    start = steps[steps.time_s == 0].pivot(index=["rollout", "vehicle"], columns="world", values="x_mm")
    assert np.abs(start.simulation - start.stand_in).max() < 6  # the camera's noise
    for world in ("simulation", "stand_in"):
        own = steps[(steps.world == world) & (steps.time_s > 0)]
        assert own.reward.mean() == pytest.approx(metrics[world]["reward"]["mean"])
        assert own[["left", "right"]].abs().max(axis=None) <= 120
    with av.open(str(workshop / "out" / "rollout.mp4")) as film:
        assert film.streams.video[0].frames > 50
    page = (workshop / "out" / "rollouts.html").read_text()
    assert "All 12 roll-outs, from the worst to the best on stand-ins, each from the same start" in page
    assert "reward on stand-ins against simulation:" in answer.shown


@pytest.mark.usefixtures("seeker", "undrawn")
def test_the_same_seed_gives_the_same_rollouts_and_another_seed_others(swarmtwin, workshop):
    for output, seed in (("one", 3), ("again", 3), ("other", 4)):
        assert swarmtwin(*ROLLOUT, f"seed={seed}", f"output={output}").status == 0
    one, again, other = (pd.read_parquet(workshop / name / "rollouts.parquet") for name in ("one", "again", "other"))
    pd.testing.assert_frame_equal(one, again)
    assert not one.equals(other)


@pytest.mark.usefixtures("seeker", "undrawn")
def test_an_effect_changes_the_stand_ins_and_not_the_simulation(swarmtwin, workshop):
    assert swarmtwin(*ROLLOUT, "output=clean").status == 0
    assert swarmtwin(*ROLLOUT, "effects=[{name: gain_change, gain: 0.6}]", "output=weak").status == 0
    clean, weak = (json.loads((workshop / name / "metrics.json").read_text()) for name in ("clean", "weak"))
    assert clean["simulation"] == weak["simulation"]
    assert weak["stand_in"]["reward"]["mean"] < clean["stand_in"]["reward"]["mean"]


@pytest.mark.usefixtures("seeker", "undrawn")
def test_what_is_randomised_changes_the_simulation_and_not_the_stand_ins(swarmtwin, workshop):
    weak = "randomisation={gain_change: {gain: [0.3, 0.5]}}"
    for name, options in (("usual", []), ("weak", [weak, "draws=4", "sampled=false"])):
        answer = swarmtwin(*ROLLOUT, *options, f"output={name}")
        assert answer.status == 0, answer.error
    usual, changed = (json.loads((workshop / name / "metrics.json").read_text()) for name in ("usual", "weak"))
    assert changed["stand_in"] == usual["stand_in"]
    steps = {name: pd.read_parquet(workshop / name / "rollouts.parquet") for name in ("usual", "weak")}
    first_mm = {}
    for name, table in steps.items():
        places = table[(table.world == "simulation") & (table.time_s <= 0.5)].sort_values("time_s")
        ends = [places.groupby(["rollout", "vehicle"])[["x_mm", "y_mm"]].nth(place).to_numpy() for place in (0, 1)]
        first_mm[name] = np.hypot(*(ends[1] - ends[0]).T)
    share = (first_mm["weak"] / first_mm["usual"]).reshape(12, 2)
    assert ((share > 0.28) & (share < 0.52)).all()
    assert share[:, 0] == pytest.approx(share[:, 1], rel=0.05)  # of: world
    assert share[:, 0].std() > 0.02


@pytest.mark.usefixtures("seeker")
def test_one_world_alone_needs_no_other(swarmtwin, workshop):
    assert swarmtwin(*ROLLOUT, "on=[stand_in]", "vehicles=[7,9]", "simulation=nowhere", "output=out").status == 0
    metrics = json.loads((workshop / "out" / "metrics.json").read_text())
    assert "simulation" not in metrics
    assert "reward_difference_percent" not in metrics


def test_what_is_shown_is_what_was_asked_for(seeker, robots):
    class Played:
        success = np.array([True, False, True, False])
        mean_reward = np.array([-2.0, -4.0, -1.0, -0.5])

        def __len__(self):
            return 4

    assert load_policy(seeker, robots["mgr"]).task.vehicles == 2
    assert [chosen_world(Played(), show) for show in ("worst", "best", "typical")] == [1, 2, 2]


def test_the_scripted_policy_needs_no_learning(swarmtwin, workshop, robots):
    simulation(workshop / "kinematic", robots["mgr"])
    scripted = ("rollout", "policy=scripted", "task=formation", "task.changes={steps: 60}", "simulation=kinematic")
    answer = swarmtwin(*scripted, "on=[simulation]", "count=12", "video=false", "output=out")
    assert answer.status == 0, answer.error
    metrics = json.loads((workshop / "out" / "metrics.json").read_text())
    assert metrics["task"] == "formation"
    assert metrics["simulation"]["success"]["value"] >= 0.9


def test_a_policy_that_sees_its_nearest_neighbours_drives_any_number_of_them(swarmtwin, workshop, robots):
    digest = folder_digest(simulation(workshop / "kinematic", robots["mgr"]))
    save_seeker(workshop / "seeker", source="kinematic", digest=digest, sees_nearest=3, sees_within_mm=400.0)
    many = (
        "task.vehicles=50",
        "task.arena_mm={x: [0, 3600], y: [0, 3600]}",
        "task.changes={reach_mm: 800, steps: 120}",
    )
    answer = swarmtwin(*ROLLOUT, *many, "on=[simulation]", "output=out")
    assert answer.status == 0, answer.error
    steps = pd.read_parquet(workshop / "out" / "rollouts.parquet")
    assert steps.vehicle.max() == 50
    assert steps.x_mm.max() > 3000


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["count=5"], "5 roll-outs are too few for an interval: ask for 10 or more"),
        (["vehicles=[2,3,4]"], "vehicles=[2,3,4] are 3, task 'collective' is for 2: give 2 ids, or none"),
        (["vehicles=[2,2]"], "vehicle '2' is named twice: give each id once"),
        (["policy=nowhere"], "no model folder nowhere: give a folder, models:/NAME@ALIAS or models:/NAME/VERSION"),
        (["policy=mlp"], "no policy in mlp: policy.yaml is missing; name a folder that learn made"),
        (["robot=mur"], "seeker is a policy of robot 'mgr': add robot=mgr"),
        (["simulation=nowhere"], "no model folder nowhere"),
        (
            ["on=[stand_in]", "randomisation={command_loss: {probability: [0, 0.1]}}"],
            "randomisation=... is of the simulation: add on=[simulation], or leave it out",
        ),
        (
            ["randomisation={command_loss: {probability: [0, 2]}}"],
            "randomisation.command_loss.probability: [0, 2] is not",
        ),
        (["randomisation=nowhere"], "nowhere"),
        (["effects=[{name: gain_chang}]"], "effects: unknown effect 'gain_chang': did you mean 'gain_change'?"),
        (["policy=scripted"], "policy=scripted is for any task: add task=NAME, one of collective, "),
        (["policy=scripted", "task=formtion"], "no such task: 'formtion': did you mean 'formation'?"),
        (
            ["policy=scripted", "task=formation", "robot=mur"],
            "task 'formation': collision_mm 100 is less than the width",
        ),
        (["task.vehicles=3"], "seeker looks at 10 numbers, and a vehicle of 3 observes 15, of every other one"),
        (["task.changes={reech_mm: 1}"], "task 'collective': unknown field 'reech_mm': did you mean 'reach_mm'?"),
        (["on=[]"], "options: field 'on': Tuple should have at least 1 item"),
        (["policy=models:/mgr-policy@champion"], "no registered model 'mgr-policy'"),
    ],
)
@pytest.mark.usefixtures("seeker")
def test_a_mistake_is_one_line_and_leaves_nothing(swarmtwin, model, workshop, options, message):
    model("mlp")
    answer = swarmtwin(*ROLLOUT, *options, "output=out")
    assert answer.status == 2
    assert answer.error.startswith(f"swarmtwin rollout: {message}")
    assert len(answer.error.strip().splitlines()) == 1
    assert not (workshop / "out").exists()


def test_a_simulation_that_is_gone_or_changed_is_told(swarmtwin, workshop, robots, caplog):
    save_seeker(workshop / "seeker", source="kinematic")
    answer = swarmtwin(*ROLLOUT, "output=out")
    assert answer.status == 2
    assert answer.error == (
        "swarmtwin rollout: the simulation that seeker was learned in: no model folder kinematic: give a folder, "
        "models:/NAME@ALIAS or models:/NAME/VERSION; or add simulation=...\n"
    )
    simulation(workshop / "kinematic", robots["mgr"])
    assert swarmtwin(*ROLLOUT, "output=out").status == 0
    assert "kinematic is no longer the model that seeker was learned in" in caplog.messages
