"""A table of displacements moves vehicles as its dynamics model does, and says by how much it does not."""

import pytest
import torch

from exact_model import ExactDynamics, LaggingDynamics, conditions_of
from swarmtwin.dynamics.model_config import config_class
from swarmtwin.dynamics.motion_noise import MotionNoise
from swarmtwin.dynamics.predictor import NetworkDynamics
from swarmtwin.errors import UserError
from swarmtwin.learning.situation import Situation
from swarmtwin.simulation.displacement_table import DisplacementTable, TableSettings, tabulated
from swarmtwin.simulation.mechanism import mechanism_class
from swarmtwin.simulation.simulation import Simulation

LOOSE = TableSettings(position_mm=1e3, heading_deg=1e3)


@pytest.fixture(scope="module")
def network(robots):
    torch.manual_seed(0)
    dynamics = NetworkDynamics(robots["mgr"], config_class("mlp")(situation=("command",)))
    dynamics.output_scaling.learn(5 * torch.randn(100, 3))
    return dynamics.eval()


def random_commands(robot, count, seed):
    low, high = torch.as_tensor(robot.command_low), torch.as_tensor(robot.command_high)
    drawn = torch.rand(count, len(low), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return low + drawn * (high - low)


def far_off(table, dynamics, command):
    """By how far the table is off, (N,) mm and (N,) degrees."""
    off = (table.predict(Situation(command)) - dynamics.predict(Situation(command))).double()
    return off[:, :2].norm(dim=1), off[:, 2].abs().rad2deg()


def test_the_error_that_it_states_is_that_of_commands_it_has_not_asked_for(network):
    table = DisplacementTable(network, TableSettings(points=17, position_mm=1e3, heading_deg=1e3))
    position, heading = far_off(table, network, random_commands(network.robot, 50_000, seed=5))
    assert float(position.quantile(0.99)) == pytest.approx(table.error.position_mm, rel=0.1)
    assert float(heading.quantile(0.99)) == pytest.approx(table.error.heading_deg, rel=0.1)
    assert table.error.most_position_mm >= table.error.position_mm > 0


def test_the_finer_the_nearer_to_its_model(network):
    errors = [DisplacementTable(network, LOOSE.model_copy(update={"points": n})).error for n in (9, 33, 129)]
    assert errors[0].position_mm > 2 * errors[1].position_mm > 4 * errors[2].position_mm
    assert errors[2].position_mm < 0.1


@pytest.mark.parametrize("name", ["mgr", "mur"])
def test_at_its_points_it_is_its_model_and_beyond_the_limits_that_of_the_limits(robots, name):
    robot = robots[name]
    dynamics = ExactDynamics(robot)
    table = DisplacementTable(dynamics, LOOSE.model_copy(update={"points": 9}))
    low, high = torch.as_tensor(robot.command_low), torch.as_tensor(robot.command_high)
    points = low + torch.randint(0, 9, (50, len(low))) / 8 * (high - low)
    torch.testing.assert_close(
        table.predict(Situation(points)).double(), dynamics.predict(Situation(points)), atol=1e-4, rtol=1e-5
    )
    beyond = torch.stack([low - 50, high + 1])
    torch.testing.assert_close(table.predict(Situation(beyond)), table.predict(Situation(torch.stack([low, high]))))


def test_what_is_drawn_around_it_is_what_is_drawn_around_its_model(robots):
    robot = robots["mgr"]
    by_axis = {"at_rest": (1.0, 1.0, 0.001), "with_motion": (2.0, 1.0, 0.002), "camera": (1.0, 1.0, 0.0001)}
    noise = MotionNoise(usual_mm=20.0, usual_rad=0.5, **by_axis)
    simulation = Simulation(ExactDynamics(robot, noise))
    command = random_commands(robot, 12, seed=2).reshape(4, 3, 2)
    ends = []
    for one in (simulation, tabulated(simulation, TableSettings())):
        rng = torch.Generator().manual_seed(3)
        state = one.step(one.start(torch.zeros(4, 3, 3)), command, rng=rng)
        ends.append(one.observe(state, rng))
    torch.testing.assert_close(*ends, atol=0.02, rtol=0)
    assert ends[0].std() > 1


def test_what_extends_a_simulation_extends_its_table(robots):
    robot = robots["mgr"]
    mechanisms = [
        mechanism_class("actuator_lag").at({"time_constant_s": 0.1}),
        mechanism_class("marker_yaw").at({"angle_rad": 0.2}),
    ]
    simulation = Simulation(ExactDynamics(robot), mechanisms, conditions_of(robot))
    table = tabulated(simulation, TableSettings())
    assert isinstance(table.dynamics, DisplacementTable)
    states = [one.start(torch.zeros(2, 3, 3)) for one in (simulation, table)]
    for seed in range(5):
        command = random_commands(robot, 6, seed).reshape(2, 3, 2)
        states = [one.step(state, command) for one, state in zip((simulation, table), states, strict=True)]
    torch.testing.assert_close(
        *(one.observe(state) for one, state in zip((simulation, table), states, strict=True)), atol=0.05, rtol=0
    )


@pytest.mark.parametrize(
    ("dynamics", "settings", "said"),
    [
        (LaggingDynamics, {}, "looks at command, previous_command: only one that looks at the command alone"),
        (ExactDynamics, {"points": 3}, "off its dynamics model of 'mgr'"),
        (ExactDynamics, {"largest": 1000}, "would hold 49,923 numbers: lower table.points"),
    ],
)
def test_what_cannot_be_tabulated_well_is_refused_or_left_as_it_is(robots, dynamics, settings, said):
    simulation = Simulation(dynamics(robots["mgr"]))
    with pytest.raises(UserError, match=said):
        tabulated(simulation, TableSettings(**settings))
    assert tabulated(simulation, TableSettings(**settings), wanted=None) is simulation
    assert tabulated(simulation, TableSettings(), wanted=False) is simulation


def test_a_model_that_answers_nothing_finite_is_not_tabulated(network):
    class Broken(ExactDynamics):
        def predict(self, situation):
            return super().predict(situation) * torch.nan

    with pytest.raises(UserError, match="nan mm and nan°"):
        DisplacementTable(Broken(network.robot), TableSettings())
