"""What each mechanism does to the motion is what its sentence says, worked out by hand."""

import math

import numpy as np
import pytest
import torch
from exact import ExactBase, drive_of, moved, surroundings_of

from swarmtwin.dynamics.twist import displacement_of, twist_of
from swarmtwin.gap.catalogue import mechanism_class, mechanism_names
from swarmtwin.gap.mechanism import wheel_ways
from swarmtwin.gap.motion import alternatives, likeliest_displacement
from swarmtwin.geometry import compose, rotate

ROBOTS = ("mgr", "mur", "create")
LENS_MM = 1e-6


def test_a_delay_of_a_whole_period_is_the_motion_of_the_command_before(robots):
    robot = robots["mgr"]
    drive = drive_of(robot, np.random.default_rng(2))
    base = ExactBase(robot)
    late = moved(robot, "command_delay", drive, delay_s=robot.period_s)[0]
    before = displacement_of(base.way(drive.previous_command, drive.previous_command, drive.pose))
    torch.testing.assert_close(late, before)
    half = moved(robot, "command_delay", drive, delay_s=robot.period_s / 2)[0]
    halves = [
        displacement_of(base.way(command, command, drive.pose) / 2)
        for command in (drive.previous_command, drive.command)
    ]
    torch.testing.assert_close(half, compose(*halves))


@pytest.mark.parametrize("share", [0.1, 0.3, 0.8])
def test_a_lag_is_the_integral_of_a_decaying_speed(robots, share):
    robot = robots["mgr"]
    sent = torch.linspace(-100, 100, 9)[:, None].expand(9, 2)
    held = torch.full((9, 2), 60.0)
    changes = {"command": sent, "previous_command": held, "earlier_command": held}
    drive = drive_of(robot, np.random.default_rng(3), count=9, **changes)
    lagging, simulated = moved(robot, "actuator_lag", drive, time_constant_s=share * robot.period_s)
    base = ExactBase(robot)
    old = base.way(drive.previous_command, drive.previous_command, drive.pose)
    fine = (np.arange(20_000) + 0.5) / 20_000
    left = float(np.exp(-fine / share).mean())
    torch.testing.assert_close(lagging, simulated + left * (old - simulated), rtol=0, atol=0.05)


def test_lag_of_nothing_is_nothing_and_grows_from_there(robots):
    for robot in (robots["mgr"], robots["mur"]):
        drive = drive_of(robot, np.random.default_rng(4))
        sizes = []
        for time_constant_s in (1e-1, 1e-2, 1e-3):
            lagging, simulated = moved(robot, "actuator_lag", drive, time_constant_s=time_constant_s)
            sizes.append(float((lagging - simulated).norm()))
        assert sizes[1] / sizes[0] == pytest.approx(0.1, abs=0.03)
        assert sizes[2] / sizes[1] == pytest.approx(0.1, abs=0.03)


def test_drift_is_the_same_in_the_arena_whatever_the_heading(robots):
    for robot in (robots["mgr"], robots["mur"]):
        rng = np.random.default_rng(5)
        drive = drive_of(robot, rng, duration_s=rng.uniform(0.3, 0.9, 200))
        drifting, simulated = moved(robot, "steady_drift", drive, x_mm_s=7.0, y_mm_s=-3.0)
        apart = compose(drive.pose, drifting) - compose(drive.pose, simulated)
        expected = drive.duration_s[:, None] * torch.tensor([[7.0, -3.0, 0.0]], dtype=torch.float64)
        torch.testing.assert_close(apart, expected, rtol=0, atol=1e-9)
    told = mechanism_class("steady_drift").at({"x_mm_s": 3.0, "y_mm_s": 4.0}).reported()
    assert told == pytest.approx({"speed_mm_s": 5.0, "direction_rad": math.atan2(4, 3)})


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
    drive = drive_of(robots[robot], np.random.default_rng(6))
    camera = mechanism_class(name).at(values)
    measured = camera.seen(drive.pose, drive.surroundings)
    assert (measured - drive.pose).abs().max() > 0.1
    back = camera.true(measured, drive.surroundings)
    torch.testing.assert_close(back, drive.pose, rtol=0, atol=LENS_MM if name == "lens_distortion" else 1e-9)


def test_a_scaled_camera_scales_ways_and_no_turns(robots):
    robot = robots["mgr"]
    measured, simulated = moved(robot, "camera_scale", drive_of(robot, np.random.default_rng(7)), scale=1.3)
    torch.testing.assert_close(measured[:, :2], 1.3 * simulated[:, :2])
    torch.testing.assert_close(measured[:, 2], simulated[:, 2])


def test_a_turned_marker_turns_the_way_and_no_turns(robots):
    robot = robots["mgr"]
    measured, simulated = moved(robot, "marker_yaw", drive_of(robot, np.random.default_rng(8)), angle_rad=0.3)
    turned = rotate(simulated[:, :2], torch.tensor(-0.3, dtype=torch.float64).expand(len(simulated)))
    torch.testing.assert_close(measured[:, :2], turned)
    torch.testing.assert_close(measured[:, 2], simulated[:, 2])


def test_a_marker_off_the_centre_goes_round_it_when_the_vehicle_turns(robots):
    robot = robots["mgr"]
    marker = mechanism_class("marker_offset").at({"forward_mm": 9.0, "left_mm": -12.0})
    drive = drive_of(robot, np.random.default_rng(9), count=20, command=torch.tensor([[-50.0, 50.0]]).expand(20, 2))
    centre = drive.pose[:, :2]
    seen = marker.seen(drive.pose, drive.surroundings)
    turn_rad = torch.zeros(20, dtype=torch.float64)
    for _ in range(6):
        now = drive_of(robot, np.random.default_rng(9), count=20, command=drive.command, pose=seen)
        measured = likeliest_displacement(ExactBase(robot), [marker], now)
        seen, turn_rad = compose(seen, measured), turn_rad + measured[:, 2]
        torch.testing.assert_close((seen[:, :2] - centre).norm(dim=-1), torch.full((20,), 15.0, dtype=torch.float64))
    assert float(turn_rad.min()) > 1.0


def test_half_the_gain_is_half_the_way_and_thrust_goes_by_its_exponents(robots):
    for robot in (robots["mgr"], robots["create"], robots["mur"]):
        measured, simulated = moved(robot, "gain_change", drive_of(robot, np.random.default_rng(10)), gain=0.5)
        factor = 0.5 ** torch.tensor(robot.actuation.strength_exponents, dtype=torch.float64)
        torch.testing.assert_close(twist_of(measured), twist_of(simulated) * factor)


def test_asymmetry_keeps_the_geometric_mean_of_the_wheels(robots):
    robot = robots["mgr"]
    drive = drive_of(robot, np.random.default_rng(11))
    measured, simulated = moved(robot, "actuator_asymmetry", drive, ratio=1.44)
    track_mm = drive.surroundings.track_mm
    factors = wheel_ways(twist_of(measured), track_mm) / wheel_ways(twist_of(simulated), track_mm)
    torch.testing.assert_close(factors, torch.tensor([[1.2, 1 / 1.2]], dtype=torch.float64).expand(200, 2))


def test_a_trimmed_fin_is_another_angle(robots):
    robot = robots["mur"]
    drive = drive_of(robot, np.random.default_rng(12))
    measured, _ = moved(robot, "actuator_asymmetry", drive, angle_rad=math.radians(5))
    command = drive.command + torch.tensor([[5.0, 0.0, 0.0]], dtype=torch.float64)
    torch.testing.assert_close(measured, displacement_of(ExactBase(robot).way(command, command, drive.pose)))


def test_small_commands_do_nothing_and_large_ones_are_cut(robots):
    robot = robots["mgr"]
    drive = drive_of(robot, np.random.default_rng(13))
    base = ExactBase(robot)
    dead, cut = drive.command.clone(), drive.command.clamp(-70, 70)
    dead[dead.abs() < 30] = 0.0
    for name, values, command in (("dead_band", {"width": 30.0}, dead), ("saturation", {"limit": 70.0}, cut)):
        measured, _ = moved(robot, name, drive, **values)
        torch.testing.assert_close(measured, displacement_of(base.way(command, command, drive.pose)))


def test_saturation_of_a_unicycle_is_that_of_its_wheels(robots):
    robot = robots["create"]
    drive = drive_of(robot, np.random.default_rng(14))
    half_mm = robot.actuation.track_mm / 2
    wheels = [drive.command[:, 0] + sign * half_mm * drive.command[:, 1] for sign in (-1, 1)]
    left, right = (wheel.clamp(-60, 60) for wheel in wheels)
    expected = torch.stack([(left + right) / 2, 0 * left, (right - left) / (2 * half_mm)], dim=-1) * robot.period_s
    torch.testing.assert_close(twist_of(moved(robot, "saturation", drive, limit=60.0)[0]), expected)


def test_play_is_lost_at_a_reversal_and_only_there(robots):
    robot = robots["mgr"]
    signs = torch.tensor([[1, 1, 1], [1, 1, -1], [-1, -1, 1], [-1, -1, -1], [-1, 1, 1]], dtype=torch.float64)
    earlier, previous, command = (80 * signs[:, [column, column]] for column in range(3))
    changes = {"command": command, "previous_command": previous, "earlier_command": earlier}
    drive = drive_of(robot, np.random.default_rng(15), count=5, **changes)
    measured, simulated = moved(robot, "backlash", drive, travel_mm=4.0)
    lost = (simulated - measured)[:, 0].tolist()
    assert lost == pytest.approx([0, -4, 4, 0, 0])


def test_a_battery_loses_nothing_at_first_and_its_loss_in_the_end(robots):
    robot = robots["mgr"]
    elapsed_s = torch.tensor([0.0, 250.0, 1000.0])
    drive = drive_of(robot, np.random.default_rng(16), count=3, elapsed_s=elapsed_s)
    measured, simulated = moved(robot, "battery_sag", drive, loss=0.4, shape=2.0)
    factor = torch.tensor([[1.0], [1 - 0.4 / 16], [0.6]], dtype=torch.float64)
    torch.testing.assert_close(twist_of(measured), twist_of(simulated) * factor)


def _along_the_lower_wall(robot, away_mm):
    pose = torch.tensor([[500.0, robot.arena_mm.y[0] + away, 0.0] for away in away_mm])
    command = torch.full((len(away_mm), 2), 60.0)
    return drive_of(robot, np.random.default_rng(17), count=len(away_mm), pose=pose, command=command)


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
        drive = drive_of(robot, rng, count=50, pose=poses[own], **changes)
        measured, _ = moved(robot, "neighbour_interaction", drive, strength_mm_s=20.0, reach_mm=80.0)
        ends.append((compose(poses[own], measured) - poses[own])[:, :2])
    torch.testing.assert_close(ends[0], -ends[1])
    apart = poses[0, :, :2] - poses[1, :, :2]
    distance_mm = apart.norm(dim=-1, keepdim=True)
    expected = 20.0 * robot.period_s * torch.exp(-distance_mm / 80) * apart / distance_mm
    torch.testing.assert_close(ends[0], expected, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("probability", [0.0, 0.2, 0.6])
def test_a_command_arrives_or_the_one_before_goes_on(robots, probability):
    robot = robots["mgr"]
    drive = drive_of(robot, np.random.default_rng(19))
    base = ExactBase(robot)
    found = alternatives(base, [mechanism_class("command_loss").at({"probability": probability})], drive)
    assert sum(one.probability for one in found) == pytest.approx(1.0)
    sent = (drive.command, drive.previous_command, drive.earlier_command)
    for one, command in zip(found, sent, strict=True):
        torch.testing.assert_close(one.displacement, displacement_of(base.way(command, command, drive.pose)))
    assert found[0].probability == pytest.approx(1 - probability)


def test_motion_lasts_as_long_as_the_period(robots):
    for robot in (robots["mgr"], robots["mur"]):
        rng = np.random.default_rng(20)
        periods = rng.uniform(0.5, 1.6, 200)
        measured, simulated = moved(robot, "timing_jitter", drive_of(robot, rng, duration_s=periods * robot.period_s))
        torch.testing.assert_close(twist_of(measured), twist_of(simulated) * torch.as_tensor(periods)[:, None])
    jitter = mechanism_class("timing_jitter")
    assert jitter.observed(np.array([0.45, 0.55] * 50), 0.5) == pytest.approx({"spread": 0.1})
    assert jitter.observed(np.full(100, 0.5), 0.5) is None


def test_only_a_change_of_noise_multiplies_noise(robots):
    for name in mechanism_names():
        kind = mechanism_class(name)
        start = kind.starts(robots["mgr"], surroundings_of(robots["mgr"]))[0]
        expected = 1.7 if name == "noise_change" else 1.0
        assert kind.at({**start, "factor": 1.7}).noise_factor() == expected
