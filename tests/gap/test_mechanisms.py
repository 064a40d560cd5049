"""The catalogue is that of the design, each mechanism says what it is, and does nothing where it is neutral."""

import string

import numpy as np
import pytest
import torch
from exact import drive_of, moved, surroundings_of

from swarmtwin.errors import UserError
from swarmtwin.gap.catalogue import mechanism, mechanism_class, mechanism_names, offered
from swarmtwin.robot import Robot

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
    assert set(mechanism_names()) == CATALOGUE


@pytest.mark.parametrize("name", sorted(CATALOGUE))
def test_a_mechanism_says_what_it_is_and_what_to_do(robots, name):
    kind = mechanism_class(name)
    assert kind.model_fields["name"].default == name
    assert kind.remedy[0].islower()
    told = [
        set(kind.units(robots[robot])) for robot in ROBOTS if kind.suits(robots[robot], surroundings_of(robots[robot]))
    ]
    assert told
    assert braces(kind.words) <= set().union(*told)
    assert all(braces(kind.words) & parameters for parameters in told)


@pytest.mark.parametrize("name", sorted(CATALOGUE))
@pytest.mark.parametrize("robot", ROBOTS)
def test_parameters_are_bounded_and_searches_begin_inside(robots, robot, name):
    robot = robots[robot]
    surroundings = surroundings_of(robot)
    kind = offered(robot, surroundings).get(name)
    assert kind is not None
    quantities = kind.quantities_of(robot)
    for quantity in quantities.values():
        assert quantity.low < quantity.high
        assert 0 < quantity.response_step < quantity.size / 2
        assert quantity.neutral is None or quantity.low <= quantity.neutral <= quantity.high
        assert all(quantity.low <= start <= quantity.high for start in quantity.starts)
    for start in kind.starts(robot, surroundings):
        assert set(start) == set(quantities)
        assert all(quantity.low <= start[field] <= quantity.high for field, quantity in quantities.items())
        assert set(kind.at({**start, **_observed(kind)}).reported()) == set(kind.units(robot))
        mechanism({"name": name, **start, **_observed(kind)}, "here")
    assert not quantities or any(quantity.neutral is not None for quantity in quantities.values())


def _observed(kind):
    return kind.observed(np.array([0.45, 0.55]), 0.5) or {}


def test_an_unknown_cause_and_an_unknown_parameter_are_refused_with_the_near_miss():
    with pytest.raises(UserError, match="gain_change"):
        mechanism({"name": "gain_chance", "gain": 1.0}, "here")
    with pytest.raises(UserError, match=r"here: unknown field 'gian'.*gain"):
        mechanism({"name": "gain_change", "gain": 1.0, "gian": 1.0}, "here")


def test_what_makes_no_sense_for_a_robot_is_not_offered(robots):
    mgr, mur = robots["mgr"], robots["mur"]
    assert set(offered(mgr, surroundings_of(mgr))) == CATALOGUE
    without_track = set(offered(mgr, surroundings_of(mgr, track_mm=None)))
    assert without_track == CATALOGUE - {"actuator_asymmetry", "backlash"}
    boat = {"kind": "thrust", "effort": ["amplitude_deg"]}
    unsteered = changed(mur, actuators=boat, kinematics="differential_drive")
    assert set(offered(unsteered, surroundings_of(unsteered))) == CATALOGUE - {"actuator_asymmetry"}
    columns = {"angle": {"low": -79, "high": 79, "unit": "deg"}, "jet": {"low": 0, "high": 12, "unit": "V"}}
    actuators = {"kind": "thrust", "effort": ["jet"], "steering": "angle"}
    jet = changed(mur, command=columns, actuators=actuators)
    assert set(offered(jet, surroundings_of(jet))) == CATALOGUE - {"backlash"}


def test_parameters_are_those_of_the_actuator(robots):
    backlash, asymmetry = mechanism_class("backlash"), mechanism_class("actuator_asymmetry")
    assert set(backlash.quantities_of(robots["mgr"])) == {"travel_mm"}
    assert set(backlash.quantities_of(robots["mur"])) == {"travel_rad"}
    assert set(asymmetry.quantities_of(robots["mgr"])) == {"ratio"}
    assert set(asymmetry.quantities_of(robots["mur"])) == {"angle_rad"}
    assert mechanism_class("dead_band").quantities_of(robots["mgr"])["width"].unit == "PWM"
    assert mechanism_class("saturation").quantities_of(robots["create"])["limit"].unit == "mm/s"


@pytest.mark.parametrize("name", sorted(CATALOGUE - {"timing_jitter"}))
@pytest.mark.parametrize("robot", ROBOTS)
def test_nothing_changes_where_a_mechanism_is_neutral_and_something_does_elsewhere(robots, robot, name):
    robot = robots[robot]
    drive = drive_of(robot, np.random.default_rng(1))
    kind = mechanism_class(name)
    quantities = kind.quantities_of(robot)
    neutral = {field: one.starts[0] if one.neutral is None else one.neutral for field, one in quantities.items()}
    measured, simulated = moved(robot, name, drive, **neutral)
    torch.testing.assert_close(measured, simulated, rtol=0, atol=1e-5)
    away = {
        field: value if quantities[field].neutral is None else value + _inwards(quantities[field])
        for field, value in neutral.items()
    }
    if name not in ("noise_change", "command_loss"):
        measured, simulated = moved(robot, name, drive, **away)
        assert (measured - simulated).abs().max() > 1e-2


def _inwards(quantity):
    step = 0.2 * quantity.size
    return step if quantity.neutral + step <= quantity.high else -step
