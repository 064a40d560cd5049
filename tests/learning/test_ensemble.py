import numpy as np
import pytest
import torch

from swarmtwin.learning.ensemble import Ensemble, EnsembleTraining, folds_of, learn

GROUPS = [[0, 1], [2], [0, 1, 2]]


def test_folds_take_whole_runs_in_turn():
    run = np.repeat(np.arange(40), 10)
    fold = folds_of(run, 5)
    assert all(len(set(fold[run == number])) == 1 for number in range(40))
    assert np.bincount(fold).tolist() == [80] * 5


@pytest.mark.parametrize(("split_runs", "expected"), [(False, [6, 6]), (True, [3, 3, 3, 3])])
def test_with_fewer_runs_than_folds_there_are_fewer_folds_or_blocks_in_time(split_runs, expected):
    fold = folds_of(np.repeat([0, 1], 6), 4, split_runs)
    assert np.bincount(fold).tolist() == expected
    assert (np.diff(fold) >= 0).all()


@pytest.mark.parametrize("alike", [True, False])
def test_one_answer_is_the_same_whichever_way_it_is_asked_for(alike):
    ensemble = Ensemble(3, GROUPS, outputs=2, alike=alike)
    ensemble.learn_scaling(torch.randn(50, 2) * 7 + 4)
    inputs, fold = torch.randn(30, 3), torch.arange(30) % 3
    each = ensemble(inputs)
    torch.testing.assert_close(ensemble(inputs.expand(3, -1, -1)), each)
    torch.testing.assert_close(torch.stack([ensemble.answer(inputs, member) for member in range(3)]), each)
    torch.testing.assert_close(ensemble.mean(inputs), each.mean(dim=0))
    torch.testing.assert_close(ensemble.held_out(inputs, fold), torch.stack([each[k, i] for i, k in enumerate(fold)]))
    torch.testing.assert_close(each, ensemble.scaled(inputs) * ensemble.scale + ensemble.offset)
    assert (each[0] - each[1]).abs().max().item() == pytest.approx(0, abs=1e-6) if alike else True


def test_a_member_knows_nothing_of_its_own_fold():
    random = np.random.default_rng(0)
    inputs = random.normal(size=(600, 3))
    outputs = inputs[:, :1] + 3 * (np.arange(600) < 300)[:, None]  # the first half of the rows is another world
    fold = (np.arange(600) >= 300).astype(int)
    ensemble = learn([[0], [0, 1, 2]], inputs, outputs, fold, 1, training=EnsembleTraining(steps=300))
    answers = ensemble(torch.as_tensor(inputs, dtype=torch.float32)).detach().numpy()
    assert np.abs(answers[0] - inputs[:, :1]).mean() < 0.2
    assert np.abs(answers[1] - inputs[:, :1] - 3).mean() < 0.2
