"""What each mechanism does to the motion is what its sentence says, worked out by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from exact_model import ExactDynamics, conditions_of, moved, simulation_with, situation_of
from swarmtwin.geometry import compose, exp_map, log_map, rotate
from swarmtwin.simulation.efforts import wheel_travel
from swarmtwin.simulation.mechanism import in_signal_order, mechanism_class, mechanism_names, true_poses

ROBOTS = ("mgr", "mur", "create")
LENS_MM = 1e-6


def test_a_delay_of_a_whole_period_is_the_motion_of_the_command_before(robots):
    robot = robots["mgr"]
    situation = situation_of(robot, np.random.default_rng(2))
    base = ExactDynamics(robot)
    late = moved(robot, "command_delay", situation, delay_s=robot.period_s)[0]
    before = exp_map(base.twist(situation.previous_command))
    torch.testing.assert_close(late, before)
    half = moved(robot, "command_delay", situation, delay_s=robot.period_s / 2)[0]
    halves = [exp_map(base.twist(command) / 2) for command in (situation.previous_command, situation.command)]
    torch.testing.assert_close(half, compose(*halves))


def after_holding(robot):
    """Situations in which both wheels are sent a command of −100 to 100 after they have long held 60."""
    sent = torch.linspace(-100, 100, 9)[:, None].expand(9, 2)
    held = torch.full((9, 2), 60.0)
    changes = {"command": sent, "previous_command": held, "earlier_command": held}
    return situation_of(robot, np.random.default_rng(3), count=9, **changes)


@pytest.mark.parametrize("share", [0.1, 0.3, 0.8])
def test_a_lag_is_the_integral_of_a_decaying_speed(robots, share):
    robot = robots["mgr"]
    situation = after_holding(robot)
    lagging, simulated = moved(robot, "actuator_lag", situation, time_constant_s=share * robot.period_s)
    base = ExactDynamics(robot)
    old = base.twist(situation.previous_command)
    fine = (np.arange(20_000) + 0.5) / 20_000
    left = float(np.exp(-fine / share).mean())
    torch.testing.assert_close(lagging, simulated + left * (old - simulated), rtol=0, atol=0.05)


@pytest.mark.parametrize("share", [0.1, 0.3, 0.8])
def test_wheels_that_speed_up_evenly_come_to_full_speed_in_twice_the_time_constant(robots, share):
    """A change that ends within the period loses its square over twice the acceleration."""
    robot = robots["mgr"]
    situation = after_holding(robot)
    lag = {"time_constant_s": share * robot.period_s, "follows": "evenly"}
    lagging, simulated = (one[:, 0] for one in moved(robot, "actuator_lag", situation, **lag))
    old = ExactDynamics(robot).twist(situation.previous_command)[:, 0]
    acceleration = robot.largest_displacement.forward_mm / (2 * share)  # mm a period, in a period
    fine = (torch.arange(20_000) + 0.5) / 20_000
    change = simulated - old
    speed = old[:, None] + change.sign()[:, None] * torch.minimum(change.abs()[:, None], acceleration * fine)
    torch.testing.assert_close(lagging, speed.mean(dim=1).to(lagging), rtol=0, atol=0.01)
    in_time = change.abs() < acceleration
    lost = change.sign() * change**2 / (2 * acceleration)
    torch.testing.assert_close((simulated - lagging)[in_time], lost[in_time])


def test_wheels_that_did_not_reach_their_speed_in_a_period_go_on_to_it_in_the_next(robots):
    robot = robots["mgr"]
    held, sent = torch.zeros(1, 2), torch.full((1, 2), 100.0)
    lag = {"time_constant_s": 2.0 * robot.period_s, "follows": "evenly"}
    ways = [
        moved(
            robot,
            "actuator_lag",
            situation_of(
                robot, np.random.default_rng(3), count=1, command=sent, previous_command=one, earlier_command=held
            ),
            **lag,
        )[0][0, 0]
        for one in (held, sent)
    ]
    assert ways[1] == pytest.approx(3 * float(ways[0]), rel=0.01)


def test_a_wheel_whose_gear_rubs_loses_less_way_to_a_lag_where_it_stops_or_turns_back(robots):
    robot = robots["mgr"]
    faster, stops, turns_back = ([speed, speed] for speed in (100.0, 0.0, -100.0))
    changes = {"command": torch.tensor([faster, stops, turns_back])}
    changes |= dict.fromkeys(("previous_command", "earlier_command"), torch.full((3, 2), 60.0))
    situation = situation_of(robot, np.random.default_rng(3), count=3, **changes)
    lag = {"time_constant_s": 0.1 * robot.period_s}
    full_mm = float(ExactDynamics(robot).twist(situation.previous_command)[0, 0])
    friction_mm = 0.1 * full_mm
    plain, simulated = moved(robot, "actuator_lag", situation, **lag)
    shown = conditions_of(robot, gear_friction_mm_s=friction_mm / robot.period_s)
    rubbing = simulation_with(robot, conditions=shown, actuator_lag=lag).predict(situation)
    goes_on, stopped, turned_back = ((rubbing - simulated)[:, 0] / (plain - simulated)[:, 0]).tolist()
    assert goes_on == pytest.approx(1.0)
    assert stopped == pytest.approx(1 - friction_mm / full_mm * math.log1p(full_mm / friction_mm), abs=2e-3)
    assert stopped < turned_back < 1


def test_lag_of_nothing_is_nothing_and_grows_from_there(robots):
    for robot in (robots["mgr"], robots["mur"]):
        situation = situation_of(robot, np.random.default_rng(4))
        sizes = []
        for time_constant_s in (1e-1, 1e-2, 1e-3):
            lagging, simulated = moved(robot, "actuator_lag", situation, time_constant_s=time_constant_s)
            sizes.append(float((lagging - simulated).norm()))
        assert sizes[1] / sizes[0] == pytest.approx(0.1, abs=0.03)
        assert sizes[2] / sizes[1] == pytest.approx(0.1, abs=0.03)


class RecoilingDynamics(ExactDynamics):
    """The vehicle turns against a fin that is thrown from one mean angle to another."""

    inputs = ("command", "previous_command")

    def recoil(self, situation):
        thrown_rad = torch.deg2rad(situation.command[:, 0] - situation.previous_command[:, 0])
        return torch.stack([0 * thrown_rad, 0 * thrown_rad, -0.1 * thrown_rad], dim=-1)

    def predict(self, situation):
        return exp_map(self.twist(situation.command.double()) + self.recoil(situation))


@pytest.mark.parametrize("own_s", [0.02, 0.1, 0.4])
def test_a_fin_that_follows_more_slowly_throws_the_vehicle_less(robots, own_s):
    robot = robots["mur"]
    base = RecoilingDynamics(robot)
    situation = situation_of(robot, np.random.default_rng(4))
    situation = replace(situation, earlier_command=situation.previous_command)  # what it recoiled from is over
    lag = {"time_constant_s": 0.1}
    plain, slower = (
        simulation_with(robot, dynamics=base, actuator_lag={**lag, **own}).predict(situation)
        for own in ({}, {"own_time_constant_s": own_s})
    )
    lost = 0.1 / (0.1 + own_s)
    torch.testing.assert_close(slower[:, 2] - plain[:, 2], -lost * base.recoil(situation)[:, 2], rtol=0, atol=1e-9)


@pytest.mark.parametrize("goes_on", [0.0, 0.25, 1.0])
def test_a_hull_recoils_by_a_share_of_its_own_and_in_part_later(robots, goes_on):
    robot = robots["mur"]
    base = RecoilingDynamics(robot)
    situation = situation_of(robot, np.random.default_rng(4))
    lag = {"time_constant_s": 0.1, "own_time_constant_s": 0.05}
    plain, slower = (
        simulation_with(robot, dynamics=base, actuator_lag={**lag, **own}).predict(situation)
        for own in ({"own_turn_time_constant_s": 1e12}, {"own_turn_time_constant_s": 0.3, "goes_on": goes_on})
    )
    lost, before = 0.1 / (0.1 + 0.3), replace(situation, command=situation.previous_command)
    before = replace(before, previous_command=situation.earlier_command)
    recoiled = lost * (goes_on * base.recoil(before) - base.recoil(situation))
    torch.testing.assert_close(slower[:, 2] - plain[:, 2], recoiled[:, 2], rtol=0, atol=1e-9)


@pytest.mark.parametrize(("late", "lag"), [(0.25, 0.2), (0.5, 0.4), (1.0, 0.3)])
def test_what_a_late_command_brings_about_goes_on_in_the_next_period(robots, late, lag):
    """A recoil that dies away exponentially: what is over by the period's end, and the rest of that before."""
    robot = robots["mur"]
    base = RecoilingDynamics(robot)
    situation = situation_of(robot, np.random.default_rng(4))
    delay = {"delay_s": late * robot.period_s, "transient_time_constant_s": lag * robot.period_s}
    delayed, smooth = (
        simulation_with(robot, dynamics=dynamics, command_delay=delay).predict(situation)
        for dynamics in (base, ExactDynamics(robot))
    )
    over = math.expm1((late - 1) / lag) / math.expm1(-1 / lag)
    before = replace(situation, command=situation.previous_command, previous_command=situation.earlier_command)
    expected = over * base.recoil(situation)[:, 2] + (1 - over) * base.recoil(before)[:, 2]
    torch.testing.assert_close(delayed[:, 2] - smooth[:, 2], expected, rtol=0, atol=1e-9)


def test_drift_is_the_same_in_the_arena_whatever_the_heading(robots):
    for robot in (robots["mgr"], robots["mur"]):
        rng = np.random.default_rng(5)
        situation = situation_of(robot, rng, duration_s=rng.uniform(0.3, 0.9, 200))
        drifting, simulated = moved(robot, "steady_drift", situation, x_mm_s=7.0, y_mm_s=-3.0)
        apart = compose(situation.pose, drifting) - compose(situation.pose, simulated)
        expected = situation.duration_s[:, None] * torch.tensor([[7.0, -3.0, 0.0]], dtype=torch.float64)
        torch.testing.assert_close(apart, expected, rtol=0, atol=1e-9)
    told = mechanism_class("steady_drift").at({"x_mm_s": 3.0, "y_mm_s": 4.0}).reported()
    assert told == pytest.approx({"speed_mm_s": 5.0, "direction_rad": math.atan2(4, 3)})


def test_on_a_slope_wheels_roll_down_as_far_as_they_point_there(robots):
    robot = robots["mgr"]
    situation = situation_of(robot, np.random.default_rng(6))
    rolling, simulated = moved(robot, "steady_drift", situation, x_mm_s=7.0, y_mm_s=-3.0, carries="wheels")
    apart = compose(situation.pose, rolling) - compose(situation.pose, simulated)
    heading = situation.pose[:, 2] + log_map(simulated)[:, 2] / 2
    ahead_mm = (7.0 * heading.cos() - 3.0 * heading.sin()) * situation.duration_s
    expected = torch.stack([ahead_mm * heading.cos(), ahead_mm * heading.sin(), torch.zeros_like(ahead_mm)], dim=-1)
    torch.testing.assert_close(apart, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("camera_scale", {"scale": 1.23}),
        ("camera_scale", {"scale": 0.7}),
        ("lens_distortion", {"coefficient": 0.1}),
        ("lens_distortion", {"coefficient": -0.08}),
        ("lens_distortion", {"coefficient": 0.4}),
        ("lens_distortion", {"coefficient": -0.25}),
        ("marker_offset", {"forward_mm": 12.0, "left_mm": -30.0}),
        ("marker_yaw", {"angle_rad": 0.4}),
    ],
)
@pytest.mark.parametrize("robot", ROBOTS)
def test_a_camera_is_undone_exactly(robots, robot, name, values):
    situation = situation_of(robots[robot], np.random.default_rng(6))
    camera, conditions = mechanism_class(name).at(values), conditions_of(robots[robot])
    measured = camera.to_measured(situation.pose, conditions)
    assert (measured - situation.pose).abs().max() > 0.1
    back = camera.from_measured(measured, conditions)
    torch.testing.assert_close(back, situation.pose, rtol=0, atol=LENS_MM if name == "lens_distortion" else 1e-9)


def test_wrong_millimetres_per_pixel_are_those_of_what_the_lens_has_bent(robots):
    """Whatever order they are named in: measured = scale · r · (1 + coefficient · r²), r that of the true position."""
    conditions, pose = conditions_of(robots["mgr"]), situation_of(robots["mgr"], np.random.default_rng(6)).pose
    lens, scale = (
        mechanism_class("lens_distortion").at({"coefficient": 0.3}),
        mechanism_class("camera_scale").at({"scale": 0.8}),
    )
    away = pose[:, :2] - conditions.centre_mm
    expected = 0.8 * away * (1 + 0.3 * (away / conditions.corner_mm).square().sum(dim=-1, keepdim=True))
    for chosen in ((lens, scale), (scale, lens)):
        ordered = in_signal_order(chosen)
        measured = pose
        for mechanism in ordered:
            measured = mechanism.to_measured(measured, conditions)
        torch.testing.assert_close(measured[:, :2] - conditions.centre_mm, expected, rtol=0, atol=1e-9)
        torch.testing.assert_close(true_poses(ordered, measured, conditions), pose, rtol=0, atol=LENS_MM)


def test_where_no_position_is_measured_the_nearest_that_is_was(robots):
    robot = robots["mgr"]
    lens, conditions = mechanism_class("lens_distortion").at({"coefficient": -0.3}), conditions_of(robot)
    corner = torch.tensor([[*robot.arena_mm.high_mm, 0.3]], dtype=torch.float64)  # measured at 0.70 of the way at most
    seen = lens.to_measured(lens.from_measured(corner, conditions), conditions)
    middle = conditions.centre_mm
    share = (seen[:, :2] - middle).norm() / (corner[:, :2] - middle).norm()
    assert float(share) == pytest.approx(2 / 3 / math.sqrt(0.9), rel=1e-6)
    assert float(seen[0, 2]) == 0.3


def test_a_scaled_camera_scales_ways_and_no_turns(robots):
    robot = robots["mgr"]
    measured, simulated = moved(robot, "camera_scale", situation_of(robot, np.random.default_rng(7)), scale=1.3)
    torch.testing.assert_close(measured[:, :2], 1.3 * simulated[:, :2])
    torch.testing.assert_close(measured[:, 2], simulated[:, 2])


def test_a_turned_marker_turns_the_way_and_no_turns(robots):
    robot = robots["mgr"]
    measured, simulated = moved(robot, "marker_yaw", situation_of(robot, np.random.default_rng(8)), angle_rad=0.3)
    turned = rotate(simulated[:, :2], torch.tensor(-0.3, dtype=torch.float64).expand(len(simulated)))
    torch.testing.assert_close(measured[:, :2], turned)
    torch.testing.assert_close(measured[:, 2], simulated[:, 2])


def test_a_marker_off_the_centre_goes_round_it_when_the_vehicle_turns(robots):
    robot = robots["mgr"]
    simulation = simulation_with(robot, marker_offset={"forward_mm": 9.0, "left_mm": -12.0})
    situation = situation_of(robot, np.random.default_rng(9), count=20)
    state = simulation.start(situation.pose[:, None])
    spin = torch.tensor([-50.0, 50.0]).expand(20, 1, 2)
    for _ in range(6):
        state = simulation.step(state, spin)
        marker = simulation.observe(state)[:, 0, :2]
        distance_mm = (marker - situation.pose[:, :2]).norm(dim=-1)
        torch.testing.assert_close(distance_mm, torch.full((20,), 15.0, dtype=torch.float64))
    assert float((state.pose[:, 0, 2] - situation.pose[:, 2]).abs().min()) > 1.0


def test_half_the_gain_is_half_the_way_and_thrust_goes_by_its_exponents(robots):
    for name, exponents in (("mgr", (1, 1, 1)), ("create", (1, 1, 1)), ("mur", (1.3, 1.9, 1.6))):
        robot = robots[name]
        situation = situation_of(robot, np.random.default_rng(10))
        weaker = simulation_with(
            robot, conditions=conditions_of(robot, effort_exponents=exponents), gain_change={"gain": 0.5}
        )
        factor = 0.5 ** torch.tensor(exponents, dtype=torch.float64)
        expected = log_map(ExactDynamics(robot).predict(situation)) * factor
        torch.testing.assert_close(log_map(weaker.predict(situation)), expected)


def test_a_unit_may_turn_by_another_factor_than_it_goes(robots):
    for name, exponents in (("mgr", (1, 1, 1)), ("mur", (1.3, 1.9, 1.6))):
        robot = robots[name]
        situation = situation_of(robot, np.random.default_rng(10))
        unit = simulation_with(
            robot,
            conditions=conditions_of(robot, effort_exponents=exponents),
            gain_change={"gain": 0.5, "turning": 1.2},
        )
        ahead, aside = 0.5 ** torch.tensor(exponents[:2], dtype=torch.float64)
        expected = log_map(ExactDynamics(robot).predict(situation)) * torch.stack([ahead, aside, torch.tensor(1.2)])
        torch.testing.assert_close(log_map(unit.predict(situation)), expected)


@pytest.mark.parametrize(("side", "left", "right"), [("both", 1.2, 1 / 1.2), ("left", 1.44, 1.0), ("right", 1.0, 1.44)])
def test_one_wheel_runs_faster_or_both_with_their_geometric_mean_kept(robots, side, left, right):
    robot = robots["mgr"]
    situation = situation_of(robot, np.random.default_rng(11))
    measured, simulated = moved(robot, "actuator_asymmetry", situation, ratio=1.44, side=side)
    track_mm = conditions_of(robot).track_mm
    factors = wheel_travel(log_map(measured), track_mm) / wheel_travel(log_map(simulated), track_mm)
    torch.testing.assert_close(factors, torch.tensor([[left, right]], dtype=torch.float64).expand(200, 2))


def test_a_trimmed_fin_is_another_angle(robots):
    robot = robots["mur"]
    situation = situation_of(robot, np.random.default_rng(12))
    measured, _ = moved(robot, "actuator_asymmetry", situation, angle_rad=math.radians(5))
    command = situation.command + torch.tensor([[5.0, 0.0, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(measured, exp_map(ExactDynamics(robot).twist(command)))


def test_small_commands_do_nothing_and_large_ones_are_cut(robots):
    robot = robots["mgr"]
    situation = situation_of(robot, np.random.default_rng(13))
    base = ExactDynamics(robot)
    dead, cut = situation.command.clone(), situation.command.clamp(-70, 70)
    dead[dead.abs() < 30] = 0.0
    for name, values, command in (("dead_band", {"width": 30.0}, dead), ("saturation", {"limit": 70.0}, cut)):
        measured, _ = moved(robot, name, situation, **values)
        torch.testing.assert_close(measured, exp_map(base.twist(command)))


@pytest.mark.parametrize("robot", ["mgr", "mur"])
def test_friction_takes_its_part_of_every_command(robots, robot):
    robot = robots[robot]
    situation = situation_of(robot, np.random.default_rng(13))
    less = situation.command.clone()
    columns = [robot.command_columns.index(name) for name in robot.actuation.effort]
    less[:, columns] = less[:, columns].sign() * (less[:, columns].abs() - 15.0).clamp(min=0.0)
    measured, _ = moved(robot, "dead_band", situation, width=15.0, larger="less")
    torch.testing.assert_close(measured, exp_map(ExactDynamics(robot).twist(less)))


@pytest.mark.parametrize("share", [0.3, 0.8, 0.99])
def test_a_gradual_limit_leaves_small_commands_and_gives_the_largest_what_it_says(robots, share):
    robot = robots["mgr"]
    high = float(robot.command_high[0])
    sent = torch.tensor([[1e-3, -high], [high, high / 2]], dtype=torch.float64)
    situation = situation_of(robot, np.random.default_rng(13), count=2, command=sent)
    limit = {"limit": share * high, "sets_in": "gradually"}
    bend = next(x for x in np.linspace(1e-3, 10, 100_000) if np.tanh(x) / x <= share) / high
    measured, _ = moved(robot, "saturation", situation, **limit)
    torch.testing.assert_close(
        measured, exp_map(ExactDynamics(robot).twist(torch.tanh(bend * sent) / bend)), rtol=0, atol=0.02
    )
    unchanged, simulated = moved(robot, "saturation", situation, **{**limit, "limit": high})
    torch.testing.assert_close(unchanged, simulated)


def test_saturation_of_a_unicycle_is_that_of_its_wheels(robots):
    robot = robots["create"]
    situation = situation_of(robot, np.random.default_rng(14))
    half_mm = robot.actuation.track_mm / 2
    wheels = [situation.command[:, 0] + sign * half_mm * situation.command[:, 1] for sign in (-1, 1)]
    left, right = (wheel.clamp(-60, 60) for wheel in wheels)
    expected = torch.stack([(left + right) / 2, 0 * left, (right - left) / (2 * half_mm)], dim=-1) * robot.period_s
    torch.testing.assert_close(log_map(moved(robot, "saturation", situation, limit=60.0)[0]), expected)


def test_play_is_lost_at_a_reversal_and_only_there(robots):
    robot = robots["mgr"]
    signs = torch.tensor([[1, 1, 1], [1, 1, -1], [-1, -1, 1], [-1, -1, -1], [-1, 1, 1]], dtype=torch.float64)
    earlier, previous, command = (80 * signs[:, [column, column]] for column in range(3))
    changes = {"command": command, "previous_command": previous, "earlier_command": earlier}
    situation = situation_of(robot, np.random.default_rng(15), count=5, **changes)
    measured, simulated = moved(robot, "backlash", situation, travel_mm=4.0)
    lost = (simulated - measured)[:, 0].tolist()
    assert lost == pytest.approx([0, -4, 4, 0, 0])


@pytest.mark.parametrize(("travel_mm", "rolls_on_mm"), [(4.0, 8 * (28 / 50) ** 2), (2.0, 2.0)])
def test_a_wheel_whose_motor_stops_rolls_on_into_the_play(robots, travel_mm, rolls_on_mm):
    """From 28 mm a period, where it rolls on 8 mm from the largest speed of 50; what it rolls on is not lost later."""
    robot = robots["mgr"]
    pwm = torch.tensor([[80, 80, 0], [80, 0, -80], [80, 0, 80], [80, 80, 80]], dtype=torch.float64)
    earlier, previous, command = (pwm[:, [column, column]] for column in range(3))
    changes = {"command": command, "previous_command": previous, "earlier_command": earlier}
    situation = situation_of(robot, np.random.default_rng(15), count=4, **changes)
    measured, simulated = moved(robot, "backlash", situation, travel_mm=travel_mm, coasting_mm=8.0)
    moved_on = (measured - simulated)[:, 0].tolist()
    assert moved_on == pytest.approx([rolls_on_mm, travel_mm - rolls_on_mm, -rolls_on_mm, 0.0], abs=0.02)


def test_a_battery_loses_nothing_at_first_and_its_loss_in_the_end(robots):
    robot = robots["mgr"]
    elapsed_s = torch.tensor([0.0, 250.0, 1000.0])
    situation = situation_of(robot, np.random.default_rng(16), count=3, elapsed_s=elapsed_s)
    measured, simulated = moved(robot, "battery_sag", situation, loss=0.4, shape=2.0)
    factor = torch.tensor([[1.0], [1 - 0.4 / 16], [0.6]], dtype=torch.float64)
    torch.testing.assert_close(log_map(measured), log_map(simulated) * factor)


def _along_the_lower_wall(robot, away_mm):
    pose = torch.tensor([[500.0, robot.arena_mm.y[0] + away, 0.0] for away in away_mm])
    command = torch.full((len(away_mm), 2), 60.0)
    return situation_of(robot, np.random.default_rng(17), count=len(away_mm), pose=pose, command=command)


def test_a_wall_takes_its_loss_at_it_and_an_eth_of_that_at_its_reach(robots):
    robot = robots["mgr"]
    measured, simulated = moved(
        robot, "wall_effect", _along_the_lower_wall(robot, [0.0, 30.0, 400.0]), loss=0.5, reach_mm=30.0
    )
    lost = (1 - measured[:, 0] / simulated[:, 0]).tolist()
    assert lost == pytest.approx([0.5, 0.5 / math.e, 0.5 * math.exp(-400 / 30)])


def test_a_patch_takes_its_loss_inside_and_nothing_outside(robots):
    robot = robots["mgr"]
    disc = {"x_mm": 510.0, "y_mm": 200.0, "radius_mm": 100.0, "loss": 0.3}
    measured, simulated = moved(robot, "surface_patch", _along_the_lower_wall(robot, [200.0, 400.0]), **disc)
    assert (measured[:, 0] / simulated[:, 0]).tolist() == pytest.approx([0.7, 1.0])


@pytest.mark.parametrize("heading_rad", [0.0, np.pi])
def test_vehicles_that_leave_or_enter_a_patch_come_as_far_on_average_as_with_a_sharp_edge(robots, heading_rad):
    """Of starts all over the edge as many are helped as hindered by its being soft; vehicles on it are slow."""
    robot, edge_mm, loss = robots["mgr"], 420.0, 0.5
    start_mm = np.linspace(edge_mm - 200.0, edge_mm + 200.0, 801)
    pose = np.column_stack([start_mm, np.full(801, 500.0), np.full(801, heading_rad)])
    situation = situation_of(robot, np.random.default_rng(7), count=801, pose=pose, command=np.full((801, 2), 80.0))
    disc = {"x_mm": edge_mm - 400.0, "y_mm": 500.0, "radius_mm": 400.0, "loss": loss}
    measured, simulated = moved(robot, "surface_patch", situation, **disc)
    whole_mm = simulated[0, 0].item()
    inside_mm = edge_mm - start_mm
    if heading_rad:  # outside first, then slow
        free_mm = np.clip(-inside_mm, 0.0, whole_mm)
        expected_mm = free_mm + (1 - loss) * (whole_mm - free_mm)
    else:
        slow_mm = np.clip(inside_mm, 0.0, (1 - loss) * whole_mm)
        expected_mm = slow_mm + whole_mm - slow_mm / (1 - loss)
    assert measured[:, 0].numpy().mean() == pytest.approx(expected_mm.mean(), abs=0.02)


def test_neighbours_push_each_other_apart_equally(robots):
    robot = robots["mgr"]
    rng = np.random.default_rng(18)
    poses = torch.as_tensor(np.concatenate([rng.uniform(300, 600, (2, 50, 2)), rng.uniform(-3, 3, (2, 50, 1))], axis=2))
    ends = []
    for own, other in ((0, 1), (1, 0)):
        away = rotate(poses[other, :, :2] - poses[own, :, :2], -poses[own, :, 2])
        neighbours = torch.cat([away, torch.zeros(50, 1)], dim=-1)[:, None]
        unknown = torch.full_like(neighbours, torch.nan)
        changes = {"command": torch.zeros(50, 2), "neighbours": torch.cat([neighbours, unknown], dim=1)}
        situation = situation_of(robot, rng, count=50, pose=poses[own], **changes)
        measured, _ = moved(robot, "neighbour_interaction", situation, strength_mm_s=20.0, reach_mm=80.0)
        ends.append((compose(poses[own], measured) - poses[own])[:, :2])
    torch.testing.assert_close(ends[0], -ends[1])
    apart = poses[0, :, :2] - poses[1, :, :2]
    distance_mm = apart.norm(dim=-1, keepdim=True)
    pushed_mm, steps = torch.zeros_like(distance_mm), 1000
    for _ in range(steps):
        pushed_mm = pushed_mm + 20.0 * robot.period_s / steps * torch.exp(-(distance_mm + 2 * pushed_mm) / 80)
    expected = pushed_mm * apart / distance_mm
    torch.testing.assert_close(ends[0], expected, rtol=1e-3, atol=1e-2)


def test_neighbours_push_each_other_where_both_are_meanwhile(robots):
    """Two vehicles face each other, one stands: in the distance between them each loses or gains its way."""
    robot = robots["mgr"]
    simulation = simulation_with(robot, neighbour_interaction={"strength_mm_s": 40.0, "reach_mm": 60.0})
    pose = torch.tensor([[[400.0, 500.0, 0.0], [480.0, 500.0, math.pi]]], dtype=torch.float64)
    command = torch.tensor([[[90.0, 90.0], [0.0, 0.0]]], dtype=torch.float64)
    after = simulation.step(simulation.start(pose), command)
    speed_mm_s = float(ExactDynamics(robot).twist(command[0, 0])[0]) / robot.period_s
    apart_mm, pushed_mm, steps = 80.0, 0.0, 10_000
    for _ in range(steps):
        push_mm = 40.0 * math.exp(-apart_mm / 60.0) * robot.period_s / steps
        pushed_mm += push_mm
        apart_mm += 2 * push_mm - speed_mm_s * robot.period_s / steps
    expected = [400.0 + speed_mm_s * robot.period_s - pushed_mm, 480.0 + pushed_mm]
    assert after.pose[0, :, 0].tolist() == pytest.approx(expected, abs=0.1)


@pytest.mark.parametrize("apart_mm", [4.0, 40.0])
def test_vehicles_that_attract_each_other_meet_and_do_not_change_places(robots, apart_mm):
    robot = robots["mgr"]
    neighbours = torch.tensor([[[apart_mm, 0.0, 0.0]]])
    situation = situation_of(robot, np.random.default_rng(4), count=1, command=np.zeros((1, 2)), neighbours=neighbours)
    measured, _ = moved(robot, "neighbour_interaction", situation, strength_mm_s=-30.0, reach_mm=250.0)
    come_mm, steps = 0.0, 1000
    for _ in range(steps):
        apart_by_then_mm = apart_mm - 2 * come_mm
        come_mm += min(30.0 * robot.period_s / steps * math.exp(-apart_by_then_mm / 250.0), apart_by_then_mm / 2)
    assert measured[0, 0].item() == pytest.approx(come_mm, rel=2e-3)
    assert come_mm <= apart_mm / 2


@pytest.mark.parametrize(("heading_rad", "clearance_mm"), [(0.0, 80.0), (math.pi / 2, 50.0), (math.pi, 80.0)])
def test_a_current_carries_no_vehicle_through_a_wall(robots, heading_rad, clearance_mm):
    robot = robots["mur"]
    high_mm = robot.arena_mm.high_mm
    apart_mm = np.array([200.0, 60.0 + clearance_mm, clearance_mm - 10.0])
    pose = np.column_stack([high_mm[0] - apart_mm, np.full(3, high_mm[1] / 2), np.full(3, heading_rad)])
    situation = situation_of(
        robot, np.random.default_rng(5), count=3, pose=pose, command=np.tile([0.0, 0.0, 5.0], (3, 1))
    )
    conditions = conditions_of(robot, clearance_mm=(80.0, 50.0))
    drift = {"x_mm_s": 100.0, "y_mm_s": 0.0}
    simulation = simulation_with(robot, None, conditions, steady_drift=drift)
    end = compose(situation.pose, simulation.predict(situation))
    carried_mm = (end - situation.pose)[:, 0].tolist()
    assert carried_mm == pytest.approx([100.0 * robot.period_s, 60.0, 0.0], abs=1e-6)


class WalledDynamics(ExactDynamics):
    """A wall stops vehicles, all of which face it, at a distance of 80 mm: the model looks at the pose."""

    inputs = ("command", "pose")

    def predict(self, situation):
        displacement = super().predict(situation)
        room = self.robot.arena_mm.high_mm[0] - 80.0 - situation.pose[:, 0]
        return torch.cat([torch.minimum(displacement[:, :1], room[:, None]), displacement[:, 1:]], dim=-1)


@pytest.mark.parametrize("speed_mm_s", [-25.0, -150.0, 100.0])
def test_what_presses_against_a_wall_presses_against_a_current_that_carries_it_off(robots, speed_mm_s):
    """70 mm ahead if nothing stopped it: the current must be faster than that before it leaves the wall."""
    robot = robots["mur"]
    wall_mm = robot.arena_mm.high_mm[0] - 80.0
    start_mm = wall_mm - np.array([0.0, 30.0, 600.0])
    pose = np.column_stack([start_mm, np.full(3, 500.0), np.zeros(3)])
    command = np.tile([0.0, 60.0, 9.0], (3, 1))
    situation = situation_of(robot, np.random.default_rng(5), count=3, pose=pose, command=command)
    conditions = conditions_of(robot, clearance_mm=(80.0, 50.0))
    drift = {"x_mm_s": speed_mm_s, "y_mm_s": 0.0}
    moved_mm = simulation_with(robot, WalledDynamics(robot), conditions, steady_drift=drift).predict(situation)[:, 0]
    free_mm = start_mm + 70.0 + speed_mm_s * robot.period_s
    assert (start_mm + moved_mm.numpy()).tolist() == pytest.approx(np.minimum(free_mm, wall_mm).tolist(), abs=1e-6)


def test_each_wheel_is_slowed_where_it_is(robots):
    """The left wheel on the disc, both, and none: straight commands turn the vehicle to the left, not, and not."""
    robot = robots["mgr"]
    disc = {"x_mm": 500.0, "y_mm": 700.0, "radius_mm": 200.0, "loss": 0.4}
    pose = np.column_stack([np.full(3, 480.0), [480.0, 700.0, 200.0], np.zeros(3)])
    situation = situation_of(robot, np.random.default_rng(6), count=3, pose=pose, command=np.full((3, 2), 80.0))
    by_wheel, simulated = moved(robot, "surface_patch", situation, slows="wheels", **disc)
    whole, _ = moved(robot, "surface_patch", situation, **disc)
    torch.testing.assert_close(by_wheel[1:], whole[1:])
    torch.testing.assert_close(by_wheel[2], simulated[2])
    track_mm = robot.actuation.track_mm or 84.0
    twist = log_map(by_wheel)[0]
    left, right = wheel_travel(twist[None], track_mm)[0].tolist()
    straight_mm = simulated[0, 0].item()
    assert left == pytest.approx(0.6 * straight_mm, rel=1e-6)
    assert right == pytest.approx(straight_mm, rel=1e-6)


def test_weaker_thrust_slows_each_part_of_the_motion_by_its_own_power_and_weeds_all_of_it_alike(robots):
    robot, exponents = robots["mur"], (1.0, 1.9, 1.6)
    middle = robot.arena_mm.low_mm + (robot.arena_mm.high_mm - robot.arena_mm.low_mm) / 2
    pose = np.tile([*middle, 0.4], (50, 1))
    situation = situation_of(robot, np.random.default_rng(7), count=50, pose=pose)
    conditions = conditions_of(robot, effort_exponents=exponents)
    plain = log_map(ExactDynamics(robot).predict(situation))
    as_a_whole, by_thrust = mechanism_class("surface_patch").forms(robot)
    for form, powers in ((as_a_whole, (1.0, 1.0, 1.0)), (by_thrust, exponents)):
        disc = form(name="surface_patch", x_mm=middle[0], y_mm=middle[1], radius_mm=400.0, loss=0.4).model_dump()
        slowed = simulation_with(robot, conditions=conditions, surface_patch={**disc}).predict(situation)
        torch.testing.assert_close(log_map(slowed), plain * 0.6 ** torch.tensor(powers, dtype=torch.float64))


@pytest.mark.parametrize("probability", [0.0, 0.2, 0.6])
def test_a_command_arrives_or_the_one_in_force_goes_on(robots, probability):
    robot = robots["mgr"]
    simulation = simulation_with(robot, command_loss={"probability": probability})
    rng = np.random.default_rng(19)
    state = simulation.start(torch.zeros(4000, 1, 3))
    drawn, lost = torch.Generator().manual_seed(1), 0
    for _ in range(3):
        sent = torch.as_tensor(rng.uniform(robot.command_low, robot.command_high)).expand(4000, 1, 2)
        before = state.previous_command.nan_to_num(0.0)
        state = simulation.step(state, sent, rng=drawn)
        goes_on = (state.previous_command == before).all(dim=-1)
        assert torch.equal(torch.where(goes_on[..., None], before, sent), state.previous_command)
        lost += int(goes_on.sum())
    assert lost / 12_000 == pytest.approx(probability, abs=4 * math.sqrt(probability * (1 - probability) / 12_000))
    likely = simulation.step(state, sent).previous_command
    assert torch.equal(likely, sent if probability < 0.5 else state.previous_command)


def test_motion_lasts_as_long_as_the_period(robots):
    for robot in (robots["mgr"], robots["mur"]):
        rng = np.random.default_rng(20)
        periods = rng.uniform(0.5, 1.6, 200)
        situation = situation_of(robot, rng, duration_s=periods * robot.period_s)
        measured, simulated = moved(robot, "timing_jitter", situation)
        torch.testing.assert_close(log_map(measured), log_map(simulated) * torch.as_tensor(periods)[:, None])


@pytest.mark.parametrize(
    ("mean", "spread"), [(1.0, 0.02), (1.0, 0.1), (1.0, 0.25), (1.04, 0.001), (1.04, 0.02), (0.9, 0.2)]
)
def test_how_long_periods_last_is_read_though_those_that_last_too_long_are_not_seen(robots, mean, spread):
    jitter = mechanism_class("timing_jitter")
    for robot in (robots["mgr"], robots["mur"]):
        duration_s = robot.period_s * np.random.default_rng(21).normal(mean, spread, 20_000)
        seen = duration_s[duration_s <= robot.longest_gap_s]
        assert jitter.read_from_clock(seen, robot) == pytest.approx({"spread": spread, "mean": mean}, rel=0.03)
        assert jitter.read_from_clock(np.full(100, robot.period_s), robot) is None


def test_a_period_that_lasts_as_long_as_is_seen_but_for_rounding_is_no_longer_one(robots):
    jitter = mechanism_class("timing_jitter")
    for robot in (robots["mgr"], robots["mur"]):
        lasted_s = robot.period_s * np.random.default_rng(23).normal(1.0, 0.14, (500, 40))
        time_s = np.round(np.cumsum(lasted_s, axis=1), 3)
        duration_s = np.diff(time_s).ravel()
        seen = duration_s[duration_s <= robot.longest_gap_s + 1e-6]
        assert robot.longest_gap_s < seen.max() < robot.longest_gap_s + 1e-6
        assert jitter.read_from_clock(seen, robot) == pytest.approx({"spread": 0.14, "mean": 1.0}, rel=0.03)


@pytest.mark.parametrize("share", [0.3, 0.5, 0.7])
def test_periods_of_two_lengths_are_read_as_periods_that_may_be(robots, share):
    """Most last nearly too long: no normal distribution that was cut off there is likelier than any other."""
    robot = robots["mgr"]
    longest = robot.longest_gap_s / robot.period_s
    lasted = np.where(np.random.default_rng(22).random(1000) < share, 1.0, 0.99 * longest)
    found = mechanism_class("timing_jitter").read_from_clock(lasted * robot.period_s, robot)
    assert 1.0 < found["mean"] <= longest
    assert 0.05 < found["spread"] <= 0.5


def test_only_a_change_of_noise_multiplies_noise(robots):
    for name in mechanism_names():
        kind = mechanism_class(name)
        start = kind.initial_points(robots["mgr"], conditions_of(robots["mgr"]))[0]
        expected = 1.7 if name == "noise_change" else 1.0
        assert kind.at({**start, "factor": 1.7}).noise_factor() == expected
