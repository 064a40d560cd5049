"""What no catalogue knows: each does what it says, and random fields have the size and the length scale they say."""

import math
from dataclasses import replace

import numpy as np
import pytest

from swarmtwin.geometry import displacement_between
from swarmtwin.standin.active_effects import ActiveEffects
from swarmtwin.standin.effect import Effect, Placement, Stroke
from swarmtwin.standin.effects import catalogue
from swarmtwin.standin.session import StandInSession, drive_session
from swarmtwin.studies.hidden_effects.outside_effects import OUTSIDE, OUTSIDE_EFFECTS, OUTSIDE_PARAMETERS
from swarmtwin.studies.hidden_effects.outside_ground import SwappedWheels, WarmUp
from swarmtwin.studies.hidden_effects.outside_measurement import (
    ComingOffMarker,
    DriftingClock,
    LooseCamera,
    ShiftedStrip,
    TiltedCamera,
)
from swarmtwin.studies.hidden_effects.outside_mechanics import (
    CrossCoupling,
    DraggingCable,
    OutOfRoundWheel,
    SharedSupply,
    SlippingWheel,
    StickyMotors,
    Temperature,
)
from swarmtwin.studies.hidden_effects.random_fields import Features, RandomCurrent, RandomGround, RandomStrength


def placed(x_mm=0.0, y_mm=0.0, heading_rad=0.0, progress=0.0, **told):
    x_mm, y_mm, heading_rad, progress = (
        np.atleast_2d(np.asarray(one, float)) for one in (x_mm, y_mm, heading_rad, progress)
    )
    nobody = np.empty((0, *x_mm.shape))
    return Placement(progress, x_mm, y_mm, heading_rad, nobody, nobody, **told)


def test_the_tables_agree_and_none_is_of_the_catalogue():
    assert set(OUTSIDE) == set(OUTSIDE_EFFECTS) == set(OUTSIDE_PARAMETERS)
    assert not set(OUTSIDE) & set(catalogue())
    physical = [name for name in OUTSIDE if not name.startswith("random_")]
    assert len(physical) >= 12


def test_a_random_field_has_the_size_it_says_over_its_inputs():
    rng = np.random.default_rng(1)
    for draw in range(5):
        field = RandomStrength(
            size=0.2, length_scale=0.3, low=(-120, -120), high=(120, 120), draw=draw, over="command", actuators=2
        )
        values = field.values(rng.uniform(-120, 120, (2, 40_000)))
        assert values.mean(axis=1) == pytest.approx([0, 0], abs=0.01)
        assert values.std(axis=1) == pytest.approx([0.2, 0.2], rel=0.04)
        assert abs(np.corrcoef(values)[0, 1]) < 0.9
    ground = RandomGround(size=0.1, length_scale=0.3, low=(0, 0), high=(1030, 1030), draw=7)
    everywhere = placed(*rng.uniform(0, 1030, (2, 1, 20_000)), rng.uniform(-math.pi, math.pi, (1, 20_000)))
    assert ground.traction(everywhere, None).std() == pytest.approx(0.1, rel=0.06)


@pytest.mark.parametrize("length", [0.15, 0.4])
def test_random_functions_correlate_over_the_length_scale_they_say(length):
    """Over many draws: exp(−d²/2ℓ²), so exp(−1/2) at one length scale and exp(−2) at two; variance 1 everywhere."""
    at = np.array([[0.5, 0.5 + length, 0.5 + 2 * length], [0.2, 0.2, 0.2]])
    values = np.stack([Features.drawn(1, 2, 48, length, seed)(at)[0] for seed in range(4000)])
    covariance = values.T @ values / len(values)
    np.testing.assert_allclose(np.diag(covariance), 1.0, atol=0.08)
    np.testing.assert_allclose(covariance[0, 1:], np.exp([-0.5, -2.0]), atol=0.06)


def test_a_random_field_is_as_smooth_as_its_length_scale():
    """The slope of a Gaussian process with squared-exponential covariance has the standard deviation size / ℓ."""
    slopes = []
    for draw in range(60):
        current = RandomCurrent(size=10.0, length_scale=0.2, low=(0, 0), high=(1000, 1000), draw=draw)
        here, there = (current.values(np.array([[x_mm], [500.0]])) for x_mm in (500.0, 501.0))
        slopes += list((there - here)[:, 0])
    assert np.std(slopes) == pytest.approx(10.0 / 200.0, rel=0.25)


def test_a_random_field_of_the_previous_command_changes_what_comes_after_it(robots):
    robot = robots["mgr"]
    field = RandomStrength(
        size=0.3, length_scale=0.3, low=(-120, -120), high=(120, 120), draw=3, over="previous_command", actuators=2
    )
    drive = np.tile([[90.0, 30.0], [60.0, 60.0], [-90.0, 20.0], [60.0, 60.0]], (5, 1))
    session = StandInSession(robot, ("1",), 60, 4, 5, drive=drive)
    own = np.moveaxis(drive_session(replace(session, effects=(field,))).state[:3], 0, -1)
    plain = np.moveaxis(drive_session(session).state[:3], 0, -1)
    moved = [displacement_between(pose[:, :-1], pose[:, 1:])[:, [1, 3], 0, 0].mean(axis=0) for pose in (own, plain)]
    said = 1.0 + field.values(drive[[0, 2]].T).mean(axis=0)
    assert abs(said[0] - said[1]) > 0.05
    assert moved[0] / moved[1] == pytest.approx(said, abs=0.05)


def test_an_egg_shaped_wheel_goes_as_far_as_a_round_one_over_whole_turns():
    egg = OutOfRoundWheel(eccentricity=0.4, radius_mm=16.0)
    memory, ways = egg.initial_memory(np.full((3, 1, 1), 0.7)), []
    start = float(memory[0, 0, 0])
    travel = np.full((2, 1, 1), 2 * math.pi * 16.0 / 500)
    for _ in range(500):
        factor, memory = egg.roll(Stroke(travel, travel, travel, 0.02), memory)
        ways.append((travel * factor)[:, 0, 0])
    ways = np.array(ways)
    assert ways.sum(axis=0) == pytest.approx(2 * math.pi * 16.0, rel=1e-6)
    np.testing.assert_allclose(ways[:, 0] / ways[:, 1], 1 + 0.4 * np.cos(start + np.arange(500) * 2 * math.pi / 500))
    assert memory[0, 0, 0] == pytest.approx(start, abs=1e-6)


def test_a_wheel_slips_after_it_was_sped_up_and_grips_again():
    slips = SlippingWheel(loss=0.5, at_mm_s2=900.0, grips_after_s=0.25)
    still, quick = np.zeros((2, 1, 1)), np.full((2, 1, 1), 18.0)
    first, memory = slips.roll(Stroke(quick, still, quick, 0.02), still[:1])
    later, _ = slips.roll(Stroke(quick, quick, quick, 0.25), memory)
    np.testing.assert_allclose(first[:, 0, 0], [0.5, 1.0])
    np.testing.assert_allclose(later[:, 0, 0], [1 - 0.5 * math.exp(-1), 1.0])


def test_a_sticky_motor_needs_more_to_start_than_to_go_on():
    sticky = StickyMotors(breakaway_mm_s=30.0)
    speed = np.array([0.0, 20.0, -20.0, 0.0]).reshape(4, 1, 1)
    asked = np.array([20.0, 20.0, 20.0, 40.0]).reshape(4, 1, 1)
    np.testing.assert_array_equal(sticky.aimed_speed(asked, speed)[:, 0, 0], [0.0, 20.0, 0.0, 40.0])


def test_a_supply_is_shared_and_commands_leak(robots):
    command = np.array([[120.0, 60.0], [60.0, 0.0]]).T.reshape(2, 2, 1)
    shared = SharedSupply(loss=0.2).transform_command(command, robots["mgr"])
    np.testing.assert_allclose(shared[:, :, 0].T, [[120 * 0.9, 60 * 0.8], [60.0, 0.0]])
    leaking = CrossCoupling(share=0.1).transform_command(command, robots["mgr"])
    np.testing.assert_allclose(leaking[:, :, 0].T, [[126.0, 60.0], [60.0, 0.0]])
    fin = np.array([10.0, 40.0, 9.0]).reshape(3, 1, 1)
    np.testing.assert_allclose(SharedSupply(loss=0.2).transform_command(fin, robots["mur"])[:, 0, 0], [10, 32, 9])
    np.testing.assert_allclose(CrossCoupling(share=0.1).transform_command(fin, robots["mur"])[:, 0, 0], [17.9, 40, 9])


def test_a_cable_pulls_only_when_it_is_taut_and_the_more_the_farther():
    cable = DraggingCable(rate_s=0.1, x_mm=500.0, y_mm=1000.0, slack_mm=300.0)
    x_mm_s, y_mm_s = cable.drift_velocity_mm_s(placed(x_mm=[500.0, 500.0, 0.0], y_mm=[800.0, 500.0, 1000.0]))
    np.testing.assert_allclose(x_mm_s[0], [0.0, 0.0, 20.0], atol=1e-3)
    np.testing.assert_allclose(y_mm_s[0], [0.0, 20.0, 0.0], atol=1e-3)


def test_friction_falls_as_the_motors_warm_up():
    strength = Temperature(loss=0.5, warm_after=0.2).strength(placed(progress=[0.0, 0.2, 1.0]))
    np.testing.assert_allclose(strength[0], [0.5, 1 - 0.5 / math.e, 1 - 0.5 * math.exp(-5)])


def test_a_loose_camera_sways_and_comes_back():
    camera = LooseCamera(sway_mm=10.0, sway_rad=0.02, direction_rad=0.0, period_s=8.0, session_s=80.0)
    pose = np.array([[300.0, 400.0, 0.5]] * 3)
    seen = camera.picture(pose, np.array([0.0, 0.025, 0.05]))
    np.testing.assert_allclose(seen[[0, 2]], pose[[0, 2]], atol=1e-9)
    x_mm, y_mm = 300 * math.cos(0.02) - 400 * math.sin(0.02), 300 * math.sin(0.02) + 400 * math.cos(0.02)
    np.testing.assert_allclose(seen[1], [x_mm + 10.0, y_mm, 0.52])


def test_a_tilted_camera_keeps_lines_straight():
    camera = TiltedCamera(tilt=0.3, direction_rad=0.4, after=0.5, x_mm=500, y_mm=500, side_mm=1000)
    line = np.stack([np.linspace(200, 800, 7), np.linspace(300, 600, 7), np.zeros(7)], axis=1)
    before, after = camera.picture(line, 0.4)[:, :2], camera.picture(line, 0.6)[:, :2]
    np.testing.assert_array_equal(before, line[:, :2])
    bent = after - after.mean(axis=0)
    assert np.linalg.svd(bent, compute_uv=False)[1] < 1e-9
    assert np.linalg.norm(after - before, axis=1).max() > 10


def test_a_drifting_clock_shows_other_times_than_pass(robots):
    session = StandInSession(robots["mgr"], ("1",), 30, 20, 4)
    wrong, right = (
        drive_session(replace(session, effects=(DriftingClock(error=0.2, swings=2.0),))),
        drive_session(session),
    )
    np.testing.assert_array_equal(wrong.time_s, right.time_s)
    rate = np.diff(wrong.time_s) / wrong.duration_s
    np.testing.assert_allclose(rate, 1 + 0.2 * np.sin(4 * np.pi * session.progress(wrong.time_s[:, :-1])))
    pose = [np.moveaxis(driven.state[:3], 0, -1) for driven in (wrong, right)]
    first = [np.abs(displacement_between(one[:, 0], one[:, 1])[:, 0, 0]) for one in pose]
    slow = rate[:, 0] > 1.1
    assert slow.any()
    assert (first[0][slow] < first[1][slow])[first[1][slow] > 5].all()


def test_a_marker_that_comes_off_is_on_average_where_it_was():
    marker = ComingOffMarker(slide_mm=6.0, places=4, draw=3)
    offsets = marker.offsets_mm()
    np.testing.assert_allclose(offsets.mean(axis=0), 0, atol=1e-12)
    assert np.sqrt((offsets**2).sum(axis=1).mean()) == pytest.approx(6.0)
    pose = np.array([[100.0, 200.0, math.pi / 2]] * 2)
    seen = marker.picture(pose, np.array([0.1, 0.9]))
    np.testing.assert_allclose(seen[:, 0], 100.0 - offsets[[0, 3], 1])
    np.testing.assert_allclose(seen[:, 1], 200.0 + offsets[[0, 3], 0])


def test_poses_jump_in_a_strip_and_nowhere_else():
    strip = ShiftedStrip(shift_mm=5.0, direction_rad=math.pi / 2, x_mm=500.0, width_mm=100.0)
    seen = strip.picture(np.array([[440.0, 0, 0], [460.0, 0, 0], [560.0, 0, 0]]), 0.0)
    np.testing.assert_allclose(seen[:, 1], [0.0, 5.0, 0.0], atol=1e-12)


def test_warming_up_begins_anew_with_each_run():
    warm = WarmUp(loss=0.4, warm_after_s=5.0, run_s=25.0, session_s=250.0)
    strength = warm.strength(placed(progress=[0.0, 0.099, 0.1]))  # the start, 24.75 s later, and the next run's start
    np.testing.assert_allclose(strength[0], [0.6, 1.0, 0.6], atol=5e-3)


def test_swapped_commands_are_as_many_as_said_and_the_same_each_time(robots):
    command = np.random.default_rng(1).uniform(-120, 120, (2, 20_000)).round(1)
    swapped = SwappedWheels(probability=0.05).transform_command(command, robots["mgr"])
    changed = (swapped != command).any(axis=0)
    assert changed.mean() == pytest.approx(0.05, abs=0.01)
    assert np.array_equal(swapped[:, changed], command[::-1, changed])


def test_what_effects_remember_is_kept_apart(robots):
    """Two egg-shaped wheels and one that slips: each remembers its own, in the order in which they are given."""

    class Counting(Effect):
        memory = 1

        def roll(self, stroke, memory):
            return 1.0, memory + 1.0

    effects = (Counting(), OutOfRoundWheel(eccentricity=0.1, radius_mm=1e9), Counting())
    conditions = ActiveEffects(robots["mgr"], effects)
    memory = conditions.initial_memory(np.zeros((3, 1, 1)))
    stroke = Stroke(*(np.ones((2, 1, 1)),) * 3, 0.02)
    for _ in range(3):
        _, memory = conditions.roll(stroke, memory)
    np.testing.assert_allclose(memory[:, 0, 0], [3.0, 0.0, 3.0], atol=1e-6)
