"""A cause that the reference shows as well, where it was driven as the session was, is an error of the simulation."""

import numpy as np
import pytest
from exact_base import ExactBase, Losing, known_noise, session_of

from swarmtwin.diagnosis.beyond_reference import nats_beyond_reference
from swarmtwin.diagnosis.estimation import estimate
from swarmtwin.diagnosis.left_over import left_over
from swarmtwin.diagnosis.likelihood import SessionLikelihood
from swarmtwin.diagnosis.reference_errors import ReferenceErrors
from swarmtwin.geometry import exp_map
from swarmtwin.simulation.mechanism import mechanism_class

FASTER = [mechanism_class("gain_change").at({"gain": 1.05})]


def driven(robot, seed, gain_where_slow, gentle=1.0, runs=60, moved=None):
    """How likely a session is that goes faster, under commands of less than half the largest, than is simulated."""
    base, rng = ExactBase(robot), np.random.default_rng(seed)
    command = rng.uniform(robot.command_low, robot.command_high, (30, runs, 2)) * gentle

    def faster_where_slow(moment):
        is_slow = (moment.command.abs().amax(dim=-1, keepdim=True) < 0.5 * robot.command_high.max()).double()
        return exp_map(moment.way * (1 + (gain_where_slow - 1) * is_slow))

    session = session_of(base, rng, moved=moved or faster_where_slow, command=command)
    return SessionLikelihood(base, known_noise(), session)


@pytest.mark.parametrize("seed", range(3))
def test_what_the_reference_shows_where_it_was_driven_alike_is_not_of_the_session(robots, seed):
    """Of all the reference a small part was driven so, and most of it is simulated well."""
    robot = robots["mgr"]
    session, wrong = driven(robot, seed, 1.05, gentle=0.45), driven(robot, 10 + seed, 1.05, runs=200)
    right = driven(robot, 20 + seed, 1.0, runs=200)
    assert session.evaluate(FASTER).total > session.evaluate([]).total + 20
    assert nats_beyond_reference(session, wrong, FASTER) < 8
    assert nats_beyond_reference(session, right, FASTER) > 15


def test_what_changes_nothing_is_no_error_of_the_reference(robots):
    robot = robots["mgr"]
    session, own = driven(robot, 1, 1.0), driven(robot, 2, 1.0)
    assert nats_beyond_reference(session, own, [mechanism_class("gain_change").at({"gain": 1.0})]) == np.inf


class NeverGranted(ReferenceErrors):
    """Errors of a reference that nobody may ask for."""

    @property
    def granted(self):
        """Fail."""
        raise AssertionError("the reference was asked")


def test_it_is_asked_only_where_causes_gain_little_and_move_vehicles(robots):
    robot, own = robots["mgr"], NeverGranted()
    clear = driven(robot, 3, 1.3)
    found = estimate(clear, FASTER)
    assert left_over(clear, found, found.fitted.total - clear.evaluate([]).total, own).beyond_reference == np.inf
    lossy = driven(robot, 4, 1.0, moved=Losing(0.1, 4))
    lost = estimate(lossy, [mechanism_class("command_loss").at({"probability": 0.1})])
    assert left_over(lossy, lost, 1.0, own).beyond_reference == np.inf
