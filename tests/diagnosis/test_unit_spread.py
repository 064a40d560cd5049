"""Units of a robot differ a little: that is no gap, and more than that is."""

import dataclasses

import numpy as np
import pytest
import torch
from exact_base import SPREAD, ExactBase, Losing, known_noise, session_of
from fleet import errors_of, fleet_session, of_wheels, shown_by
from simulated_session import simulated_noise, simulated_session

from exact_model import TRACK_MM, LaggingDynamics
from swarmtwin.diagnosis.cause_search import CauseSearch, prior_log_odds
from swarmtwin.diagnosis.estimation import estimate
from swarmtwin.diagnosis.likelihood import SessionLikelihood
from swarmtwin.diagnosis.measured_session import MeasuredSession
from swarmtwin.diagnosis.motion_noise_change import motion_noise_change
from swarmtwin.diagnosis.own_units import unit_differences, with_own_unit
from swarmtwin.diagnosis.reference import Reference
from swarmtwin.diagnosis.settings import DiagnosisSettings, UnitSettings
from swarmtwin.diagnosis.unit_spread import UnitSpread, unit_changes
from swarmtwin.geometry import compose, exp_map
from swarmtwin.robot import Robot
from swarmtwin.simulation.actuation import with_actuation
from swarmtwin.simulation.efforts import twist_of_wheels, wheel_travel
from swarmtwin.simulation.mechanism import mechanism_class

NAMED = 5.1
"""Nats by which a cause with prior odds of 1 : 19 has a probability of 90 %."""


def model_of(robot, moved, vehicle, known=("1",), unit_spread=None, noise=1.0):
    base, spread = ExactBase(robot), [noise * one for one in SPREAD]
    drawn = torch.tensor(spread, dtype=torch.float64)
    session = session_of(base, np.random.default_rng(1), moved, spread=lambda way: drawn, vehicle=vehicle)
    usual = None if unit_spread is None else UnitSpread(unit_spread)
    return SessionLikelihood(base, known_noise(spread), session, known, usual)


def nats(model, name, **start):
    """Evidence for a cause over nothing."""
    return estimate(model, [mechanism_class(name).at(start)]).evidence - estimate(model, []).evidence


@pytest.mark.parametrize(("left", "right"), [(1.02, 1.02), (0.95, 0.95), (1.05, 0.97), (0.99, 1.01)])
def test_another_unit_that_differs_a_little_is_no_gap(robots, left, right):
    moved = of_wheels(left, right)
    for name, start in (("gain_change", {"gain": 1.0}), ("actuator_asymmetry", {"ratio": 1.0})):
        assert nats(model_of(robots["mgr"], moved, "2"), name, **start) < NAMED / 3
    same_unit = model_of(robots["mgr"], moved, "1")
    either = nats(same_unit, "gain_change", gain=1.0), nats(same_unit, "actuator_asymmetry", ratio=1.0)
    assert max(either) > 2 * NAMED
    assert not same_unit.unknown_vehicles


def test_another_unit_whose_wheels_start_at_other_commands_is_no_gap(robots):
    """Faster or slower at any speed by 5 % of what is usual: no weaker supply, and no dead band either."""

    def started(moment):
        wheels = wheel_travel(moment.way, TRACK_MM)
        earlier = 0.05 * torch.tensor([[1.0, -0.6]]) * moment.base.robot.period_s * 60.0 * torch.sign(wheels)
        moves = wheels.abs() > 0.05 * moment.base.robot.period_s * 60.0
        return exp_map(twist_of_wheels(wheels + earlier * moves, moment.way, TRACK_MM))

    model = model_of(robots["mgr"], started, "2")
    for name, start in (("gain_change", {"gain": 1.0, "acts_on": "effort"}), ("actuator_asymmetry", {"ratio": 1.0})):
        assert nats(model, name, **start) < NAMED / 3
    assert nats(model_of(robots["mgr"], started, "1"), "actuator_asymmetry", ratio=1.0) > 2 * NAMED


class LaggingBase(LaggingDynamics):
    """As a diagnosis takes it."""

    members = 0


def test_another_unit_whose_motors_follow_a_little_more_slowly_is_no_gap(robots):
    def moved(moment):
        return exp_map(moment.way + 0.22 * (moment.way_before - moment.way))

    base, found = LaggingBase(robots["mgr"]), {}
    for vehicle in ("1", "2"):
        session = session_of(base, np.random.default_rng(1), moved, vehicle=vehicle)
        session = session.under(with_actuation(session.conditions, base, seed=1))
        model = SessionLikelihood(base, known_noise(), session, ("1",))
        found[vehicle] = nats(model, "actuator_lag", time_constant_s=0.02)
    assert found["1"] > 2 * NAMED
    assert found["2"] < NAMED / 3


def test_another_unit_that_differs_much_is_a_gap(robots):
    assert nats(model_of(robots["mgr"], of_wheels(0.65, 0.65), "2"), "gain_change", gain=1.0) > NAMED
    askew = model_of(robots["mgr"], of_wheels(1.2, 0.8), "2")
    assert nats(askew, "actuator_asymmetry", ratio=1.0) > NAMED


def test_another_unit_that_loses_commands_has_no_second_cause(robots):
    """What a unit does otherwise, it does in the direction of the command that is in force, lost ones or not."""
    model = model_of(robots["mgr"], Losing(0.08, 1, of_wheels(1.05, 0.96)), "2", noise=3.0)
    starts = {"command_loss": {"probability": 0.08}, "actuator_asymmetry": {"ratio": 1.0}}
    loss, askew = (mechanism_class(name).at(start) for name, start in starts.items())
    alone = estimate(model, [loss])
    assert alone.evidence - estimate(model, []).evidence > 50 * NAMED
    assert estimate(model, [loss, askew]).evidence - alone.evidence < NAMED / 3


def test_what_differs_more_than_units_do_is_estimated(robots):
    model = model_of(robots["mgr"], of_wheels(1.15, 1.15), "2", unit_spread=0.02)
    fit = estimate(model, [mechanism_class("gain_change").at({"gain": 1.0})])
    assert fit.mechanisms[0].gain == pytest.approx(1.15, abs=0.03)


def test_the_better_units_are_known_the_smaller_is_a_gap(robots):
    """Ten per cent are two standard deviations of the prior and no gap; of units that differ by 1 %, they are ten."""
    moved = of_wheels(0.9, 0.9)
    assert nats(model_of(robots["mgr"], moved, "2"), "gain_change", gain=1.0) < NAMED / 3
    assert nats(model_of(robots["mgr"], moved, "2", unit_spread=0.01), "gain_change", gain=1.0) > 2 * NAMED


@pytest.mark.parametrize(("factor", "is_likelier"), [(0.78, True), (0.9, False), (1.0, False)])
def test_what_another_unit_changes_must_matter_and_the_evidence_tell_it_from_fabrication(robots, factor, is_likelier):
    """More than four standard deviations of fabrication are named, two are not: the prior leaves little evidence."""
    model = model_of(robots["mgr"], of_wheels(factor, factor), "2")
    search = CauseSearch(model, {"gain_change": mechanism_class("gain_change")})
    posterior = search.run()
    assert (posterior.probability("gain_change") > 0.9) == is_likelier
    slower = estimate(model, [mechanism_class("gain_change").at({"gain": 1.0})])
    nothing = estimate(model, [])
    too_little = model.settings.search.least_nats_a_transition * len(model.session)
    assert slower.evidence - nothing.evidence < NAMED + too_little  # not enough, were all that it changes evidence


@pytest.mark.parametrize(("other", "start"), [("camera_scale", {"scale": 1.15}), ("gain_change", {"gain": 1.15})])
def test_what_is_asked_of_one_cause_is_not_less_beside_another_that_units_make_up_for(robots, other, start):
    """The second changes much, hardly any of which is evidence: that is asked of it alone."""
    delay = mechanism_class("command_delay").at({"delay_s": 0.02})
    session = simulated_session(robots["mgr"], [delay], 7)
    model = SessionLikelihood(ExactBase(robots["mgr"]), simulated_noise(), session, ("another",), UnitSpread(0.05))
    search = CauseSearch(model, {name: mechanism_class(name) for name in ("command_delay", other)})
    alone = estimate(model, [delay])
    both = estimate(model, [delay, mechanism_class(other).at(start)])
    asked, asked_of_both = (search.score(one) - one.evidence for one in (alone, both))
    settings = model.settings.search
    least = prior_log_odds(settings) + settings.least_share_beside * (both.evidence - estimate(model, []).evidence)
    matters = settings.least_nats_a_transition * len(session)
    assert least < asked - asked_of_both < least + 0.1 * matters


def test_what_is_a_vehicles_own_is_told_with_its_interval(robots):
    """Of a unit that the reference knows there is nothing to tell."""
    (unit,) = unit_differences(model_of(robots["mgr"], of_wheels(0.94, 0.94), "2"), ())
    assert unit.vehicle == "2"
    for factor in (unit.way, unit.turn):
        assert factor.usual == 0.05
        assert factor.low < 0.94 < factor.high
        assert factor.high - factor.low < 0.02
    assert unit.is_unusual
    assert unit_differences(model_of(robots["mgr"], of_wheels(0.94, 0.94), "1"), ()) == ()
    (askew,) = unit_differences(model_of(robots["mgr"], of_wheels(0.94, 1.0), "2"), ())
    assert askew.left_to_right.low < 0.94 < askew.left_to_right.high
    assert (askew.left_to_right.value, askew.way.value) == (
        pytest.approx(0.94, abs=0.01),
        pytest.approx(0.97, abs=0.01),
    )
    weaker = [mechanism_class("gain_change").at({"gain": 0.9})]
    (beside,) = unit_differences(model_of(robots["mgr"], of_wheels(0.94 * 0.9, 0.94 * 0.9), "2"), weaker)
    assert beside.way.value == pytest.approx(0.94, abs=0.01)


def test_what_is_left_of_a_strange_unit_is_noise(robots):
    model = model_of(robots["mgr"], of_wheels(1.02, 0.98), "2")
    residual = model.evaluate([]).residual
    size = model.simulated.numpy()
    for axis in (0, 2):
        assert abs(np.corrcoef(residual[:, axis], size[:, axis])[0, 1]) < 0.03
    np.testing.assert_allclose(residual.std(axis=0), 1.0, atol=0.04)


def test_a_strange_unit_goes_by_one_factor_and_turns_by_another(robots):
    """As one of another track does, or one that a camera of another scale sees."""

    def moved(moment):
        return exp_map(moment.way * torch.tensor([0.85, 1.0, 1.06]))

    model, alone = (model_of(robots["mgr"], moved, "2", unit_spread=spread) for spread in (None, 0.0))
    gain, askew = with_own_unit((), model, alone)
    assert (gain.name, askew.name) == ("gain_change", "actuator_asymmetry")
    assert gain.gain == pytest.approx(0.85, abs=0.005)
    assert gain.turning == pytest.approx(1.06, abs=0.005)
    assert askew.ratio == pytest.approx(1.0, abs=0.005)
    again = mechanism_class("gain_change")(**gain.model_dump())
    torch.testing.assert_close(again.supply_gain(model.predictor.moment()), gain.supply_gain(model.predictor.moment()))
    known = model_of(robots["mgr"], moved, "1")
    assert with_own_unit((), known, known) == ()


def test_a_delay_is_no_difference_of_units(robots):
    def late(moment):
        return compose(exp_map(0.1 * moment.way_before), exp_map(0.9 * moment.way))

    model = model_of(robots["mgr"], late, "2")
    fit = estimate(model, [mechanism_class("command_delay").at({"delay_s": 0.02})])
    assert fit.evidence - estimate(model, []).evidence > 50 * NAMED
    assert fit.mechanisms[0].delay_s == pytest.approx(0.05, abs=0.001)


def test_a_difference_twice_as_large_costs_four_times_as_much(robots):
    model = model_of(robots["mgr"], of_wheels(1.02, 1.0), "2")
    whitened = model.whitened([])
    sizes, twice = (model.effects.sizes(factor * whitened) for factor in (1, 2))
    np.testing.assert_allclose(twice, 2 * sizes)
    assert twice @ twice == pytest.approx(4 * (sizes @ sizes))
    assert sizes @ sizes > 0


def estimated(robot, units, spread, seed, prior_units=2.0):
    return shown_by(*fleet_session(robot, units, spread, seed), prior_units).spread


def test_one_unit_says_nothing_of_the_spread_between_units(robots):
    assert estimated(robots["mgr"], 1, 0.2, 1) == UnitSpread(UnitSettings().spread)


@pytest.mark.parametrize("spread", [0.01, 0.04, 0.1])
def test_the_spread_between_many_units_is_estimated(robots, spread):
    """Wheels' speeds of spread σ: ahead and turning go with their mean, σ/√2, the difference with √2 σ."""
    found = [estimated(robots["mgr"], 8, spread, seed, prior_units=0.01) for seed in range(6)]
    for name, share in (("ahead", np.sqrt(0.5)), ("turn", np.sqrt(0.5)), ("left_to_right", np.sqrt(2.0))):
        mean = np.sqrt(np.mean([one.of(name) ** 2 for one in found]))
        assert mean == pytest.approx(share * spread, rel=0.3), name


def test_what_several_units_hardly_show_stays_as_expected_beforehand(robots):
    """These wheels slide nowhere, and start as on the drawing: of the one nothing is known, of the other much."""
    found = estimated(robots["mgr"], 8, 0.02, 1)
    assert found.of("aside") == UnitSettings().spread
    assert found.of("start") < 0.7 * UnitSettings().spread


def test_few_units_move_the_prior_a_little_many_more(robots):
    prior = UnitSettings().spread
    alike = [estimated(robots["mgr"], units, 0.0, 3).of("turn") for units in (2, 5, 12)]
    were_they_exact = prior * np.sqrt(2 / (2 + np.array([1, 4, 11])) * (1 + 1 / np.array([2, 5, 12])))
    assert (alike > were_they_exact).all()  # what they are uncertain by leaves more of the prior
    assert (alike < 1.1 * were_they_exact).all()
    assert estimated(robots["mgr"], 5, 0.2, 3).of("turn") > 1.5 * prior


def test_a_reference_of_several_units_expects_what_it_has_seen_and_the_robots_file_goes_before(robots):
    settings = DiagnosisSettings()
    alike = fleet_session(robots["mgr"], 5, 0.0, 4)[1].transitions
    assert Reference.learn(alike, 1).unit_spread.of("turn") < 0.7 * settings.units.spread
    measured = Robot.parse({**robots["mgr"].model_dump(mode="json"), "unit_spread": 0.013}, "measured")
    one = dataclasses.replace(alike, vehicle=np.zeros_like(alike.vehicle), vehicles=("1",), robot=measured)
    assert Reference.learn(one, 1).unit_spread == UnitSpread(0.013)
    stated = Reference.learn(dataclasses.replace(alike, robot=measured), 1).unit_spread
    assert stated.usual == 0.013
    assert stated.of("turn") < 0.013


def test_of_several_units_a_simulation_knows_none_by_itself(robots):
    """It answers for their mean; a unit that differs from that is no gap, whether or not it was among them."""
    _, session = fleet_session(robots["mgr"], 4, 0.05, 2)
    reference = Reference.learn(session.transitions, 1)
    assert reference.vehicles == ("1", "2", "3", "4")
    for vehicle in range(4):
        own = session.where(session.transitions.vehicle == vehicle)
        model = reference.likelihood_of(own)
        assert model.unknown_vehicles == (str(vehicle + 1),)
        for name, start in (("gain_change", {"gain": 1.0}), ("actuator_asymmetry", {"ratio": 1.0})):
            assert nats(model, name, **start) < NAMED


def test_a_reference_less_what_each_unit_has_of_its_own_is_of_one_unit(robots):
    """Errors are smaller by what units' wheels make of them, and nothing else is taken off."""
    base, session = fleet_session(robots["mgr"], 5, 0.1, 2, about=1.0)
    units = shown_by(base, session)
    left = errors_of(base, session.less(units.errors))
    away = np.abs(left - (errors_of(base, session) - units.errors)).max(axis=0)
    assert (away < [0.3, 0.3, 1e-6]).all()  # mm, to first order, and rad
    assert np.std(units.errors[:, 0]) > 1.5  # as much as noise of 1 mm makes
    assert np.std(left, axis=0) == pytest.approx(SPREAD, rel=0.06)
    assert not shown_by(*fleet_session(robots["mgr"], 1, 0.1, 2)).errors.any()


def motion_noise(reference):
    """Standard deviations (3,) of its motion."""
    return np.sqrt(reference.noise.motion_variance(reference.own_likelihood().motion))


@pytest.mark.parametrize(("units", "in_turn"), [(3, True), (5, False), (6, True)])
def test_how_units_of_a_reference_differ_is_no_noise_to_its_simulation(robots, units, in_turn):
    """In whatever order they drove: folds of runs leave out none of them."""
    references = [
        Reference.learn(fleet_session(robots["mgr"], units, spread, 2, in_turn=in_turn)[1].transitions, 1)
        for spread in (0.1, 0.0)
    ]
    of_unlike, of_like = map(motion_noise, references)
    np.testing.assert_allclose(of_unlike, of_like, rtol=0.06)


def test_what_all_units_share_is_none_of_their_own(robots):
    base, session = fleet_session(robots["mgr"], 4, 0.0, 2, about=1.1)
    found = shown_by(base, session)
    assert np.std(errors_of(base, session)[:, 0]) > 1.7
    assert (np.abs(found.errors).max(axis=0) < [0.5, 0.5, 0.02]).all()


@pytest.mark.parametrize(("of_reference", "spread", "noise"), [(5, 0.1, 1.0), (5, 0.05, 0.5), (1, 0.05, 1.0)])
def test_several_other_units_are_not_more_random_for_being_unlike(robots, of_reference, spread, noise):
    """Nor is a single one that differs by many times the noise."""
    learned = fleet_session(robots["mgr"], of_reference, spread, 3, runs=60 // of_reference, noise=noise)[1]
    reference = Reference.learn(learned.transitions, 1)
    measured = fleet_session(robots["mgr"], 5, spread, 4, noise=noise)[1].transitions
    measured = dataclasses.replace(measured, vehicles=tuple("abcde"))
    single = measured.where(measured.vehicle == 0)
    for session in (measured, single):
        model = reference.likelihood_of(MeasuredSession.of(session, reference.session.conditions))
        change = motion_noise_change(model, (), lambda: 0.0)
        assert change.factor == pytest.approx(1.0, abs=0.1)
        assert change.probability < 0.1


def test_a_unit_that_does_not_show_a_difference_says_nothing_of_it(robots):
    """Of two units one stands still all the time, and one alone shows no spread."""
    base, session = fleet_session(robots["mgr"], 2, 0.0, 5)
    transitions, still = session.transitions, session.transitions.vehicle == 1
    command = np.where(still[:, None], 0.0, transitions.command)
    previous = np.where(still[:, None], 0.0, transitions.previous_command)
    earlier = np.where(still[:, None], 0.0, transitions.earlier_command)
    noise = np.random.default_rng(1).normal(size=(len(still), 3)) * SPREAD
    displacement = np.where(still[:, None], noise, transitions.displacement)
    transitions = dataclasses.replace(
        transitions,
        command=command,
        previous_command=previous,
        earlier_command=earlier,
        displacement=displacement,
    )
    session = MeasuredSession.of(transitions, session.conditions)
    assert shown_by(base, session).spread == UnitSpread(UnitSettings().spread)


def test_no_shipped_robot_states_what_only_its_stand_in_knows(robots):
    assert {robot.unit_spread for robot in robots.values()} == {None}


def test_fins_that_never_move_show_no_difference_in_when_they_start(robots):
    robot = robots["mur"]
    base, command = ExactBase(robot), np.zeros((6, 10, len(robot.command)))
    command[..., robot.command_columns.index("frequency_rad_s")] = 5.0
    session = session_of(base, np.random.default_rng(1), command=command)
    predictor = SessionLikelihood(base, known_noise(), session).predictor
    changes = unit_changes(predictor, predictor.twist(()), session)
    assert not changes["start"].any()
    assert all(one.isfinite().all() for one in changes.values())
