"""Units of a robot differ a little: that is no gap, and more than that is."""

import numpy as np
import pytest
import torch
from exact import TRACK_MM, ExactBase, known_noise, session_of

from swarmtwin.dynamics.twist import displacement_of
from swarmtwin.gap.catalogue import mechanism_class
from swarmtwin.gap.fitting import Problem
from swarmtwin.gap.mechanism import way_of_wheels, wheel_ways
from swarmtwin.gap.naming import FEWEST_NATS
from swarmtwin.gap.noise import residual_of
from swarmtwin.geometry import compose


def of_wheels(left, right):
    """A unit whose wheels are so much faster."""
    factor = torch.tensor([[left, right]], dtype=torch.float64)

    def moved(moment):
        wheels = wheel_ways(moment.way, TRACK_MM) * factor
        return displacement_of(way_of_wheels(wheels, moment.way, TRACK_MM))

    return moved


def problem_of(robot, moved, vehicle, known=("1",), seed=1):
    base = ExactBase(robot)
    return Problem(base, known_noise(), session_of(base, np.random.default_rng(seed), moved, vehicle=vehicle), known)


def nats(problem, name, **start):
    """What a cause gains over nothing."""
    return problem.fit([mechanism_class(name).at(start)]).total - problem.evaluate([]).total


@pytest.mark.parametrize(("left", "right"), [(1.02, 1.02), (0.98, 0.98), (1.02, 0.98), (0.99, 1.01)])
def test_another_unit_that_differs_a_little_is_no_gap(robots, left, right):
    moved = of_wheels(left, right)
    for name, start in (("gain_change", {"gain": 1.0}), ("actuator_asymmetry", {"ratio": 1.0})):
        assert nats(problem_of(robots["mgr"], moved, "2"), name, **start) < FEWEST_NATS / 3
    same_unit = problem_of(robots["mgr"], moved, "1")
    either = nats(same_unit, "gain_change", gain=1.0), nats(same_unit, "actuator_asymmetry", ratio=1.0)
    assert max(either) > 2 * FEWEST_NATS
    assert not same_unit.units.count


def test_another_unit_that_differs_much_is_a_gap(robots):
    problem = problem_of(robots["mgr"], of_wheels(1.15, 1.15), "2")
    assert nats(problem, "gain_change", gain=1.0) > FEWEST_NATS
    fit = problem.fit([mechanism_class("gain_change").at({"gain": 1.0})])
    assert fit.mechanisms[0].gain == pytest.approx(1.15, abs=0.03)
    askew = problem_of(robots["mgr"], of_wheels(1.12, 0.88), "2")
    assert nats(askew, "actuator_asymmetry", ratio=1.0) > FEWEST_NATS


def test_what_is_left_of_a_strange_unit_is_noise(robots):
    problem = problem_of(robots["mgr"], of_wheels(1.02, 0.98), "2")
    residual = problem.evaluate([]).residual
    size = problem.simulated.numpy()
    for axis in (0, 2):
        assert abs(np.corrcoef(residual[:, axis], size[:, axis])[0, 1]) < 0.03
    np.testing.assert_allclose(residual.std(axis=0), 1.0, atol=0.04)


def test_a_delay_is_no_difference_of_units(robots):
    def late(moment):
        return compose(displacement_of(0.1 * moment.way_before), displacement_of(0.9 * moment.way))

    problem = problem_of(robots["mgr"], late, "2")
    fit = problem.fit([mechanism_class("command_delay").at({"delay_s": 0.02})])
    assert fit.total - problem.evaluate([]).total > 50 * FEWEST_NATS
    assert fit.mechanisms[0].delay_s == pytest.approx(0.05, abs=0.001)


def test_a_difference_twice_as_large_costs_four_times_as_much(robots):
    problem = problem_of(robots["mgr"], of_wheels(1.02, 1.0), "2")
    residual = problem.whitener(residual_of(problem.session, problem.simulated)).numpy()
    freed, price = problem.units.free(residual)
    twice, price_of_twice = problem.units.free(2 * residual)
    np.testing.assert_allclose(twice, 2 * freed)
    assert price_of_twice == pytest.approx(4 * price)
    assert price > 0
