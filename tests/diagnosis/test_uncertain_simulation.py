"""A simulation of several members: one stands for what they agree in, and where they do not, values are uncertain."""

import numpy as np
import pytest
import torch
from exact_base import ExactBase, Losing, known_noise, session_of
from simulated_session import simulated_noise, simulated_session

from exact_model import ExactDynamics
from swarmtwin.diagnosis.estimation import estimate, with_further_uncertainty
from swarmtwin.diagnosis.likelihood import SessionLikelihood
from swarmtwin.diagnosis.settings import DiagnosisSettings
from swarmtwin.dynamics.predictor import DynamicsModule
from swarmtwin.geometry import exp_map
from swarmtwin.simulation.ensemble_dynamics import CorrectedDynamics
from swarmtwin.simulation.mechanism import mechanism_class

MEMBERS = 6


class Disagreeing(DynamicsModule):
    """Members that each know the way but for a factor on it, and the bow in which wheels' speeds level off."""

    inputs, members = ("command",), MEMBERS

    def __init__(self, robot, gains, bows=(0.0,) * MEMBERS):
        super().__init__()
        self.robot, self.gains, self.bows = robot, gains, bows

    def member_twists(self, situation):
        command = situation.command.double()
        effort = command / torch.as_tensor(self.robot.command_high)
        way = ExactDynamics(self.robot).twist(command)
        bent = ExactDynamics(self.robot).twist(command * effort**2)
        return torch.stack([way * gain + bow * bent for gain, bow in zip(self.gains, self.bows, strict=True)])

    def twist(self, situation, member=None):
        twists = self.member_twists(situation)
        return twists.mean(dim=0) if member is None else twists[member]

    def predict(self, situation):
        return exp_map(self.twist(situation))


class Corrected(CorrectedDynamics):
    """A trained model without a mistake, and members' corrections of it."""

    def __init__(self, robot, gains):
        DynamicsModule.__init__(self)
        self.robot, self.inputs = robot, ("command",)
        self.dynamics, self.correction = ExactDynamics(robot), Disagreeing(robot, gains)


def session(robot, seed, gain):
    return session_of(
        ExactBase(robot), np.random.default_rng(seed), moved=lambda moment: exp_map(moment.way * gain), runs=40
    )


@pytest.mark.parametrize("gain", [0.9, 1.1])
def test_values_are_as_uncertain_as_members_disagree(robots, gain):
    """Learned anew, a simulation whose gain varies by 1 % makes that of a later session vary by as much."""
    rng = np.random.default_rng(5)
    robot, gains = robots["mgr"], 1 + 0.01 * rng.normal(size=MEMBERS)
    jackknife = np.sqrt((MEMBERS - 1) / MEMBERS * ((gains - gains.mean()) ** 2).sum())
    model = SessionLikelihood(Disagreeing(robot, gains), known_noise(), session(robot, 3, gain))
    kind = mechanism_class("gain_change")
    found = estimate(model, [kind.at({"gain": 1.0})])
    certain, uncertain = found.covariance, with_further_uncertainty(model, found).covariance
    expected = found.values[0] / gains.mean() * jackknife
    assert np.sqrt(uncertain - certain)[0, 0] == pytest.approx(expected, rel=0.03)
    alone = SessionLikelihood(ExactBase(robot), known_noise(), session(robot, 3, gain))
    known = estimate(alone, [kind.at({"gain": 1.0})])
    assert with_further_uncertainty(alone, known) is known


@pytest.mark.parametrize("form", [1e-4, 0.14])
def test_values_are_as_uncertain_where_commands_are_lost(robots, form):
    """They are by members and by other forms; how many commands are lost is counted, and neither changes that."""
    rng = np.random.default_rng(5)
    robot, gains = robots["mgr"], 1 + 0.01 * rng.normal(size=MEMBERS)
    jackknife = np.sqrt((MEMBERS - 1) / MEMBERS * ((gains - gains.mean()) ** 2).sum())
    settings = DiagnosisSettings.parse({"estimation": {"form": form}}, "here")
    losing = Losing(0.05, 3, moved=lambda moment: exp_map(moment.way * 0.9))
    lossy = session_of(ExactBase(robot), np.random.default_rng(3), moved=losing, runs=40)
    model = SessionLikelihood(Disagreeing(robot, gains), known_noise(), lossy, settings=settings)
    begun = [
        mechanism_class("gain_change").at({"gain": 0.9}),
        mechanism_class("command_loss").at({"probability": 0.04}),
    ]
    found = estimate(model, begun)
    gained, lost = np.sqrt(np.diag(with_further_uncertainty(model, found).covariance - found.covariance))
    by_members = found.values[0] / gains.mean() * jackknife
    of_form = form * abs(found.values[0] - 1)
    assert gained == pytest.approx(np.hypot(by_members, of_form), rel=0.1)  # one axis tells nearly all of it
    assert lost < 0.1 * np.sqrt(found.covariance[1, 1])


@pytest.mark.parametrize("base", [Disagreeing, Corrected])
def test_one_member_says_by_how_much_mechanisms_change_errors(robots, base):
    robot = robots["mgr"]
    gains = 1 + 0.02 * np.random.default_rng(8).normal(size=MEMBERS)
    model = SessionLikelihood(base(robot, gains), known_noise(), session(robot, 4, 1.0))
    near = [mechanism_class("gain_change").at({"gain": 0.9})]
    for name, values in (("command_delay", {"delay_s": 0.1}), ("marker_yaw", {"angle_rad": 0.1})):
        others = [*near, mechanism_class(name).at(values)]
        exact = model.errors(others)
        change = np.linalg.norm(exact - model.errors(near))
        assert np.linalg.norm(model.errors_near(others, near) - exact) < 0.05 * change
    np.testing.assert_allclose(model.errors_near(near, near), model.errors(near), atol=1e-9)


@pytest.mark.parametrize("gain", [0.7, 1.2])
def test_a_descent_by_what_one_member_changes_ends_where_the_whole_simulation_leads(robots, gain):
    """Each begins with the whole simulation; the last one ends so near its beginning that members hardly matter."""
    robot, gains = robots["mgr"], 1 + 0.02 * np.random.default_rng(8).normal(size=MEMBERS)
    model = SessionLikelihood(Disagreeing(robot, gains), known_noise(), session(robot, 4, gain))
    start = [
        mechanism_class("gain_change").at({"gain": 1.0}),
        mechanism_class("command_delay").at({"delay_s": 0.1}),
    ]
    quick, whole = estimate(model, start), estimate(model, start, final=True)
    np.testing.assert_allclose(quick.values, whole.values, atol=0.1 * np.sqrt(np.diag(whole.covariance)).min())


def test_a_trained_model_is_corrected_by_one_member_wherever_it_is_asked(robots):
    gains = np.linspace(0.9, 1.1, MEMBERS)
    model = SessionLikelihood(Corrected(robots["mur"], gains), known_noise(), session(robots["mur"], 6, 1.0))
    late = [mechanism_class("actuator_lag").at({"time_constant_s": 0.2})]
    first, last = (model.predictor.with_member(member) for member in (0, MEMBERS - 1))
    ways = [one.twist(late) for one in (first, last)]
    ratio = (ways[0] * ways[1]).sum() / (ways[0] ** 2).sum()
    assert float(ratio) == pytest.approx(2.1 / 1.9, rel=1e-3)


@pytest.mark.parametrize(("lag_s", "shorter"), [(0.1, 1 - (0.5 + 0.25) / 2 * 0.05 / 0.1), (0.01, 0.01)])
def test_a_fin_that_may_lose_some_of_its_own_way_may_have_a_shorter_lag(robots, lag_s, shorter):
    values = {"time_constant_s": lag_s, "own_time_constant_s": lag_s, "own_turn_time_constant_s": 3 * lag_s}
    lag = mechanism_class("actuator_lag").at(values)
    (other,) = lag.plausible_alternatives()
    assert other.values() == pytest.approx({**lag.values(), **{key: shorter * value for key, value in values.items()}})
    assert other.transient().shares == pytest.approx(lag.transient().shares)
    assert not mechanism_class("actuator_lag").at({"time_constant_s": 0.1}).plausible_alternatives()


@pytest.mark.parametrize("deviations", [1.0, 2.0])
def test_play_of_wheels_is_known_as_well_as_how_fast_a_motor_without_its_wheel_is(robots, deviations):
    robot = robots["mgr"]
    settings = DiagnosisSettings.model_validate({"estimation": {"alternatives": deviations}})
    play = mechanism_class("backlash").at({"travel_mm": 6.0, "coasting_mm": 3.0})
    model = SessionLikelihood(
        ExactBase(robot), simulated_noise(), simulated_session(robot, [play], 5), settings=settings
    )
    found = estimate(model, [play])
    wider = np.sqrt(np.diag(with_further_uncertainty(model, found).covariance - found.covariance))
    by_name = dict(zip(("travel_mm", "coasting_mm"), wider, strict=True))
    assert by_name["travel_mm"] == pytest.approx(deviations * 0.15 * found.values[0])
    assert by_name["coasting_mm"] == pytest.approx(0.0, abs=1e-6)
