"""What a fleet is made of: the physics in real time, the memory that its processes share, the way of commands."""

import struct
import threading
import time

import numpy as np
import pytest

from swarmtwin.deploy.fleet.emulated_vehicle import EmulatedVehicle
from swarmtwin.deploy.fleet.faulty_path import FaultyPath
from swarmtwin.deploy.fleet.fleet_memory import FleetMemory
from swarmtwin.deploy.fleet.orders import Orders, RobotFaults
from swarmtwin.geometry import displacement_between
from swarmtwin.standin.effects import parse_effects
from swarmtwin.standin.live import LiveVehicles
from swarmtwin.standin.overhead_camera import CameraConditions, OverheadCamera
from swarmtwin.standin.physics import Period, advance
from swarmtwin.standin.session import StandInSession

NOBODY = np.empty((0, 2))
START = (400.0, 500.0, 0.7)


def vehicle_of(robot, name="2", effects=(), seed=1, pose=START, session_s=600.0, wall_mm=150.0, obstacles=()):
    return EmulatedVehicle(robot, name, parse_effects(effects, robot, 2), seed, pose, session_s, wall_mm, obstacles)


class Still:
    """Chance that never does anything."""

    def standard_normal(self, shape, dtype):
        return np.zeros(shape, dtype)


EFFECTS = {
    "clean": [],
    "ageing, slow, loose": [
        {"name": "battery_sag", "loss": 0.5},
        {"name": "actuator_lag"},
        {"name": "backlash"},
        {"name": "dead_band"},
    ],
    "by place": [{"name": "surface_patch"}, {"name": "steady_drift"}, {"name": "neighbour_interaction"}],
}


@pytest.mark.parametrize("effects", EFFECTS)
@pytest.mark.parametrize("name", ["mgr", "mur"])
def test_step_by_step_it_moves_as_the_stand_in_does_over_a_period(robots, name, effects):
    robot, others_mm = robots[name], np.array([[450.0, 820.0], [900.0, 100.0]])
    one = vehicle_of(robot, effects=EFFECTS[effects])
    one._rng = Still()
    session = StandInSession(robot, ("2",), 1, 1, 1, parse_effects(EFFECTS[effects], robot, 2))
    physics = session.physics(("2",))
    state = physics.at_rest(np.array(START).reshape(3, 1, 1))
    others = np.broadcast_to(others_mm.T.reshape(2, 2, 1, 1), (2, 2, 2, 1, 1))
    steps = round(robot.period_s / one.step_s)
    for command in np.random.default_rng(3).uniform(robot.command_low, robot.command_high, (4, len(robot.command))):
        for _ in range(steps):
            one.step(command, 300.0, others_mm)
        given = command.reshape(-1, 1, 1)
        state = advance(physics, state, Period(given, given, robot.period_s, np.full((1, 1), 0.5), others))
    np.testing.assert_allclose(one.pose, state[:3, 0, 0], atol=1e-9)


@pytest.mark.parametrize("name", ["mgr", "mur"])
def test_its_motion_is_as_random_as_the_stand_in_s(robots, name):
    robot, count = robots[name], 150
    command = robot.command_low + 0.8 * (robot.command_high - robot.command_low)
    live = LiveVehicles(robot, ("2",), 1500, 5)
    live.place(np.arange(1500), np.tile(START, (1500, 1, 1)))
    live.move(np.tile(command, (1500, 1, 1)))
    there = np.moveaxis(live._state[:3, :, 0], 0, -1)
    mine = []
    for seed in range(count):
        one = vehicle_of(robot, seed=seed)
        for _ in range(round(robot.period_s / one.step_s)):
            one.step(command, 0.0, NOBODY)
        mine.append(one.pose.copy())
    expected, moved = (
        displacement_between(np.array(START), there),
        displacement_between(np.array(START), np.array(mine)),
    )
    standard_error = expected.std(axis=0) * np.sqrt(1 / count + 1 / 1500)
    assert np.all(np.abs(moved.mean(axis=0) - expected.mean(axis=0)) < 4.5 * standard_error)
    np.testing.assert_allclose(moved.std(axis=0) / expected.std(axis=0), 1, atol=0.25)


@pytest.mark.parametrize("name", ["mgr", "mur"])
def test_a_step_cut_short_leaves_it_where_it_was_on_its_way(robots, name):
    """Twenty steps, each cut at a random moment: never a jump, and as far as without a cut in the same time."""
    robot, rng = robots[name], np.random.default_rng(4)
    command = robot.command_low + 0.9 * (robot.command_high - robot.command_low)
    one, whole = vehicle_of(robot), vehicle_of(robot)
    one._rng, whole._rng = Still(), Still()
    driven_s = 0.0
    while driven_s < 2 * robot.period_s:
        before = one.pose.copy()
        one.step(command, 0.0, NOBODY)
        share = rng.uniform(0.05, 1)
        on_the_way = before + share * (one.pose - before)
        one.cut(share * one.step_s)
        driven_s += share * one.step_s
        assert np.abs(one.pose - on_the_way)[:2].max() < 0.2
    for _ in range(round(driven_s / whole.step_s)):
        whole.step(command, 0.0, NOBODY)
    way_mm = np.hypot(*(whole.pose - START)[:2])
    assert np.hypot(*(one.pose - whole.pose)[:2]) < 0.03 * way_mm + 2


def test_vehicles_that_meet_stop_each_other_and_walls_stop_them(robots):
    ahead = np.array([120.0, 120.0])
    left, right = vehicle_of(robots["mgr"], pose=(300, 500, 0)), vehicle_of(robots["mgr"], pose=(700, 500, np.pi))
    for _ in range(400):
        left.step(ahead, 0.0, right.pose[None, :2])
        right.step(ahead, 0.0, left.pose[None, :2])
        if np.hypot(*(left.pose - right.pose)[:2]) < left.contact_mm + 1:
            break
    for _ in range(50):
        left.step(ahead, 0.0, right.pose[None, :2])
        right.step(ahead, 0.0, left.pose[None, :2])
        assert np.hypot(*(left.pose - right.pose)[:2]) > left.contact_mm - 4
    runaway = vehicle_of(robots["mgr"], pose=(1000, 500, 0), wall_mm=80)
    for _ in range(200):
        runaway.step(ahead, 0.0, NOBODY)
    assert runaway.pose[0] == robots["mgr"].arena_mm.x[1] + 80


def test_an_obstacle_is_not_driven_through_and_is_seen_where_it_stands(robots):
    """Straight at it a vehicle stays before it, beside its middle it slides along; the camera's disc has its size."""
    robot, obstacle = robots["mgr"], (500.0, 500.0, 80.0)
    touching_mm = 80 + max(robot.vehicle_size_mm) / 2
    for aside_mm in (0.0, 30.0):
        one = vehicle_of(robot, pose=(300, 500 + aside_mm, 0), obstacles=[obstacle])
        for _ in range(400):
            one.step(np.array([120.0, 120.0]), 0.0, NOBODY)
            assert np.hypot(*(one.pose[:2] - obstacle[:2])) > touching_mm - 1e-6
    flat = CameraConditions(pixel_noise=0.0, mm_per_pixel=4.0)
    empty, occupied = (OverheadCamera(robot, ("1",), flat, obstacles=some) for some in ((), [obstacle]))
    nowhere = np.full((1, 3), np.nan)
    before, after = (camera.render(nowhere, np.random.default_rng(1)) for camera in (empty, occupied))
    rows, columns = np.nonzero(np.abs(after.astype(int) - before) > 30)
    middle_px = occupied.optics.project(np.array([[500.0, 500.0, 0.0]]))[0]
    assert [columns.mean(), rows.mean()] == pytest.approx(middle_px, abs=0.5)
    assert len(rows) * 4.0**2 == pytest.approx(np.pi * 80**2, rel=0.05)


def test_nobody_reads_half_a_row(robots):
    """One writes, three read, as fast as they can: all nine numbers of a row are always of the same write."""
    memory, stop, wrong = FleetMemory(("1", "2")), threading.Event(), []
    other = FleetMemory(("1", "2"), memory.descriptor)

    def write():
        for number in range(100_000_000):
            if stop.is_set():
                return
            memory.write(
                1, (number, np.full(3, number)), (number, np.full(3, number)), np.full(2, number), number, 0, 0
            )

    def read():
        while not stop.is_set():
            row = other.read()[1]
            if len({*row[1:10], *row[12:14]}) > 1:
                wrong.append(row)

    threads = [threading.Thread(target=work) for work in (write, read, read, read)]
    for thread in threads:
        thread.start()
    time.sleep(1.0)
    stop.set()
    for thread in threads:
        thread.join()
    assert memory.read()[1, 1] > 1000
    assert not wrong


def test_of_a_writer_that_died_amidst_a_row_the_row_before_stands():
    memory = FleetMemory(("1",))
    memory.write(0, (1.0, np.ones(3)), (2.0, np.full(3, 2.0)), np.zeros(2), 0, 0.0, 0)
    np.testing.assert_array_equal(memory.poses(1.5), [[1.5, 1.5, 1.5]])
    memory._rows[0, 0] += 1
    memory._rows[0, 2] = 99.0
    np.testing.assert_array_equal(memory.poses(1.5), [[1.5, 1.5, 1.5]])
    memory.write(0, (3.0, np.full(3, 3.0)), (4.0, np.full(3, 4.0)), np.zeros(2), 0, 0.0, 0)
    np.testing.assert_array_equal(memory.poses(9.0), [[4.0, 4.0, 4.0]])
    np.testing.assert_array_equal(memory.velocities(3.5), [[1.0, 1.0, 1.0]])
    np.testing.assert_array_equal(memory.velocities(9.0), [[0.0, 0.0, 0.0]])


def test_orders_of_several_at_once_are_all_kept():
    memory = FleetMemory(("1", "2"))
    others = [FleetMemory(("1", "2"), memory.descriptor) for _ in range(3)]

    def order(one):
        for _ in range(20):
            one.change_orders(lambda before: before.with_placed({"1": (1.0, 2.0, 3.0)}))

    threads = [threading.Thread(target=order, args=(memory,)) for _ in others]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert others[0].orders().placement_number("1") == 60
    assert others[0].orders().placement_number("2") == 0


def test_orders_whose_writer_died_are_not_obeyed_and_the_next_ones_are():
    memory = FleetMemory(("1",))
    memory.change_orders(lambda before: before.with_placed({"1": (1.0, 2.0, 3.0)}))
    struct.pack_into("<Q", memory._map, memory._orders_at, memory.orders_number + 1)
    assert memory.orders(tries=3) is None
    memory.change_orders(lambda before: before.model_copy(update={"robots": {"1": RobotFaults(deaf=True)}}))
    assert memory.orders().robots["1"].deaf


def path_with(**faults):
    path = FaultyPath(np.random.default_rng(1))
    path.faults = RobotFaults(**faults)
    return path


def test_a_path_without_faults_hands_on_at_once_and_in_order():
    path = path_with()
    for number in range(5):
        path.put(b"%d" % number, 1.0)
    assert path.due(1.0) == [b"0", b"1", b"2", b"3", b"4"]
    assert path.due(1e9) == []


def test_late_lost_doubled_overtaken():
    late = path_with(latency_s=0.2)
    late.put(b"a", 1.0)
    assert (late.due(1.19), late.next_s, late.due(1.2)) == ([], 1.2, [b"a"])
    lossy = path_with(loss=0.3)
    doubling = path_with(duplicate=0.3)
    for _ in range(4000):
        lossy.put(b"a", 0.0)
        doubling.put(b"a", 0.0)
    assert abs(len(lossy.due(0.0)) / 4000 - 0.7) < 0.03
    assert abs(len(doubling.due(0.0)) / 4000 - 1.3) < 0.03
    overtaken = path_with(reorder=1.0, latency_s=0.1)
    overtaken.put(b"a", 0.0)
    assert overtaken.due(9.0) == []
    overtaken.put(b"b", 10.0)
    assert overtaken.due(10.1) == [b"b", b"a"]
    jittery = path_with(jitter_s=1.0)
    for number in range(50):
        jittery.put(b"%d" % number, number * 0.1)
    assert [int(one) for one in jittery.due(9.0)] != sorted(range(50))
    deaf = path_with(deaf=True)
    deaf.put(b"a", 0.0)
    assert deaf.due(9.0) == []


def test_orders_are_what_json_brings_back():
    orders = Orders().with_placed({"1": (1.0, 2.0, 3.0)}).with_placed({"1": (4.0, 5.0, 6.0)})
    again = Orders.model_validate_json(orders.model_dump_json())
    assert again == orders
    assert again.placements["1"].number == 2
