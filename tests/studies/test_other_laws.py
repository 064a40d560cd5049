"""Causes that act by another law than their mechanisms: each does what it says, and is what it is said to be."""

import dataclasses
import math

import numpy as np
import pytest

from swarmtwin.robot import Arena
from swarmtwin.standin.active_effects import ActiveEffects
from swarmtwin.standin.effect import Placement
from swarmtwin.standin.effects import catalogue
from swarmtwin.standin.session import StandInSession, drive_session
from swarmtwin.studies.hidden_effects.cases import Case, cases
from swarmtwin.studies.hidden_effects.other_laws import (
    OTHER_LAW_PARAMETERS,
    OTHER_LAW_SIZES,
    OTHER_LAWS,
    BatteryKnee,
    ChangedBattery,
    ChannelCurrent,
    DriftingScale,
    FourthOrderLens,
    GradualDeadBand,
    InverseSquareInteraction,
    LateReadings,
    LeakySaturation,
    LimitedAcceleration,
    LinearWallEffect,
    LossInBursts,
    OblongPixels,
    RectangularPatch,
    SoftPatch,
    WornRim,
)
from swarmtwin.studies.hidden_effects.sessions import measured_session, record_session

SQUARE = Arena(x=(0.0, 1000.0), y=(0.0, 1000.0))


def placed(x_mm=500.0, y_mm=500.0, heading_rad=0.0, progress=0.0, neighbours=()):
    x_mm, y_mm, heading_rad, progress = (
        np.atleast_2d(np.asarray(one, float)) for one in (x_mm, y_mm, heading_rad, progress)
    )
    others = np.array(neighbours, float).reshape(-1, 2, 1, 1)
    return Placement(progress, x_mm, y_mm, heading_rad, others[:, 0], others[:, 1])


def test_the_tables_agree_and_each_is_a_cause_of_the_catalogue():
    assert set(OTHER_LAWS) == set(OTHER_LAW_SIZES) == set(OTHER_LAW_PARAMETERS)
    assert not set(OTHER_LAWS) & set(catalogue())
    assert {law.cause for law in OTHER_LAWS.values()} <= set(catalogue())


def test_all_laws_take_turns_and_what_is_to_be_named_is_the_cause():
    turns = {(robot, name) for name, fits in OTHER_LAW_SIZES.items() for robot in fits}
    drawn = cases("formulas", "misspecified", len(turns), 3)
    assert {(case.robot, case.about) for case in drawn} == turns
    assert all(case.true_names == (OTHER_LAWS[case.about].cause,) for case in drawn)


def test_walls_are_felt_in_a_straight_line_or_in_a_strip():
    at = placed(x_mm=[0.0, 50.0, 150.0, 500.0])
    np.testing.assert_allclose(LinearWallEffect(loss=0.4, width_mm=100.0).traction(at, SQUARE)[0], [0.6, 0.8, 1, 1])
    np.testing.assert_allclose(WornRim(loss=0.4, width_mm=100.0).traction(at, SQUARE)[0], [0.6, 0.6, 1, 1])


def test_patches_are_without_an_edge_or_have_corners():
    soft = SoftPatch(loss=0.5, x_mm=400.0, y_mm=500.0, width_mm=100.0)
    np.testing.assert_allclose(
        soft.traction(placed(x_mm=[400.0, 500.0, 900.0]), SQUARE)[0], [0.5, 1 - 0.5 * math.exp(-0.5), 1], atol=1e-4
    )
    mat = RectangularPatch(loss=0.5, x_mm=500, y_mm=500, length_mm=400, width_mm=100, direction_rad=math.pi / 2)
    at = placed(x_mm=[500.0, 540.0, 560.0, 500.0], y_mm=[690.0, 500.0, 500.0, 710.0])
    np.testing.assert_allclose(mat.traction(at, SQUARE)[0], [0.5, 0.5, 1, 1])


def test_a_battery_falls_fast_at_last_or_is_changed():
    at = placed(progress=[0.0, 0.4, 0.8, 1.0])
    np.testing.assert_allclose(BatteryKnee(loss=0.5).strength(at)[0], [1, 0.94, 0.88, 0.5])
    at = placed(progress=[0.0, 0.25, 0.49, 0.5, 0.75])
    np.testing.assert_allclose(ChangedBattery(loss=0.5).strength(at)[0], [1, 0.75, 0.51, 1, 0.75])


def test_a_lens_bends_the_edge_alone_pixels_are_longer_than_wide_and_a_scale_drifts():
    np.testing.assert_allclose(FourthOrderLens(coefficient=0.2).magnification(np.array([0, 0.5, 1])), [1, 1.0125, 1.2])
    pixels = OblongPixels(error=0.1, x_mm=500.0, y_mm=500.0)
    seen = pixels.picture(np.array([[600.0, 300.0, 0.0], [600.0, 300.0, math.pi / 4 + 4 * math.pi]]), 0.0)
    np.testing.assert_allclose(seen[0], [615.0, 290.0, 0.0])
    assert seen[1, 2] == pytest.approx(4 * math.pi + math.atan2(1.05, 1.15))
    sinking = DriftingScale(error=0.1, x_mm=500.0, y_mm=500.0)
    seen = sinking.picture(np.array([[600.0, 300.0, 1.0]] * 3), np.array([0.0, 0.5, 1.0]))
    np.testing.assert_allclose(seen, [[600, 300, 1], [610, 280, 1], [620, 260, 1]])


def test_neighbours_push_by_an_inverse_square():
    push = InverseSquareInteraction(strength_mm_s=30.0, reach_mm=100.0)
    x_mm_s, y_mm_s = push.drift_velocity_mm_s(placed(x_mm=600.0, neighbours=[(500.0, 500.0)]))
    assert x_mm_s[0, 0] == pytest.approx(7.5, rel=1e-3)
    assert y_mm_s[0, 0] == pytest.approx(0.0)


def test_large_commands_do_less_and_small_ones_little(robots):
    command = np.array([[120.0, -60.0], [20.0, 0.0]]).T.reshape(2, 2, 1)
    leaky = LeakySaturation(limit=70.0).transform_command(command, robots["mgr"])
    np.testing.assert_allclose(leaky[:, :, 0].T, [[90, -60], [20, 0]])
    gradual = GradualDeadBand(width=20.0).transform_command(command, robots["mgr"])
    np.testing.assert_allclose(gradual[:, :, 0].T, [[120 * 36 / 37, -54], [10, 0]])
    fin = np.array([10.0, 40.0, 9.0]).reshape(3, 1, 1)
    np.testing.assert_allclose(LeakySaturation(limit=30.0).transform_command(fin, robots["mur"])[:, 0, 0], [10, 34, 9])


def test_motors_of_limited_acceleration_lag_behind_far_changes_alone(robots):
    drive = np.array([[0.0, 0.0], [100.0, 100.0], [110.0, 110.0], [0.0, 0.0]])
    session = StandInSession(robots["mgr"], ("1",), 40, 4, 5, drive=np.tile(drive, (1, 1)))
    slow = dataclasses.replace(session, effects=(LimitedAcceleration(step_mm_s=10.0),))
    way = [np.diff(drive_session(one).state[0], axis=1) for one in (slow, session)]
    lost = np.abs(way[1] - way[0]).mean(axis=(0, 2))
    assert lost[1] > 4 * lost[0]
    assert lost[1] > 2 * lost[2]


def test_a_current_is_weaker_at_the_sides_it_flows_along():
    channel = ChannelCurrent(speed_mm_s=10.0, direction_rad=math.pi / 2, x_mm=500.0, y_mm=500.0, half_mm=500.0)
    x_mm_s, y_mm_s = channel.drift_velocity_mm_s(placed(x_mm=[500.0, 250.0, 0.0], y_mm=[100.0, 700.0, 0.0]))
    np.testing.assert_allclose(x_mm_s[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(y_mm_s[0], [10.0, 8.0, 2.0])


def test_late_readings_are_as_long_on_average_and_spread_as_said():
    durations = LateReadings(spread=0.1).durations(np.full(200_000, 0.5), np.random.default_rng(1)) / 0.5
    assert durations.mean() == pytest.approx(1.0, abs=3e-3)
    assert durations.std() == pytest.approx(0.1, rel=0.1)
    assert durations.min() == pytest.approx(0.9, abs=1e-4)
    assert durations.max() == pytest.approx(1.3)


@pytest.mark.parametrize("probability", [0.05, 0.3])
def test_as_many_commands_are_lost_as_said_four_in_a_row(robots, probability):
    conditions = ActiveEffects(robots["mgr"], (LossInBursts(probability=probability),))
    chance, lost, all_lost = np.random.default_rng(3).random((400, 500)), None, []
    for own in chance:
        lost = conditions.lost(own, lost)
        all_lost.append(lost)
    lost = np.array(all_lost)
    assert lost.mean() == pytest.approx(probability, rel=0.05)
    assert lost.sum() / (lost[0].sum() + (lost[1:] & ~lost[:-1]).sum()) == pytest.approx(4.0, rel=0.05)
    alone = ActiveEffects(robots["mgr"], catalogue_effects(robots["mgr"], "command_loss"))
    np.testing.assert_array_equal(alone.lost(chance[1], lost[0]), chance[1] < alone.loss_probability)


def catalogue_effects(robot, name):
    return (catalogue()[name]().on(robot, 1),)


@pytest.mark.parametrize("family", ["formulas", "rigid_body"])
def test_a_session_loses_commands_in_bursts(robots, family):
    pytest.importorskip("mujoco")
    from swarmtwin.studies.stand_in_families import driver_of

    session = StandInSession(robots["mgr"], ("1",), 60, 30, 5, effects=(LossInBursts(probability=0.3),))
    driven = driver_of(family)(session)
    came = np.moveaxis(driven.command, -1, 0)
    lost = (driven.active_command[:, :, 1:] != came).any(axis=0)
    begun = lost[:, 0].sum() + (lost[:, 1:] & ~lost[:, :-1]).sum()
    assert lost.mean() == pytest.approx(0.3, abs=0.06)
    assert lost.sum() / begun == pytest.approx(4.0, rel=0.3)


def test_an_interaction_has_a_neighbour_and_truth_has_a_name_without_parameters(robots):
    case = Case(
        family="formulas",
        kind="misspecified",
        robot="mgr",
        names=["inverse_square_interaction"],
        rises_percent=[20.0],
        seed=3,
        runs=20,
        steps=10,
        reference_runs=20,
    )
    assert len(measured_session(case, robots["mgr"]).session.vehicles) == 2
    truth = record_session(case).truth
    assert truth.causes == {"neighbour_interaction": {}}
    assert truth.effects[0]["name"] == "inverse_square_interaction"
