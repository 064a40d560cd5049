"""Errors that follow each other show that something lasts which nobody has named; independent ones show nothing."""

import numpy as np
import pytest
import torch
from exact_base import ExactBase, as_simulated, known_noise, session_of

from swarmtwin.diagnosis.error_history import nats_by_history, running_means
from swarmtwin.diagnosis.likelihood import SessionLikelihood
from swarmtwin.geometry import compose, displacement_between, exp_map
from swarmtwin.simulation.mechanism import mechanism_class


def turning_current(moment):
    """A current of 1.5 mm a period, once round in a run."""
    angle = torch.tensor(2 * np.pi * moment.step / 30)
    end = compose(moment.pose, exp_map(moment.way))
    push = torch.stack([1.5 * angle.cos(), 1.5 * angle.sin(), torch.zeros(())])
    return displacement_between(moment.pose, end + push)


def gain_of_each_run(moment):
    """Gains that differ from run to run by a tenth."""
    own = torch.as_tensor(np.random.default_rng(4).normal(1.0, 0.1, (len(moment.pose), 1)))
    return exp_map(moment.way * own)


def slower(moment):
    return exp_map(0.9 * moment.way)


def wrong_of_each_command(moment):
    """Errors of the noise's size that a command repeats and no other command tells."""
    wave = (moment.command * torch.tensor(37.0)).sum(dim=1)
    return exp_map(moment.way + torch.stack([1.2 * wave.sin(), 1.2 * wave.cos(), 0.02 * wave.sin()], dim=-1))


def held_commands(robot, seed, runs=60, steps=30, periods=6):
    """Commands (steps, runs, m) each of which holds for some periods."""
    rng = np.random.default_rng(seed)
    drawn = rng.uniform(robot.command_low, robot.command_high, (steps // periods, runs, len(robot.command)))
    return np.repeat(drawn, periods, axis=0)


def nats(robot, moved, mechanisms=(), seed=31, vehicle="1", command=None):
    base = ExactBase(robot)
    session = session_of(base, np.random.default_rng(seed), moved, vehicle=vehicle, command=command)
    model = SessionLikelihood(base, known_noise(), session)
    return nats_by_history(model, model.evaluate(mechanisms))


@pytest.mark.parametrize("robot", ["mgr", "mur"])
def test_what_lasts_and_has_no_name_is_seen_in_the_errors_before(robots, robot):
    assert nats(robots[robot], turning_current) > 100
    assert nats(robots[robot], gain_of_each_run) > 50


@pytest.mark.parametrize("robot", ["mgr", "mur"])
def test_independent_errors_show_nothing(robots, robot):
    assert all(nats(robots[robot], as_simulated, seed=seed) < 10 for seed in range(40, 46))


@pytest.mark.parametrize("robot", ["mgr", "mur"])
def test_an_error_that_a_held_command_repeats_is_none_that_lasts(robots, robot):
    command = held_commands(robots[robot], seed=47)
    assert nats(robots[robot], wrong_of_each_command, command=command) < 10
    assert nats(robots[robot], turning_current, command=command) > 100


def test_errors_that_a_cause_explains_show_nothing_more(robots):
    gain = mechanism_class("gain_change").at({"gain": 0.9})
    assert nats(robots["mgr"], slower) > 100
    assert nats(robots["mgr"], slower, [gain]) < 10


def test_a_prediction_uses_no_later_error(robots):
    base = ExactBase(robots["mgr"])
    model = SessionLikelihood(base, known_noise(), session_of(base, np.random.default_rng(5)))
    errors = model.evaluate([]).residual
    before = running_means(model, errors)
    changed = errors.copy()
    place = len(errors) // 2
    late = model.session.transitions.time_s >= model.session.transitions.time_s[place]
    changed[late] += 5.0
    after = running_means(model, changed)
    unknown = model.session.transitions.time_s <= model.session.transitions.time_s[place]
    for one, other in zip(before, after, strict=True):
        np.testing.assert_array_equal(one[unknown], other[unknown])
        assert not np.array_equal(one[~unknown], other[~unknown])
