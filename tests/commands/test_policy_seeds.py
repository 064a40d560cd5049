"""`swarmtwin experiment name=policy_seeds`: each seed is tried by itself, and counted by what is asked of it."""

import json

import numpy as np
import pandas as pd
import pytest

from swarmtwin.commands.app import run_command
from swarmtwin.policies.policy_folder import load_policy
from swarmtwin.policies.rollout_comparison import draw_scenarios
from swarmtwin.policies.training import Learner
from swarmtwin.standin.live import LiveVehicles
from swarmtwin.studies.policy_seeds.table import reached, seeds_figure, seeds_table
from swarmtwin.world.rollout import figures_of, play
from tiny_policies import simulation

SMALL = ("policy.layers=[16]", "policy.worlds=4", "policy.steps=40", "policy.random_steps=10", "policy.batch_size=32")
QUICK = ("evaluate_every=20", "scenes=4", "final_scenes=20", "seeds=2", "rollouts=12", "processes=1", "output=out")
AT_ONCE = ("task=obstacle", "sampled=false", "task.reach_mm=700", "task.steps=20")
SEEDS = ("name=policy_seeds", "simulation=kinematic", *AT_ONCE, *SMALL, *QUICK)


@pytest.fixture
def place(workplace, robots):
    """A current folder with a simulation of the MGR."""
    simulation(workplace / "kinematic", robots["mgr"])
    return workplace


def tried(seed, simulated, real, failed=None):
    """Two lines of table.csv."""
    figures = {"cpu_s": 7.0, "rollouts": 100, "collision": 0.01, "left_arena": 0.0, "failed": failed}
    return [
        {"seed": seed, **figures, "where": where, "success": share, "success_low": share - 0.02, "success_high": share}
        for where, share in (("simulation", simulated), ("other_vehicles", real))
    ]


ASKED = {"simulation": 0.98, "other_vehicles": 0.95}


def test_a_seed_counts_where_it_reaches_all_that_is_asked():
    table = pd.DataFrame([*tried(1, 0.98, 0.95), *tried(2, 1.0, 0.94), *tried(3, 0.97, 1.0)])
    assert reached(table, ASKED).to_dict() == {1: True, 2: False, 3: False}
    shown = seeds_table("title", table, ASKED)
    assert [row[-1] for row in shown.rows] == ["yes", "no", "no"]
    assert "1 of 3 seeds" in shown.caption
    assert "6 to 79 %" in shown.caption  # Wilson's interval of one in three


def test_a_seed_that_diverged_is_told_and_does_not_count():
    failed = {"seed": 2, "cpu_s": None, "where": None, "failed": "its weights were no longer finite"}
    table = pd.DataFrame([*tried(1, 1.0, 1.0), failed])
    assert reached(table, ASKED).to_dict() == {1: True, 2: False}
    assert seeds_table("title", table, ASKED).rows[1] == ["2", "", *[""] * 6, "its weights were no longer finite"]
    seeds_figure(table, ASKED)


def test_figures_are_those_of_each_seeds_policy(place, robots):
    assert run_command("experiment", list(SEEDS)) == 0
    table = pd.read_csv(place / "out" / "table.csv").set_index(["seed", "where"])
    assert list(table.index) == [(s, w) for s in (1, 2) for w in ("simulation", "other_vehicles")]
    assert (table.cpu_s > 0).all()
    for seed in (1, 2):
        stored = load_policy(place / "out" / "policies" / f"seed-{seed}", robots["mgr"])
        task = stored.build_task()
        scenario = draw_scenarios(task, 12, "rollout", 1)
        vehicles = LiveVehicles(robots["mgr"], ("2",), 12, 1, (), planned_steps=task.steps)
        rolled = figures_of(play(task, vehicles, scenario, stored.policy.act))
        row = table.loc[seed, "other_vehicles"]
        assert (row.success, row.collision) == pytest.approx((rolled.success.value, rolled.collision.value), abs=1e-4)
        assert row.reward == pytest.approx(rolled.reward, abs=1e-4)
    assert table.loc[1, "simulation"].reward != table.loc[2, "simulation"].reward
    metrics = json.loads((place / "out" / "metrics.json").read_text())
    asked = (table.success.unstack()[list(ASKED)] >= pd.Series(ASKED)).all(axis=1)
    assert metrics["seeds_as_asked"] == int(asked.sum())
    assert metrics["success"]["simulation"]["1"] == pytest.approx(table.loc[1, "simulation"].success, abs=1e-4)
    report = (place / "out" / "report.md").read_text()
    assert "20 in simulation" in report
    assert "12 on other vehicles" in report
    assert (place / "out" / "seeds.png").exists()


def test_broken_off_it_goes_on_and_says_no_time(place, monkeypatch):
    learn = Learner._evaluate

    def broken_off(learner):
        learn(learner)
        if learner.job.seed == 2:
            raise KeyboardInterrupt

    assert run_command("experiment", [*SEEDS[:-1], "output=whole"]) == 0
    with monkeypatch.context() as patched:
        patched.setattr(Learner, "_evaluate", broken_off)
        assert run_command("experiment", list(SEEDS)) != 0
    assert not (place / "out").exists()
    assert run_command("experiment", list(SEEDS)) == 0
    tables = [pd.read_csv(place / name / "table.csv") for name in ("whole", "out")]
    same = [table.drop(columns="cpu_s") for table in tables]
    pd.testing.assert_frame_equal(*same)
    assert np.isnan(tables[1].cpu_s[tables[1].seed == 1]).all()  # it had been learned before
    reports = [(place / name / "report.md").read_text() for name in ("whole", "out")]
    assert ["empty where it was broken off" in report for report in reports] == [False, True]


def test_where_every_seed_diverges_it_is_one_line(place, capsys):
    assert run_command("experiment", [*SEEDS, "policy.learning_rate=1e30"]) == 2
    assert "every seed has failed (seed 1: its weights were no longer finite" in " ".join(
        capsys.readouterr().err.split()
    )
    assert not (place / "out").exists()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("+asked.moon=0.9", "asked.moon: policies are not tried there"),
        ("rollouts=3", "too few for an interval"),
        ("simulation=nowhere", "nowhere"),
        ("robot=mur", "is a model of robot 'mgr'"),
        ("stand_ins.other_vehicles.vehicles=[]", "stand_ins.other_vehicles.vehicles"),
        ("+stand_ins.simulation={vehicles:[1]}", "'simulation' is where policies are learned"),
        ("randomisation={gain_change:{}}", "no range at all"),
        ("starts=2", "policy.steps=40 leaves none to the one that goes on"),
    ],
)
def test_what_cannot_be_done_is_refused_before_anything_is_learned(place, capsys, change, words):
    assert run_command("experiment", [*SEEDS, change]) != 0
    assert words in " ".join(capsys.readouterr().err.split())
    assert not (place / "out").exists()
