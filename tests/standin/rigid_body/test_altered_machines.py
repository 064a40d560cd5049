"""A body with other properties moves as mechanics says, and moves on the same wherever it is carried."""

import numpy as np
import pytest

from swarmtwin.geometry import displacement_between
from swarmtwin.standin.physics import Period
from swarmtwin.standin.rigid_body.driving import machine_of
from swarmtwin.standin.session import StandInSession

COMMANDS = {"mgr": (90.0, 60.0), "mur": (20.0, 40.0, 6.0)}


def machine(robot, factors=None):
    return machine_of(StandInSession(robot, ("1",), 1, 1, 0)).altered(factors or {})


def driven(body, robot, carried=None, periods=3):
    """Return displacements (periods, 3) in the vehicle's frame; it may be carried to a pose before the last one."""
    pose = np.array([[[500.0, 500.0, 0.3]]])
    state = body.put(pose)
    command = np.reshape(COMMANDS[robot.name], (-1, 1, 1))
    active = np.reshape(body.resting_command, (-1, 1, 1))
    calm = np.zeros((body.pieces, body.noises, 1, 1))
    moved = []
    for number in range(periods):
        if carried is not None and number == periods - 1:
            state = body.carried_to(np.reshape(carried, (1, 1, 3)), state)
        before = np.moveaxis(state[:3], 0, -1)
        state = body.advance(state, Period(command, active, np.array([[robot.period_s]]), np.zeros((1, 1))), calm)
        active = command
        moved.append(displacement_between(before, np.moveaxis(state[:3], 0, -1))[0, 0])
    return np.array(moved)


@pytest.mark.parametrize("name", ["mgr", "mur"])
def test_a_vehicle_carried_elsewhere_moves_on_as_it_did(robots, name):
    stayed = driven(machine(robots[name]), robots[name])
    carried = driven(machine(robots[name]), robots[name], carried=(700.0, 400.0, -2.0))
    np.testing.assert_allclose(carried, stayed, atol=0.02)
    assert np.linalg.norm(stayed[-1, :2]) > 5  # not at rest: velocities were kept
    at_rest = driven(machine(robots[name]), robots[name], periods=1)[0]
    assert abs(at_rest[0] - stayed[-1, 0]) > 0.5


def test_altered_properties_change_the_motion_in_proportion(robots):
    usual = driven(machine(robots["mgr"]), robots["mgr"])[-1]
    smaller = driven(machine(robots["mgr"], {"left_radius": 0.9, "right_radius": 0.9}), robots["mgr"])[-1]
    np.testing.assert_allclose(smaller[[0, 2]] / usual[[0, 2]], 0.9, atol=0.02)
    wider = driven(machine(robots["mgr"], {"track": 1.25}), robots["mgr"])[-1]
    assert wider[2] / usual[2] == pytest.approx(0.8, abs=0.03)
    np.testing.assert_array_equal(driven(machine(robots["mgr"], {"track": 1.0}), robots["mgr"])[-1], usual)


def test_what_differs_by_fabrication_and_what_the_drawing_says_are_both_altered(robots):
    body = machine(robots["mur"], {"trim": 1.1, "setting_s": 3.0})
    usual = machine(robots["mur"])
    assert body.factor["trim"] == pytest.approx(1.1 * usual.factor["trim"])
    assert body.setting_s == pytest.approx(3.0 * usual.setting_s)
    later, sooner = driven(body, robots["mur"]), driven(usual, robots["mur"])
    assert later[0, 0] < sooner[0, 0]
