"""Tables 5 and 6: the gap of a simulation is what was planted, and nothing where the real world is that simulation."""

import json

import numpy as np
import pandas as pd
import pytest
import yaml

from swarmtwin.errors import UserError
from swarmtwin.policies.rollout_comparison import draw_scenarios
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.simulation.simulation_folder import load_simulation
from swarmtwin.studies.reality_gap.gap_plots import draw_gaps, gaps_figure, learning_figure
from swarmtwin.studies.reality_gap.gap_rollouts import PolicyRollouts, gap_metrics, gap_rows
from swarmtwin.studies.reality_gap.gap_table import gap_lines, gap_markdown
from swarmtwin.studies.reality_gap.options import PublishedRow, StandIns
from swarmtwin.studies.reality_gap.same_starts import RandomCommands, roll_out_everywhere, stand_in_motions
from swarmtwin.world.motion import SimulatedMotion
from tiny_policies import CONF, robot_named, seeker, simulation, task_named

COUNT = 12


@pytest.fixture(scope="module")
def kinematic(tmp_path_factory):
    """A simulation of the MGR."""
    return load_simulation(simulation(tmp_path_factory.mktemp("model") / "kinematic", robot_named("mgr")))


@pytest.fixture(scope="module")
def task():
    return task_named("obstacle").build(robot_named("mgr"))


@pytest.fixture(scope="module")
def pair():
    return task_named("collective", vehicles=2, steps=100).build(robot_named("mgr"))


def rollouts(task, real, kinematic, act=None):
    """Roll a policy out in the simulation and in another that plays the real world."""
    motions = {"model": kinematic, "robots": real}
    made = {name: (lambda one=one: SimulatedMotion(one, COUNT, task.vehicles)) for name, one in motions.items()}
    policy = act or seeker(task.robot, task.config).act
    played = roll_out_everywhere(task, draw_scenarios(task, COUNT, "rollout", 1), made, lambda: policy)
    return PolicyRollouts("scripted", {"model": played["model"]}, {"robots": played["robots"]})


def test_there_is_no_gap_where_the_real_world_is_the_simulation(task, kinematic):
    _, row = gap_rows(rollouts(task, kinematic, kinematic))
    assert (row["gap"], row["gap_low"], row["gap_high"], row["gap_percent"]) == (0.0, 0.0, 0.0, 0.0)


class Weaker(Simulation):
    """The same vehicles at half the command."""

    def step(self, state, command, *arguments, **options):
        return super().step(state, 0.5 * command, *arguments, **options)


def test_slower_vehicles_earn_less_and_the_gap_is_the_difference_of_the_mean_rewards(task, kinematic):
    found = rollouts(task, Weaker(kinematic.dynamics), kinematic)
    simulated, real = gap_rows(found)
    assert real["gap"] == pytest.approx(real["reward"] - simulated["reward"])
    assert real["gap_low"] < real["gap"] < real["gap_high"] < 0
    assert real["gap_percent"] == pytest.approx(100 * real["gap"] / abs(simulated["reward"]))
    metrics = gap_metrics(found, "model")
    assert metrics["robots"]["reality_gap"]["value"] == real["gap"]
    assert metrics["simulation"]["success"]["value"] == simulated["success"]


def test_the_figures_of_the_table_are_those_of_the_saved_rollouts(task, kinematic, tmp_path):
    made = rollouts(task, Weaker(kinematic.dynamics), kinematic)
    made.save(tmp_path)
    loaded = PolicyRollouts.load(tmp_path / made.file_name, {"model": "its folder"})
    assert (loaded.policy, list(loaded.simulated), list(loaded.real)) == ("scripted", ["model"], ["robots"])
    pd.testing.assert_frame_equal(pd.DataFrame(gap_rows(loaded)), pd.DataFrame(gap_rows(made)))
    played = {name: one.reward.mean(axis=2).sum(axis=0) / one.counted.sum(axis=0) for name, one in loaded.real.items()}
    _, row = gap_rows(loaded)
    assert row["reward"] == pytest.approx(played["robots"].mean())
    assert row["reward_sd"] == pytest.approx(played["robots"].std())


def test_random_commands_are_the_same_wherever_they_begin_anew(task, kinematic):
    motions = {name: (lambda: SimulatedMotion(kinematic, COUNT, task.vehicles)) for name in ("one", "other")}
    scenario = draw_scenarios(task, COUNT, "rollout", 1)
    played = roll_out_everywhere(task, scenario, motions, lambda: RandomCommands(task.robot, 3).act)
    np.testing.assert_array_equal(played["one"].command, played["other"].command)
    low, high = task.robot.command_low, task.robot.command_high
    assert np.all((played["one"].command >= low) & (played["one"].command <= high))
    assert played["one"].command.std() == pytest.approx((high - low).mean() / np.sqrt(12), rel=0.02)


def test_the_first_stand_ins_of_a_group_drive(pair):
    groups = {"four": StandIns(vehicles=("1", "2", "3", "4")), "two": StandIns(vehicles=("1", "2"))}
    motions = stand_in_motions(groups, pair, COUNT, seed=1)
    start = draw_scenarios(pair, COUNT, "rollout", 1).start
    poses = [motions[name]().place(np.arange(COUNT), start) for name in groups]
    np.testing.assert_array_equal(*poses)


@pytest.mark.parametrize(
    ("group", "message"),
    [
        ({"vehicles": ["1"]}, r"stand_ins\.other\.vehicles are 1, task 'collective' is for 2: give 2 ids or more"),
        ({"vehicles": ["1", "1"]}, "vehicle '1' is named twice"),
        ({"vehicles": ["1", "2"], "effects": [{"name": "ice"}]}, "unknown effect 'ice'"),
    ],
)
def test_stand_ins_that_make_no_sense_are_refused(pair, group, message):
    with pytest.raises(UserError, match=message):
        stand_in_motions({"other": StandIns.parse(group, "options")}, pair, COUNT, seed=1)


def test_the_papers_figures_stand_under_ours_and_a_simulation_without_a_policy_says_why(task, kinematic):
    found = rollouts(task, kinematic, kinematic)
    learned = PolicyRollouts("learned", found.simulated, found.real)
    table = pd.DataFrame([*gap_rows(learned), *gap_rows(found)])
    published = {"model": PublishedRow(simulator=(-0.32, 0.15), real_world=(-0.58, 0.20), success=0.2)}
    lines = gap_lines(table, {"hopeless": "seed 1: it never succeeded", "model": None}, published)
    assert [line.policy for line in lines] == ["learned", "learned", "the paper's", "scripted"]
    assert lines[0][1:3] == ("hopeless", "no policy")
    assert lines[0].gap == "seed 1: it never succeeded"
    assert lines[2][2:] == ("-0.32 ± 0.15", "", "robots", "-0.58 ± 0.20", "20%", "-0.26")
    assert lines[1].simulated_reward == f"{table.reward[0]:.2f} ± {table.reward_sd[0]:.2f}"
    shown = gap_markdown("table 5", lines, COUNT, ["figure14_CR-Net-S.png"]).splitlines()
    assert shown[0] == "# Table 5"
    assert shown[-1] == "![figure14 CR-Net-S](figure14_CR-Net-S.png)"
    assert [row.count("|") for row in shown if row.startswith("|")] == [9] * 6


def test_pictures_show_the_gaps_and_every_simulation(task, kinematic):
    table = pd.DataFrame(gap_rows(rollouts(task, Weaker(kinematic.dynamics), kinematic)))
    (panel,) = gaps_figure(table, ["hopeless", "model"]).axes
    assert [label.get_text() for label in panel.get_yticklabels()] == ["hopeless", "model"]
    drawn = panel.containers[0].lines[0]
    assert drawn.get_xdata()[1] == pytest.approx(table.gap[1])
    rows = [
        {"simulation": name, "seed": 1, "step": step, "success": 0.5, "collision": 0.0, "reward": -1.0}
        for name in ("a", "b")
        for step in (10, 20)
    ]
    first = learning_figure(pd.DataFrame(rows), ["a", "b"]).axes[0]
    assert [line.get_label() for line in first.lines] == ["a", "b"]


def test_the_picture_of_a_rollout_bears_the_number_of_the_papers_figure(task, kinematic, tmp_path):
    found = rollouts(task, kinematic, kinematic)
    options = yaml.safe_load((CONF / "experiment" / "table6.yaml").read_text())
    options |= {"simulations": {"model": "its folder"}, "task": {"name": "pair"}}
    (tmp_path / "provenance.json").write_text(json.dumps({"command": "experiment", "config": options}))
    (tmp_path / "rollouts").mkdir()
    PolicyRollouts("learned", found.simulated, found.real).save(tmp_path / "rollouts")
    pd.DataFrame(gap_rows(found)).to_csv(tmp_path / "table.csv")
    rows = {"simulation": ["model"], "seed": [1], "step": [10], "success": [0.5], "collision": [0.0], "reward": [-1.0]}
    pd.DataFrame(rows).to_csv(tmp_path / "learning.csv")
    draw_gaps(tmp_path, tmp_path)
    assert {file.name for file in tmp_path.glob("*.png")} == {"gaps.png", "learning.png", "figure17_model.png"}


def test_metrics_are_plain_json(task, kinematic):
    random = RandomCommands(task.robot, 1)
    metrics = gap_metrics(rollouts(task, kinematic, kinematic, random.act), "model")
    assert json.loads(json.dumps(metrics, allow_nan=False)) == metrics
