"""The catalogue is that of the design, each mechanism says what it is, and does nothing where it is neutral."""

import itertools
import string
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from exact_model import conditions_of, moved, situation_of
from swarmtwin.errors import UserError
from swarmtwin.robot import Arena, Robot
from swarmtwin.simulation.mechanism import mechanism, mechanism_class, mechanism_names, offered
from swarmtwin.simulation.traction_score import LocalTractionScore

CATALOGUE = {
    "gain_change",
    "actuator_asymmetry",
    "dead_band",
    "saturation",
    "command_delay",
    "actuator_lag",
    "backlash",
    "battery_sag",
    "surface_patch",
    "steady_drift",
    "wall_effect",
    "neighbour_interaction",
    "camera_scale",
    "lens_distortion",
    "marker_offset",
    "marker_yaw",
    "command_loss",
    "timing_jitter",
    "noise_change",
}
ROBOTS = ("mgr", "mur", "create")


def changed(robot, **content):
    return Robot.parse({**robot.model_dump(mode="json"), **content}, "changed")


def braces(words):
    return {field for _, field, _, _ in string.Formatter().parse(words) if field}


def test_the_catalogue_is_that_of_the_design():
    assert set(mechanism_names()) >= CATALOGUE


@pytest.mark.parametrize("name", sorted(CATALOGUE))
def test_a_mechanism_says_what_it_is_and_what_to_do(robots, name):
    kind = mechanism_class(name)
    assert kind.model_fields["name"].default == name
    assert kind.remedy[0].islower()
    told = [
        set(form.units(robots[robot], conditions_of(robots[robot])))
        for robot in ROBOTS
        for form in kind.forms(robots[robot])
        if kind.suits(robots[robot], conditions_of(robots[robot]))
    ]
    assert told
    assert braces(kind.words) <= set(kind.usual_form()).union(*told)
    assert all(braces(kind.words) & parameters for parameters in told)


@pytest.mark.parametrize("name", sorted(CATALOGUE))
@pytest.mark.parametrize("robot", ROBOTS)
def test_parameters_are_bounded_and_searches_begin_inside(robots, robot, name):
    robot = robots[robot]
    conditions = conditions_of(robot)
    kind = offered(robot, conditions).get(name)
    assert kind is not None
    parameters = kind.parameters_of(robot, conditions_of(robot))
    for parameter in parameters.values():
        assert parameter.low < parameter.high
        assert 0 < parameter.response_step < parameter.size / 2
        assert parameter.null_value is None or parameter.low <= parameter.null_value <= parameter.high
        assert all(parameter.low <= start <= parameter.high for start in parameter.initial_values)
    for start in kind.initial_points(robot, conditions):
        assert set(start) == set(parameters)
        assert all(parameter.low <= start[field] <= parameter.high for field, parameter in parameters.items())
        assert set(kind.at({**start, **_observed(kind, robot)}).reported()) == set(kind.units(robot, conditions))
        mechanism({"name": name, **start, **_observed(kind, robot)}, "here")
    assert not parameters or any(parameter.null_value is not None for parameter in parameters.values())


def test_a_search_for_a_patch_begins_where_it_explains_most(robots):
    """Slopes as a disc leaves them that no grid holds, among others of chance alone."""
    robot, rng, true = robots["mgr"], np.random.default_rng(4), np.array([437.0, 561.0, 178.0])
    position = rng.uniform(0.0, 1030.0, (4000, 2))
    inside = np.hypot(*(position - true[:2]).T) < true[2]
    slope = 0.3 * inside + rng.normal(0.0, 0.3, len(position))
    found = mechanism_class("surface_patch").initial_points(
        robot, conditions_of(robot), LocalTractionScore(position, slope, np.ones(len(position)))
    )
    assert (
        np.abs([found[0][name] - one for name, one in zip(("x_mm", "y_mm", "radius_mm"), true, strict=True)]).max() < 30
    )
    assert found[0]["loss"] == pytest.approx(0.3, abs=0.08)


def _observed(kind, robot):
    return kind.read_from_clock(robot.period_s * np.array([0.9, 1.1]), robot) or {}


def test_an_unknown_cause_and_an_unknown_parameter_are_refused_with_the_near_miss():
    with pytest.raises(UserError, match="gain_change"):
        mechanism({"name": "gain_chance", "gain": 1.0}, "here")
    with pytest.raises(UserError, match=r"here: unknown field 'gian'.*gain"):
        mechanism({"name": "gain_change", "gain": 1.0, "gian": 1.0}, "here")


def test_what_makes_no_sense_for_a_robot_is_not_offered(robots):
    mgr, mur = robots["mgr"], robots["mur"]
    assert set(offered(mgr, conditions_of(mgr))) >= CATALOGUE
    without_track = set(offered(mgr, conditions_of(mgr, track_mm=None)))
    assert without_track & CATALOGUE == CATALOGUE - {"actuator_asymmetry", "backlash"}
    boat = {"kind": "thrust", "effort": ["amplitude_deg"]}
    beat = {name: mur.command[name].model_dump() for name in ("amplitude_deg", "frequency_rad_s")}
    unsteered = changed(mur, command=beat, actuators=boat, kinematics="unicycle")
    assert set(offered(unsteered, conditions_of(unsteered))) & CATALOGUE == CATALOGUE - {"actuator_asymmetry"}
    columns = {"angle": {"low": -79, "high": 79, "unit": "deg"}, "jet": {"low": 0, "high": 12, "unit": "V"}}
    actuators = {"kind": "thrust", "effort": ["jet"], "steering": "angle"}
    jet = changed(mur, command=columns, actuators=actuators, kinematics="unicycle")
    assert set(offered(jet, conditions_of(jet))) & CATALOGUE == CATALOGUE - {"backlash"}
    car = robots["car"]  # its wheels' distance is of no use, since they cannot be driven apart
    assert set(offered(car, conditions_of(car, track_mm=None))) & CATALOGUE == CATALOGUE - {"backlash"}
    unknown = changed(mgr, kinematics=None, actuators=None)
    without = {"actuator_asymmetry", "backlash", "actuator_lag", "dead_band", "saturation"}
    assert set(offered(unknown, conditions_of(unknown))) & CATALOGUE == CATALOGUE - without


def test_parameters_are_those_of_the_actuator(robots):
    backlash, asymmetry = mechanism_class("backlash"), mechanism_class("actuator_asymmetry")
    assert set(backlash.parameters_of(robots["mgr"], conditions_of(robots["mgr"]))) == {"travel_mm", "coasting_mm"}
    fin = backlash.parameters_of(robots["mur"], conditions_of(robots["mur"]))
    assert set(fin) == {"travel_rad", "by_width", "servo_rad_s"}
    lag = mechanism_class("actuator_lag")
    assert set(lag.parameters_of(robots["mgr"], conditions_of(robots["mgr"]))) == {"time_constant_s"}
    own = {"time_constant_s", "own_time_constant_s", "own_turn_time_constant_s", "goes_on"}
    assert set(lag.parameters_of(robots["mur"], conditions_of(robots["mur"]))) == own
    delay = mechanism_class("command_delay")
    assert set(delay.parameters_of(robots["mgr"], conditions_of(robots["mgr"]))) == {"delay_s"}
    own = {"delay_s", "transient_time_constant_s"}
    assert set(delay.parameters_of(robots["mur"], conditions_of(robots["mur"]))) == own
    assert set(asymmetry.parameters_of(robots["mgr"], conditions_of(robots["mgr"]))) == {"ratio"}
    assert set(asymmetry.parameters_of(robots["mur"], conditions_of(robots["mur"]))) == {"angle_rad"}
    assert set(asymmetry.parameters_of(robots["car"], conditions_of(robots["car"]))) == {"angle_rad"}
    assert (
        mechanism_class("dead_band").parameters_of(robots["mgr"], conditions_of(robots["mgr"]))["width"].unit == "PWM"
    )
    assert (
        mechanism_class("saturation").parameters_of(robots["create"], conditions_of(robots["create"]))["limit"].unit
        == "mm/s"
    )


def test_an_end_is_doubted_where_something_may_be_beyond_it(robots):
    def doubted(robot, name):
        parameters = mechanism_class(name).parameters_of(robots[robot], conditions_of(robots[robot]))
        return {field: set(one.doubted) for field, one in parameters.items()}

    assert doubted("mgr", "gain_change")["gain"] == {0.2, 2.5}
    assert doubted("mgr", "battery_sag")["loss"] == set()  # all or nothing is lost there
    assert doubted("mgr", "wall_effect")["loss"] == {-0.5}  # no vehicle loses more than all of its way
    assert doubted("mgr", "surface_patch")["loss"] == {-0.6}
    assert doubted("mgr", "surface_patch")["x_mm"] == set()  # there the arena ends
    assert doubted("mur", "backlash")["servo_rad_s"] == {21.0}  # no servo takes play up at once
    own = ("own_time_constant_s", "own_turn_time_constant_s", "goes_on")
    assert doubted("mur", "actuator_lag") == {"time_constant_s": {0.8}} | {name: set() for name in own}


def test_a_fin_with_play_steers_late_by_what_its_servo_needs_to_take_it_up(robots):
    mur = robots["mur"]
    situation = situation_of(mur, np.random.default_rng(1))
    situation = replace(situation, earlier_command=situation.previous_command)
    late = {"travel_rad": 0.2, "by_width": 0.0, "servo_rad_s": 5.0}  # 40 ms of a period of 0.8 s
    measured, _ = moved(mur, "backlash", situation, **late)
    command = situation.command.clone()
    command[:, 0] += 0.05 * (situation.previous_command[:, 0] - command[:, 0])
    at_once, _ = moved(mur, "backlash", replace(situation, command=command), **{**late, "servo_rad_s": None})
    torch.testing.assert_close(measured, at_once, rtol=0, atol=1e-9)


def test_a_fin_with_play_is_at_most_a_period_late(robots):
    swift = changed(robots["mur"], period_s=0.1, longest_gap_s=0.12)
    played = mechanism_class("backlash").at({"travel_rad": 1.0, "by_width": 0.0, "servo_rad_s": 4.0})  # 250 ms
    command, previous = torch.tensor([[40.0, 30.0, 6.0]]), torch.tensor([[-20.0, 10.0, 4.0]])
    acting = played.mean_command(command, previous, SimpleNamespace(robot=swift))
    torch.testing.assert_close(acting, torch.tensor([[-20.0, 30.0, 6.0]]))


@pytest.mark.parametrize("name", sorted(CATALOGUE - {"timing_jitter"}))
@pytest.mark.parametrize("robot", ROBOTS)
def test_nothing_changes_where_a_mechanism_is_neutral_and_something_does_elsewhere(robots, robot, name):
    robot = robots[robot]
    situation = situation_of(robot, np.random.default_rng(1))
    kind = mechanism_class(name)
    parameters = kind.parameters_of(robot, conditions_of(robot))
    neutral = {
        field: one.initial_values[0] if one.null_value is None else one.null_value for field, one in parameters.items()
    }
    measured, simulated = moved(robot, name, situation, **neutral)
    torch.testing.assert_close(measured, simulated, rtol=0, atol=1e-5)
    away = {
        field: value if parameters[field].null_value is None else value + _inwards(parameters[field])
        for field, value in neutral.items()
    }
    if name not in ("noise_change", "command_loss"):
        measured, simulated = moved(robot, name, situation, **away)
        assert (measured - simulated).abs().max() > 1e-2


def _inwards(parameter):
    step = 0.2 * parameter.size
    return step if parameter.null_value + step <= parameter.high else -step


def test_a_patch_is_sought_in_the_arena_that_was_recorded_in(robots):
    """It may be larger than the robot's usual one."""
    hall = Arena(x=(-2000, 3000), y=(0, 4000))
    conditions = conditions_of(robots["mgr"], arena_mm=hall)
    bounds = {("surface_patch", "x_mm"): 3000, ("surface_patch", "radius_mm"): 1800, ("wall_effect", "reach_mm"): 2000}
    for (name, field), high in bounds.items():
        parameter = mechanism_class(name).parameters_of(robots["mgr"], conditions)[field]
        assert parameter.high == pytest.approx(high)


@pytest.mark.parametrize("name", sorted(CATALOGUE))
@pytest.mark.parametrize("robot", ROBOTS)
def test_motion_is_finite_in_every_corner_of_the_bounds_and_outside_the_arena(robots, robot, name):
    robot = robots[robot]
    conditions, rng = conditions_of(robot), np.random.default_rng(2)
    wide = {axis: (low - 150, high + 150) for axis, (low, high) in robot.arena_mm.model_dump().items()}
    situation = situation_of(changed(robot, arena_mm=wide), rng)
    kind = mechanism_class(name)
    bounds = kind.parameters_of(robot, conditions)
    for ends in itertools.product(*((one.low, one.high) for one in bounds.values())):
        values = {**dict(zip(bounds, ends, strict=True)), **_observed(kind, robot)}
        measured, _ = moved(robot, name, situation, **values)
        assert torch.isfinite(measured).all(), values
