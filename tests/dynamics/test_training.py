import dataclasses
import errno
import resource
import signal

import numpy as np
import pytest
import torch

from swarmtwin.dynamics.evaluation import model_error, predict
from swarmtwin.dynamics.model_config import config_class
from swarmtwin.dynamics.training import TrainingJob, train, train_seeds
from swarmtwin.errors import UserError
from swarmtwin.learning.batches import ShuffledBatches
from swarmtwin.learning.dead_outputs import dead_outputs
from swarmtwin.learning.situation import Situation
from toy import exact_displacement, recipe, toy_transitions

NOISE = (1.0, 1.0, 0.03)


@pytest.fixture(scope="module")
def transitions(robots):
    return toy_transitions(robots["mgr"], 2000, noise=NOISE)


def config(name="mlp", **changes):
    return config_class(name)(**changes)


def gate_error(transitions, name, **changes):
    """Mean distance in mm from the exact mean on unseen commands, as a share of what the best constant has."""
    dynamics = train(transitions, config(name, **changes), recipe(batch_size=128), seeds=[0]).dynamics
    unseen = toy_transitions(transitions.robot, 1000, seed=99)
    constant = np.linalg.norm(unseen.displacement[:, :2] - unseen.displacement[:, :2].mean(axis=0), axis=1).mean()
    return model_error(dynamics, unseen, exact_displacement(unseen.command)).position_mm / constant


@pytest.mark.parametrize("name", ["mlp", "crnet", "kinematic"])
def test_a_working_learner_learns_the_toy(transitions, name):
    assert gate_error(transitions, name, steps=300) < 0.15


def test_a_broken_learner_does_not(transitions):
    shuffled = np.random.default_rng(0).permutation(transitions.displacement)
    assert gate_error(dataclasses.replace(transitions, displacement=shuffled), "mlp", steps=300) > 0.8


def test_the_same_seed_gives_the_same_numbers_and_another_gives_others(transitions):
    first, second = (train(transitions, config("crnet", steps=20), recipe(batch_size=256), [3]) for _ in range(2))
    other = train(transitions, config("crnet", steps=20), recipe(batch_size=256), [4])
    assert first.best.history == second.best.history
    assert all(np.array_equal(first.best.weights[name], second.best.weights[name]) for name in first.best.weights)
    assert first.best.history != other.best.history


def test_training_leaves_the_callers_random_numbers_and_threads_alone(transitions):
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    threads = torch.get_num_threads()
    train(transitions, config(steps=5), recipe(), [0])
    assert torch.equal(torch.rand(3), expected)
    assert torch.get_num_threads() == threads


class InterruptAfter:
    """Stands for Ctrl-C in the middle of training."""

    def __init__(self, epoch):
        self.epoch = epoch
        self.seen = []

    def __call__(self, seed, number, epoch):
        self.seen.append(number)
        if number == self.epoch:
            raise KeyboardInterrupt


@pytest.mark.parametrize("schedule", ["fast", "paper"])
def test_interrupted_and_continued_equals_uninterrupted_bit_for_bit(transitions, tmp_path, schedule):
    chosen = recipe(schedule, batch_size=256, epochs=6)
    whole = train(transitions, config("crnet"), chosen, [1]).best
    handler = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        train(transitions, config("crnet"), chosen, [1], checkpoints=tmp_path, report=InterruptAfter(3))
    assert signal.getsignal(signal.SIGINT) is handler
    later = InterruptAfter(None)
    continued = train(transitions, config("crnet"), chosen, [1], checkpoints=tmp_path, report=later).best
    assert later.seen == [4, 5, 6]
    assert continued.history == whole.history
    assert continued.best == whole.best
    assert all(np.array_equal(continued.weights[name], whole.weights[name]) for name in whole.weights)


def test_a_finished_training_is_not_repeated(transitions, tmp_path):
    first = train(transitions, config(steps=20), recipe(), [1], checkpoints=tmp_path)
    again = train(transitions, config(steps=20), recipe(), [1], checkpoints=tmp_path, report=InterruptAfter(1))
    assert again.best.history == first.best.history


@pytest.mark.parametrize("spoil", ["truncate", "other_training"])
def test_a_checkpoint_that_cannot_be_used_is_started_over(transitions, tmp_path, caplog, spoil):
    expected = train(transitions, config(steps=20), recipe(), [1], checkpoints=tmp_path)
    file = tmp_path / "seed-1.ckpt"
    if spoil == "truncate":
        file.write_bytes(file.read_bytes()[:500])
    else:
        train(transitions, config(steps=20, learning_rate=0.1), recipe(), [1], checkpoints=tmp_path)
    again = train(transitions, config(steps=20), recipe(), [1], checkpoints=tmp_path)
    assert again.best.history == expected.best.history
    assert "seed 1 starts anew: checkpoint" in caplog.text


def test_a_full_disk_is_a_fault_of_the_system(transitions, tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
    try:
        with pytest.raises(OSError, match="File too large") as error:
            train(transitions, config(steps=5), recipe(), [1], checkpoints=tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert error.value.errno == errno.EFBIG
    assert not list(tmp_path.iterdir())


def test_seeds_in_processes_give_the_numbers_of_seeds_in_turn(transitions):
    reported = []
    settings = transitions, config(steps=20), recipe(), [0, 1]
    in_turn = train(*settings, processes=1)
    parallel = train(*settings, processes=2, report=lambda seed, number, epoch: reported.append((seed, number, epoch)))
    assert [result.history for result in parallel.results] == [result.history for result in in_turn.results]
    assert parallel.seed == in_turn.seed
    expected = [
        (result.seed, n, epoch) for result in in_turn.results for n, epoch in enumerate(result.history, start=1)
    ]
    assert sorted(reported) == sorted(expected)


@pytest.mark.parametrize(("too_many", "at_a_time"), [(1, 1), (0, 2)])
def test_of_many_transitions_one_process_learns_at_a_time(transitions, monkeypatch, too_many, at_a_time):
    """Each process has its own: memory would grow with cores."""
    most = transitions.count("train") - too_many
    told = []
    monkeypatch.setattr("swarmtwin.dynamics.training.run_side_by_side", lambda jobs, report, count: told.append(count))
    monkeypatch.setattr("swarmtwin.dynamics.training.cores", lambda: 2)
    monkeypatch.setattr(TrainingJob, "expected_s", lambda job: 100.0)
    jobs = [TrainingJob(transitions, config(), recipe(epochs=1), seed) for seed in (0, 1)]
    train_seeds(jobs, None, None, most_side_by_side=most)
    train_seeds(jobs, None, processes=2, most_side_by_side=most)
    assert told == [at_a_time, 2]


def test_the_best_live_seed_is_the_model(transitions):
    trained = train(transitions, config(steps=20), recipe(), [0, 1, 2], processes=1)
    assert trained.best.validation_loss == min(result.validation_loss for result in trained.results)
    kept = trained.best.history[trained.best.best - 1]
    validation = transitions.part("validation")
    position_mm = np.linalg.norm((predict(trained.dynamics, validation) - validation.displacement)[:, :2], axis=1)
    assert position_mm.mean() == pytest.approx(kept.validation_position_mm, rel=1e-4)


def test_a_seed_whose_errors_are_not_finite_is_dead(transitions):
    with pytest.raises(UserError) as error:
        train(transitions, config("kinematic", learning_rate=1e6), recipe(epochs=3), [0])
    assert str(error.value) == (
        "kinematic: every seed is dead (seed 0: the errors were no longer finite in epoch 1): "
        "try other seeds, a lower learning rate, or another model"
    )


def test_a_seed_whose_final_relu_died_is_flagged_and_not_chosen(transitions):
    trained = train(transitions, config("fcnn", steps=150), recipe(batch_size=128), [5, 0], processes=1)
    assert trained.dead_seeds == {5: "constant output: forward_mm"}
    assert trained.seed == 0


def test_a_dead_seed_is_replaced_by_the_next_one(transitions):
    settings = transitions, config("fcnn", steps=150), recipe(batch_size=128)
    trained = train(*settings, [5], processes=1, reserve=3)
    assert [result.seed for result in trained.results] == [5, 6]
    assert trained.seed == 6
    with pytest.raises(UserError, match="every seed is dead"):
        train(*settings, [5], processes=1)


def test_dead_outputs_are_those_that_could_vary_and_do_not():
    random = np.random.default_rng(0)
    inputs = random.uniform(-1, 1, (1000, 2))
    noise = random.normal(0, 1, 1000)
    measured = np.column_stack([10 * inputs[:, 0], noise, inputs[:, 1] + 0.1 * noise])
    live = np.column_stack([9 * inputs[:, 0], np.zeros(1000), inputs[:, 1]])
    dead = np.column_stack([9 * inputs[:, 0], np.zeros(1000), np.full(1000, 0.2)])
    assert dead_outputs(live, measured, inputs) == []
    assert dead_outputs(dead, measured, inputs) == ["turn_rad"]


@pytest.mark.parametrize("part", ["command", "displacement"])
def test_values_that_are_not_finite_never_reach_a_net(transitions, part):
    values = getattr(transitions, part).copy()
    values[7, 1] = np.nan
    name = "command" if part == "command" else "left_mm"
    with pytest.raises(UserError) as error:
        train(dataclasses.replace(transitions, **{part: values}), config(), recipe(), [0])
    assert str(error.value) == f"{name} is not finite in 1 of 2000 transitions: prepare the recording anew"


def test_a_net_that_has_hardly_begun_is_not_called_dead(transitions):
    assert not train(transitions, config("lstm"), recipe(epochs=1), [0]).dead_seeds


def test_an_empty_split_is_refused(transitions):
    with pytest.raises(UserError) as error:
        train(dataclasses.replace(transitions, split=np.zeros(2000, int)), config(), recipe(), [0])
    assert str(error.value) == "the validation split has 0 transitions: record more runs, or split them otherwise"


def test_scalings_are_learned_from_the_training_split_alone(transitions):
    changed = transitions.displacement.copy()
    changed[transitions.split != 0] *= 3
    settings = config(steps=10), recipe(), [0]
    weights = train(transitions, *settings).best.weights
    others = train(dataclasses.replace(transitions, displacement=changed), *settings).best.weights
    assert np.array_equal(weights["output_scaling.scale"], others["output_scaling.scale"])
    assert np.array_equal(weights["output_scaling.offset"], others["output_scaling.offset"])


def test_predictions_do_not_depend_on_the_unit_of_the_command(transitions):
    columns = {
        name: column.model_copy(update={"low": 10 * column.low, "high": 10 * column.high})
        for name, column in transitions.robot.command.items()
    }
    robot = transitions.robot.model_copy(update={"command": columns})
    tenfold = dataclasses.replace(transitions, robot=robot, command=10 * transitions.command)
    settings = config(steps=20), recipe(), [0]
    one, ten = (predict(train(data, *settings).dynamics, data) for data in (transitions, tenfold))
    np.testing.assert_allclose(one, ten, atol=1e-3)


@pytest.mark.parametrize("part", ["previous_command", "earlier_command"])
def test_what_depends_on_a_command_before_is_learned_by_a_model_that_asks_for_it(transitions, part):
    before = np.nan_to_num(getattr(transitions, part))
    lagging = dataclasses.replace(transitions, displacement=exact_displacement(transitions.command + before))
    asking = config(situation=("command", part), steps=300)
    errors = [
        train(lagging, chosen, recipe(batch_size=128), [0]).best.history[-1].validation_position_mm
        for chosen in (asking, config(steps=300))
    ]
    assert errors[0] < 0.25 * errors[1]


def test_a_recipe_fills_in_what_it_leaves_open():
    open_recipe, own = recipe("fast", batch_size=100), config("crnet", learning_rate=0.03, steps=95)
    filled = open_recipe.completed(own.learning_rate, own.steps, 1000)
    assert (filled.learning_rate, filled.epochs) == (0.03, 10)
    stated = recipe("paper").completed(own.learning_rate, own.steps, 1000)
    assert (stated.learning_rate, stated.epochs) == (0.005138, 40)


def test_a_schedule_with_what_another_left_is_refused_and_told_what_to_do():
    with pytest.raises(UserError) as error:
        recipe("fast", schedule={"kind": "plateau", "warm_up": 0.1})
    assert str(error.value) == (
        "fast: field 'schedule': Value error, warm_up belongs to 'one_cycle', not to 'plateau': "
        "take it away by ~recipe.schedule.warm_up"
    )
    with pytest.raises(UserError, match=r"take it away by ~recipe\.schedule\.patience ~recipe\.schedule\.factor$"):
        recipe("fast", schedule={"kind": "one_cycle", "patience": 2, "factor": 0.5})


def test_an_epoch_gives_out_each_transition_once_in_an_order_of_its_own():
    situation = Situation(command=torch.arange(100.0)[:, None])
    batches = ShuffledBatches(situation, torch.zeros(100, 3), size=25, seed=1)
    orders = []
    for epoch in (0, 1, 0):
        batches.epoch = epoch
        orders.append(torch.cat([part.command[:, 0] for part, _ in batches]).tolist())
    assert sorted(orders[0]) == list(range(100))
    assert orders[0] != orders[1]
    assert orders[0] == orders[2]
