"""`swarmtwin experiment name=table5` and `name=table6`: what they leave, that they go on, and what they refuse."""

import hashlib
import json

import numpy as np
import pandas as pd
import pytest
import torch

from exact_model import conditions_of, mechanisms
from swarmtwin.commands.app import run_command
from swarmtwin.dynamics.provenance import Provenance
from swarmtwin.learning.ensemble import Ensemble
from swarmtwin.policies.policy_folder import load_policy
from swarmtwin.policies.training import Learner
from swarmtwin.simulation.ensemble_dynamics import EnsembleDynamics, ensemble_encoding
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.simulation.simulation_folder import save_extended
from swarmtwin.studies.reality_gap import measured_gaps
from swarmtwin.world.rollout_storage import load_rollouts
from tiny_policies import simulation

SIMULATIONS = ("~simulations.FC-NN", "~simulations.CR-Net-R", "simulations.CR-Net-S=kinematic")
SMALL = ("policy.layers=[16]", "policy.worlds=4", "policy.steps=40", "policy.random_steps=10", "policy.batch_size=32")
QUICK = (*SIMULATIONS, *SMALL, "evaluate_every=20", "scenes=4", "seeds=1", "rollouts=10", "output=out")
AT_ONCE = ("task.reach_mm=700", "task.steps=20")
TABLE5 = ("experiment", "name=table5", "open_loop=null", *AT_ONCE, *QUICK)
"""Wherever a vehicle starts, it is at the target: a policy that has learned nothing succeeds."""


@pytest.fixture
def place(workplace, robots):
    """A current folder with a simulation of the MGR."""
    simulation(workplace / "kinematic", robots["mgr"])
    return workplace


def extend(folder, robot):
    """Save a simulation that a diagnosis could have extended: every command is late."""
    conditions = conditions_of(robot)
    inputs = ("command", "pose")
    _, groups = ensemble_encoding(robot, inputs, (60.0,), conditions)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        base = EnsembleDynamics(robot, inputs, (60.0,), conditions, Ensemble(2, groups).eval())
    folder.mkdir()
    late = mechanisms(command_delay={"delay_s": 0.2})
    provenance = Provenance.read(folder.with_name("kinematic")).model_dump(mode="json")
    save_extended(folder, Simulation(base, late, conditions), provenance)


def digests(folder):
    return {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in folder.glob("*.png")}


def test_the_table_holds_what_the_saved_policies_and_rollouts_yield(place, robots, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    extend(place / "late", robots["mgr"])
    assert run_command(TABLE5[0], [*TABLE5[1:], "+simulations.extended=late"]) == 0
    shown, out = capsys.readouterr().out, place / "out"
    table = pd.read_csv(out / "table.csv").set_index(["policy", "simulation", "where"])
    groups = ["own_vehicle", "other_vehicle", "other_floor"]
    metrics = json.loads((out / "metrics.json").read_text())["simulations"]
    for name in ("CR-Net-S", "extended"):
        rollouts = load_rollouts(out / "rollouts" / f"learned in {name}.npz")
        assert list(rollouts) == [name, *groups]
        rewards = {
            where: one.reward.mean(axis=2).sum(axis=0) / one.counted.sum(axis=0) for where, one in rollouts.items()
        }
        for where in groups:
            row = table.loc["learned", name, where]
            assert row.reward == pytest.approx(rewards[where].mean())
            assert row.gap == pytest.approx(rewards[where].mean() - rewards[name].mean())
            assert row.gap == metrics[name]["policies"]["learned"][where]["reality_gap"]["value"]
            assert row.success == rollouts[where].success.mean()
        policy = load_policy(out / "policies" / name)
        start = rollouts["own_vehicle"]
        observed = policy.build_task().observe(start.scenario, start.pose[0])
        np.testing.assert_allclose(policy.act(observed), start.command[0], rtol=1e-6)
    scripted = table.loc["scripted"].reward
    assert scripted["CR-Net-S", "own_vehicle"] == scripted["extended", "own_vehicle"]
    assert (table.rollouts == 10).all()
    assert (
        "| the paper's | CR-Net-S | -0.26 ± 0.04 |  | robots | -0.22 ± 0.04 | 100% | +0.04 |"
        in (out / "report.md").read_text()
    )
    assert max(map(len, shown.splitlines())) <= 80
    assert "own_vehicle" in shown
    first = digests(out)
    assert set(first) == {"gaps.png", "learning.png", "figure14_CR-Net-S.png", "figure14_extended.png"}
    assert run_command("experiment", ["name=pictures", "folder=out", "output=again"]) == 0
    assert digests(place / "again") == first


def test_an_interrupted_one_goes_on_with_the_policies_it_has_learned(place, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(measured_gaps, "draw_scenarios", interrupt)
        assert run_command(TABLE5[0], TABLE5[1:]) == 130
    assert not (place / "out").exists()
    with monkeypatch.context() as patch:
        patch.setattr(Learner, "_train_until_next_evaluation", interrupt)
        assert run_command(TABLE5[0], [*TABLE5[1:], "pictures=false"]) == 0
    assert (place / "out" / "policies" / "CR-Net-S" / "policy.yaml").exists()
    assert not list((place / "out").glob("*.png"))


def interrupt(*_):
    raise KeyboardInterrupt


def test_a_simulation_in_which_nothing_is_learned_is_a_result(place):
    assert run_command("experiment", ["name=table6", "pictures=false", "task.vehicles=2", "task.steps=40", *QUICK]) == 0
    metrics = json.loads((place / "out" / "metrics.json").read_text())
    assert metrics["task"] == "collective"
    found = metrics["simulations"]["CR-Net-S"]
    assert found["failed"] == "seed 1: it never succeeded in the final scenarios"
    assert set(found["policies"]) == {"scripted", "random"}
    text = (place / "out" / "report.md").read_text()
    assert "| learned | CR-Net-S | no policy |  |  |  |  | seed 1: it never succeeded" in text
    assert "| the paper's | CR-Net-S | -3.13 ± 0.26 |" in text


@pytest.mark.end_to_end
def test_two_underwater_robots_have_a_table_in_which_the_paper_has_no_line(place, robots):
    simulation(place / "kinematic", robots["mur"])
    options = ["name=table6", "robot=mur", "task=pair", "task.targets=1", "task.steps=40", "pictures=false", *QUICK]
    assert run_command("experiment", options) == 0
    table = pd.read_csv(place / "out" / "table.csv")
    assert set(table["where"]) == {"simulation", "own_vehicle", "other_vehicles", "other_floor"}
    assert "| the paper's |" not in (place / "out" / "report.md").read_text()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["rollouts=9"], "9 roll-outs are too few for an interval: ask for 10 or more"),
        (["simulations.CR-Net-S=none"], "no model folder none: give a folder, models:/NAME@ALIAS or models:/NAME/VERS"),
        (["robot=mur", "task=pair"], "kinematic is a model of robot 'mgr': add robot=mgr"),
        (["+simulations.CR-Net-T=models:/mgr-dynamics@champion"], "no registered model 'mgr-dynamics'"),
        (["+simulations.a/b=kinematic"], "simulations.a/b"),
        (["+simulations.own_vehicle=kinematic"], "'own_vehicle' names a simulation and stand-ins: give them different"),
        (["~simulations.CR-Net-S"], "field 'simulations'"),
        (["simulations=null"], "field 'simulations'"),
        (["simulations.CR-Net-S=null"], "field 'simulations.CR-Net-S'"),
        (["stand_ins.own_vehicle.vehicles=[]"], "field 'stand_ins.own_vehicle.vehicles'"),
        (["stand_ins.other_floor.effects=[{name: ice}]"], "unknown effect 'ice'"),
        (["task.vehicles=2"], "task: field 'vehicles': Input should be 1, got 2"),
        (["policy.steps=0"], "steps"),
        (["steps=100"], "unknown option 'steps': did you mean"),
        (["open_loop=none"], "no recording folder none"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_nothing(place, capsys, options, message):
    given = [option for option in TABLE5[1:] if option != "simulations.CR-Net-S=kinematic" or "~" not in options[0]]
    assert run_command("experiment", [*given, *options]) == 2
    error = capsys.readouterr().err
    assert message in error.splitlines()[-1]
    assert not (place / "out").exists()
