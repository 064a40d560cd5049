"""What answers in a trained model's place: a table of it, or an imitation of which only differences are taken."""

import numpy as np
import pytest
import torch
from exact_base import ExactBase, known_noise, session_of

from exact_model import ExactDynamics
from swarmtwin.diagnosis.estimation import estimate
from swarmtwin.diagnosis.likelihood import SessionLikelihood
from swarmtwin.diagnosis.quick_dynamics import imitation_of, table_of
from swarmtwin.dynamics.predictor import DynamicsModule
from swarmtwin.geometry import exp_map, log_map
from swarmtwin.learning.situation import Situation
from swarmtwin.simulation.mechanism import mechanism_class


class SlowNearWall(DynamicsModule):
    """A model that looks at the pose as well: it is slower near one wall."""

    inputs = ("command", "pose")

    def __init__(self, robot):
        super().__init__()
        self.robot = robot

    def predict(self, situation):
        slower = 1.0 - 0.5 * torch.exp(-situation.pose[:, :1] / 100.0)
        return exp_map(ExactDynamics(self.robot).twist(situation.command.double()) * slower)


class TwoMembers(ExactBase):
    """A simulation of two members, each a little off the mean of both, and all of them by as much too strong."""

    members = 2

    def __init__(self, robot, strength=1.0):
        super().__init__(robot)
        self.strength = strength

    def twist(self, situation, member=None):
        own = 1.0 if member is None else (0.99, 1.01)[member]
        return ExactDynamics(self.robot).twist(situation.command.double()) * self.strength * own

    def predict(self, situation):
        return exp_map(self.twist(situation))


def weak_session(robot, gain=0.9):
    return session_of(
        ExactBase(robot), np.random.default_rng(3), moved=lambda moment: exp_map(moment.way * gain), runs=40
    )


def test_a_model_of_the_command_is_tabulated_beyond_its_limits(robots):
    model, high = ExactDynamics(robots["mgr"]), torch.as_tensor(robots["mgr"].command_high)
    table = table_of(model)
    asked = Situation(torch.outer(torch.linspace(-1.2, 1.2, 50), high))
    torch.testing.assert_close(table.predict(asked).double(), model.predict(asked), rtol=0, atol=0.05)
    assert table_of(SlowNearWall(robots["mgr"])) is None


def test_an_imitation_answers_nearly_as_its_model_also_where_no_session_was(robots):
    robot, rng = robots["mgr"], np.random.default_rng(1)
    model, session = SlowNearWall(robot), weak_session(robot)
    imitation = imitation_of(model, session, seed=0)
    shuffled = session.situation.only(model.inputs)
    shuffled = Situation(shuffled.command[rng.permutation(len(session))], pose=shuffled.pose)
    for asked in (session.situation.only(model.inputs), shuffled):
        answered, imitated = log_map(model.predict(asked)), imitation.twist(asked)
        off = (answered - imitated).square().mean(dim=0) / answered.square().mean(dim=0)
        assert off[[0, 2]].max() < 0.15**2


@pytest.mark.parametrize("strength", [1.0, 1.1])
def test_a_value_is_that_of_the_model_and_not_of_what_is_quick(robots, strength):
    """What is quick says how errors change on the way; in the end the simulation itself does."""
    robot, session = robots["mgr"], weak_session(robots["mgr"])
    start = [mechanism_class("gain_change").at({"gain": 1.0})]
    expected = estimate(SessionLikelihood(TwoMembers(robot), known_noise(), session), start, final=True)
    quick = SessionLikelihood(TwoMembers(robot), known_noise(), session, quick=TwoMembers(robot, strength))
    np.testing.assert_array_equal(quick.errors(start), quick.errors([]))
    found = estimate(quick, start, final=True)
    np.testing.assert_allclose(found.values, expected.values, atol=0.1 * np.sqrt(expected.covariance[0, 0]))
    assert found.evidence == pytest.approx(expected.evidence, abs=0.1)
