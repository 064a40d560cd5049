import numpy as np
import pytest
import torch
from toy import toy_transitions

from swarmtwin.dynamics.scaling import INPUT_ORDER, Encoding, Scaling
from swarmtwin.dynamics.situation import ALL_PARTS, Situation
from swarmtwin.errors import UserError


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
    encoding = Encoding(robots["mur"], ("command", "pose"), "unit_range")
    situation = Situation(command=torch.tensor([[4.0, 5.0, 6.0]]), pose=torch.tensor([[1.0, 2.0, 3.0]]))
    assert encoding(situation).tolist() == [[1, 2, 3, 4, 5, 6]]


def test_standardised_headings_do_not_jump_at_the_half_turn(robots):
    encoding = Encoding(robots["mur"], ("command", "pose"), "standard")
    encoding.learn(Situation.from_transitions(toy_transitions(robots["mur"], 500, mean=np.zeros_like)))
    command = torch.zeros(2, 3)
    pose = torch.tensor([[500.0, 500.0, np.pi - 1e-4], [500.0, 500.0, -np.pi + 1e-4]])
    before, after = encoding(Situation(command=command, pose=pose))
    torch.testing.assert_close(before, after, rtol=0, atol=1e-3)


def test_a_missing_previous_command_is_taken_for_the_usual_one(robots):
    encoding = Encoding(robots["mgr"], ("command", "previous_command"), "standard")
    situation = Situation.from_transitions(toy_transitions(robots["mgr"], 500))
    encoding.learn(situation)
    missing = situation.previous_command.isnan()
    assert missing.any()
    inputs = encoding(situation)
    assert inputs.isfinite().all()
    torch.testing.assert_close(inputs[:, 2:][missing], torch.zeros(int(missing.sum())), rtol=0, atol=1e-5)


def test_a_missing_earlier_command_is_taken_for_the_usual_one(robots):
    encoding = Encoding(robots["mgr"], ("command", "earlier_command"), "physical")
    situation = Situation.from_transitions(toy_transitions(robots["mgr"], 500))
    encoding.learn(situation)
    missing = situation.earlier_command.isnan().any(dim=1)
    assert int(missing.sum()) == 2 * 10
    inputs = encoding(situation)
    assert torch.equal(inputs[~missing, 2:], situation.earlier_command[~missing])
    usual = situation.earlier_command[~missing].mean(dim=0)
    torch.testing.assert_close(inputs[missing, 2:], usual.expand(20, 2), rtol=0, atol=1e-3)


def test_only_an_encoding_that_takes_the_earlier_command_keeps_the_usual_one(robots):
    """Else weights saved by an earlier version would not load."""
    kept = {"usual_previous_command", "scaling.offset", "scaling.scale"}
    without, taking = (
        Encoding(robots["mgr"], ("command", *parts), "standard") for parts in (("previous_command",), INPUT_ORDER)
    )
    assert set(without.state_dict()) == kept
    assert set(taking.state_dict()) == {*kept, "usual_earlier_command"}


def test_neighbours_are_refused_except_by_an_encoding_that_takes_them(robots):
    class Counting(Encoding):
        """Takes neighbours as how many there are."""

        order = ("command", "neighbours")

        def _part_columns(self, part, values):
            if part == "neighbours":
                return values[..., 0].isfinite().sum(dim=1, keepdim=True)
            return super()._part_columns(part, values)

    parts = ("command", "neighbours")
    with pytest.raises(UserError) as refused:
        Encoding(robots["mgr"], parts, "physical")
    assert str(refused.value) == "no network takes neighbours yet: take it out of model.situation"
    neighbours = torch.zeros(2, 3, 3)
    neighbours[1, 1:] = torch.nan
    situation = Situation(command=torch.tensor([[4.0, 5.0], [6.0, 7.0]]), neighbours=neighbours)
    assert Counting(robots["mgr"], parts, "physical")(situation).tolist() == [[4, 5, 3], [6, 7, 1]]
    assert situation.only(("command",)).neighbours is None


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
