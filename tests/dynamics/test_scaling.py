import numpy as np
import pytest
import torch

from swarmtwin import compilable
from swarmtwin.learning.encoding import Encoding, Scaling
from swarmtwin.learning.situation import ALL_PARTS, Situation
from swarmtwin.robot import Arena
from toy import toy_transitions


@pytest.mark.parametrize("method", ["unit_range", "standard", "physical"])
def test_scaling_can_be_undone(method):
    values = torch.randn(200, 4, dtype=torch.float64) * torch.tensor([1e-3, 1, 50, 1e4]) + torch.tensor(
        [0, 5, -100, 1e4]
    )
    scaling = Scaling(4, method).double()
    scaling.learn(values)
    torch.testing.assert_close(scaling.inverse(scaling(values)), values)


def test_scalings_are_what_they_say():
    values = torch.randn(500, 2, dtype=torch.float64) * 7 + 3
    unit, standard, physical = (Scaling(2, method).double() for method in ("unit_range", "standard", "physical"))
    for scaling in (unit, standard, physical):
        scaling.learn(values)
    assert unit(values).min() == 0
    assert unit(values).max() == 1
    torch.testing.assert_close(standard(values).mean(dim=0), torch.zeros(2, dtype=torch.float64))
    torch.testing.assert_close(standard(values).std(dim=0, correction=0), torch.ones(2, dtype=torch.float64))
    assert torch.equal(physical(values), values)


def test_a_column_that_does_not_vary_stays_finite():
    values = torch.full((10, 1), 0.5)
    for method in ("unit_range", "standard"):
        scaling = Scaling(1, method)
        scaling.learn(values)
        assert torch.equal(scaling(values), torch.zeros(10, 1))


def test_the_inputs_are_ordered_as_in_the_authors_code(robots):
    encoding = Encoding.for_network(robots["mur"], ("command", "pose"), "unit_range")
    situation = Situation(command=torch.tensor([[4.0, 5.0, 6.0]]), pose=torch.tensor([[1.0, 2.0, 3.0]]))
    assert encoding(situation).tolist() == [[1, 2, 3, 4, 5, 6]]


def test_standardised_headings_do_not_jump_at_the_half_turn(robots):
    encoding = Encoding.for_network(robots["mur"], ("command", "pose"), "standard")
    encoding.learn(Situation.from_transitions(toy_transitions(robots["mur"], 500, mean=np.zeros_like)))
    command = torch.zeros(2, 3)
    pose = torch.tensor([[500.0, 500.0, np.pi - 1e-4], [500.0, 500.0, -np.pi + 1e-4]])
    before, after = encoding(Situation(command=command, pose=pose))
    torch.testing.assert_close(before, after, rtol=0, atol=1e-3)


def test_a_missing_previous_command_is_taken_for_the_usual_one(robots):
    encoding = Encoding.for_network(robots["mgr"], ("command", "previous_command"), "standard")
    situation = Situation.from_transitions(toy_transitions(robots["mgr"], 500))
    encoding.learn(situation)
    missing = situation.previous_command.isnan()
    assert missing.any()
    inputs = encoding(situation)
    assert inputs.isfinite().all()
    torch.testing.assert_close(inputs[:, 2:][missing], torch.zeros(int(missing.sum())), rtol=0, atol=1e-5)


def test_a_missing_earlier_command_is_taken_for_the_usual_one(robots):
    encoding = Encoding.for_network(robots["mgr"], ("command", "earlier_command"), "physical")
    situation = Situation.from_transitions(toy_transitions(robots["mgr"], 500))
    encoding.learn(situation)
    missing = situation.earlier_command.isnan().any(dim=1)
    assert int(missing.sum()) == 2 * 10
    inputs = encoding(situation)
    assert torch.equal(inputs[~missing, 2:], situation.earlier_command[~missing])
    usual = situation.earlier_command[~missing].mean(dim=0)
    torch.testing.assert_close(inputs[missing, 2:], usual.expand(20, 2), rtol=0, atol=1e-3)


def test_an_unknown_velocity_is_taken_for_the_usual_one_and_for_rest_by_limits(robots):
    robot = robots["mgr"]
    velocity = torch.tensor([[10.0, 2.0, 0.1], [torch.nan] * 3, [30.0, -2.0, 0.5]])
    situation = Situation(torch.zeros(3, 2), velocity=velocity)
    encoding = Encoding.for_network(robot, ("command", "velocity"), "physical")
    encoding.learn(situation)
    expected = torch.tensor([[10.0, 2.0, 0.1], [20.0, 0.0, 0.3], [30.0, -2.0, 0.5]])
    torch.testing.assert_close(encoding(situation)[:, 2:], expected)
    by_limits = Encoding.by_limits(robot, ("command", "velocity"), (), 0.2)
    by_limits.learn(situation)
    torch.testing.assert_close(by_limits(situation)[0, 2:], torch.tensor([10 / 100, 2 / 50, 0.1 / 2.8]))  # over 0.5 s
    assert not by_limits(situation)[1, 2:].any()


def test_only_an_encoding_that_takes_the_earlier_command_keeps_the_usual_one(robots):
    """Else weights saved by an earlier version would not load."""
    kept = {"usual_previous_command", "scaling.offset", "scaling.scale"}
    without, taking = (
        Encoding.for_network(robots["mgr"], ("command", *parts), "standard")
        for parts in (("previous_command",), ALL_PARTS)
    )
    assert set(without.state_dict()) == kept
    assert set(taking.state_dict()) == {*kept, "usual_earlier_command", "usual_velocity"}


def test_neighbours_enter_as_a_set_of_any_size_and_order(robots):
    robot = robots["mgr"]
    encoding = Encoding(robot, ("command", "neighbours"), "physical", neighbour_reach_mm=100.0)
    around = torch.tensor([[[100.0, 0, 0], [0, 50, 1]], [[0, 50, 1], [100, 0, 0]], [[torch.nan] * 3, [100, 0, 2]]])
    situation = Situation(command=torch.tensor([[4.0, 5.0]]).expand(3, 2), neighbours=around)
    ahead, left = np.exp(-1), np.exp(-0.5)
    expected = [[4, 5, ahead, left], [4, 5, ahead, left], [4, 5, ahead, 0]]
    torch.testing.assert_close(encoding(situation), torch.tensor(expected, dtype=torch.float32))
    alone = Situation(command=torch.tensor([[4.0, 5.0]]), neighbours=torch.zeros(1, 0, 3))
    assert encoding(alone).tolist() == [[4, 5, 0, 0]]


def test_limits_are_the_robots_the_arenas_and_the_sessions(robots):
    robot = robots["mgr"]
    arena = Arena(x=(0, 400), y=(-100, 100))
    features = ("previous_command", "position", "direction", "elapsed_s", "duration_s", "command")
    encoding = Encoding(robot, features, "limits", arena_mm=arena, session_s=50, weights={"position": 0.5})
    situation = Situation(
        command=torch.tensor([[-120.0, 60.0], [0.0, 0.0]]),
        previous_command=torch.tensor([[torch.nan] * 2, [120.0, 0.0]]),
        pose=torch.tensor([[400.0, 100, 0], [200, -100, np.pi / 2]]),
        elapsed_s=torch.tensor([0.0, 25]),
        duration_s=torch.tensor([robot.period_s, 1.1 * robot.period_s]),
    )
    expected = [[0, 0, 0.5, 0.5, 1, 0, -1, 0, -1, 0.5], [1, 0, 0, -0.5, 0, 1, 0, 1, 0, 0]]
    torch.testing.assert_close(encoding(situation), torch.tensor(expected, dtype=torch.float32), atol=1e-6, rtol=0)
    assert not encoding.state_dict()
    before = encoding(situation)
    encoding.learn(situation)
    assert torch.equal(encoding(situation), before)
    assert encoding.columns_of("elapsed_s") == [6]
    assert encoding.columns_of("walls") == []


def test_walls_look_the_same_from_every_corner(robots):
    """Turned by half a turn about the middle of the arena, a vehicle sees the same walls."""
    robot = robots["mur"]
    encoding = Encoding(robot, ("walls",), "limits", wall_reaches_mm=(50.0, 200.0))
    random = np.random.default_rng(0)
    low, high = robot.arena_mm.low_mm, robot.arena_mm.high_mm
    pose = np.column_stack([random.uniform(low, high, (50, 2)), random.uniform(-3, 3, 50)])
    turned = np.array([*(low + high), np.pi]) + pose * [-1, -1, 1]
    seen = [encoding(Situation(torch.zeros(50, 3), pose=torch.as_tensor(place))) for place in (pose, turned)]
    assert encoding.width == 10
    torch.testing.assert_close(*seen, atol=1e-5, rtol=1e-4)


def test_a_wall_ahead_differs_from_a_wall_behind(robots):
    robot = robots["mur"]
    encoding = Encoding(robot, ("walls",), "limits", wall_reaches_mm=(50.0,))
    x_mm, y_mm = robot.arena_mm.high_mm[0] - 10, robot.arena_mm.high_mm[1] / 2
    poses = torch.tensor([[x_mm, y_mm, 0.0], [x_mm, y_mm, np.pi]])
    ahead, behind = encoding(Situation(torch.zeros(2, 3), pose=poses))
    assert ahead[1] > 0.5
    assert behind[1] < -0.5
    torch.testing.assert_close(ahead[0], behind[0])


def test_situations_are_taken_by_index_and_type(robots):
    transitions = toy_transitions(robots["mgr"], 20)
    situation = Situation.from_transitions(transitions)
    assert {part: getattr(situation, part).dtype for part in ALL_PARTS} == dict.fromkeys(ALL_PARTS, torch.float32)
    assert Situation.from_transitions(transitions, dtype=torch.float64).pose.dtype == torch.float64
    rows = torch.tensor([3, 1])
    chosen = situation[rows]
    assert len(chosen) == 2
    np.testing.assert_allclose(chosen.elapsed_s, transitions.time_s[[3, 1]])
    np.testing.assert_allclose(chosen.pose, transitions.pose[[3, 1]], rtol=1e-6)
    assert Situation.from_transitions(transitions, ("command",)).pose is None


def test_walls_are_seen_alike_in_one_compiled_pass(robots, monkeypatch):
    encoding = Encoding(robots["mgr"], ["walls"], "limits", wall_reaches_mm=(120.0, 30.0))
    rng = np.random.default_rng(3)
    pose = torch.as_tensor(rng.uniform([-50.0, -50.0, -np.pi], [1100.0, 1100.0, np.pi], (300, 3)))
    situation = Situation(command=torch.zeros(300, 2, dtype=torch.float64), pose=pose)
    compiled = encoding(situation)
    monkeypatch.setattr(compilable, "can_compile", lambda: False)
    torch.testing.assert_close(compiled, encoding(situation), rtol=0, atol=1e-6)
    assert compiled.abs().amax(dim=0).min() > 0.01
