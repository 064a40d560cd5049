"""Compiled code beside the plain formulas that say what it should give."""

import numpy as np
import pytest
from tiny_worlds import dynamics_of, robot_named, task_named

from swarmtwin.compiled import compiled
from swarmtwin.dynamics.motion_noise import MotionNoise
from swarmtwin.errors import UserError
from swarmtwin.geometry import displacement_between, log_map
from swarmtwin.robot import Arena
from swarmtwin.simulation.displacement_table import TableSettings, tabulated
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.world.compiled import fastest_motion
from swarmtwin.world.compiled.elementary import cos_and_sin, exponential
from swarmtwin.world.compiled.table_motion import TableMotion
from swarmtwin.world.motion import SimulatedMotion
from swarmtwin.world.scenario import ScenarioSupply
from swarmtwin.world.world import World

LOOSE = TableSettings(points=17, position_mm=1e3, heading_deg=1e3)
NOISE = MotionNoise(
    at_rest=(0.5, 0.2, 0.001), with_motion=(2.0, 1.0, 0.004), usual_mm=30.0, usual_rad=0.5, camera=(0.3, 0.3, 0.0004)
)


@compiled
def elementary_functions(angle_rad, power, cos, sin, grown):
    for place in range(len(angle_rad)):
        cos[place], sin[place] = cos_and_sin(angle_rad[place])
        grown[place] = exponential(power[place])


def test_cosine_sine_and_exponential_are_those_of_float32():
    angle_rad = np.concatenate([np.linspace(-7, 7, 50_001), np.linspace(-1e6, 1e6, 50_001)])
    power = np.linspace(-87, 88, len(angle_rad)).astype(np.float32)
    cos, sin, grown = np.empty((3, len(angle_rad)), np.float32)
    elementary_functions(angle_rad, power, cos, sin, grown)
    assert np.abs(cos - np.cos(angle_rad)).max() < 2e-7
    assert np.abs(sin - np.sin(angle_rad)).max() < 2e-7
    assert np.abs(grown / np.exp(power.astype(float)) - 1).max() < 4e-7
    elementary_functions(angle_rad[:2], np.array([-1e30, 1e30], np.float32), cos, sin, grown)
    assert grown[0] < 2e-38
    assert np.isfinite(grown[1])


def table_of(noise=None):
    simulation = Simulation(dynamics_of(robot_named("mgr"), "mlp"), motion_noise=noise)
    return tabulated(simulation, LOOSE)


def crowded(task, worlds, seed):
    """Scenes in which everything happens: contacts, equal distances, targets held, vehicles outside and lost."""
    random = np.random.default_rng(seed)
    scenario = task.draw(random, worlds)
    low, high = task.arena.low_mm, task.arena.high_mm
    pose = np.concatenate(
        [
            random.uniform(low - 60, high + 60, (worlds, task.vehicles, 2)),
            random.uniform(-4, 4, (worlds, task.vehicles, 1)),
        ],
        -1,
    )
    near, places = random.random(worlds) < 0.5, np.nan_to_num(scenario.target_of_each, nan=400.0)
    pose[near, :, :2] = places[near] + random.normal(0, 60, (near.sum(), task.vehicles, 2))
    pose[0, :, :2] = [(400.0 + 60 * place, 500.0) for place in range(task.vehicles)]  # as near on both sides
    pose[1, 0, :2] = low - 2000
    pose[2, 0, :2] = places[2, 0]
    return scenario, pose


LOCAL = {"sees_nearest": 3, "sees_within_mm": 250.0}


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"sees_walls": True},
        {"vehicles": 2, "outside_mm": 30},
        {"vehicles": 7, "sees_nearest": 2},
        LOCAL,
        {"vehicles": 3, "sees_nearest": 5},
        {"sees_nearest": 0, "sees_walls": True},
    ],
)
@pytest.mark.parametrize("name", ["collective", "pair", "formation", "coverage"])
def test_what_a_group_measures_is_what_the_formulas_say(name, changes):
    if name in ("coverage", "formation") and changes.get("vehicles"):  # fit as many as they are
        changes = {name: value for name, value in changes.items() if name != "vehicles"}
    task = task_named(name, **changes)
    for worlds, seed in ((3, 0), (64, 1), (150, 2)):
        scenario, pose = crowded(task, worlds, seed)
        check_equal(task.measure(scenario, pose), task.measure_compiled(scenario, pose))


@pytest.mark.parametrize("changes", [{}, LOCAL, {"sees_nearest": 4, "sees_walls": True}, {"sees_nearest": 0}])
@pytest.mark.parametrize("vehicles", [21, 60])
def test_a_large_group_measures_by_a_grid_what_the_formulas_say(vehicles, changes):
    crowd = {"separation_mm": 101, "reach_mm": 600, "margin_mm": 0, "vehicles": vehicles, **changes}
    task = task_named("collective", arena=Arena(x=(0, 2000), y=(-300, 1500)), **crowd)
    scenario, pose = crowded(task, 20, 3)
    pose[0, :, 1] += np.random.default_rng(0).normal(0, 5, vehicles)  # no ties: a search tree takes any
    check_equal(task.measure(scenario, pose), task.measure_compiled(scenario, pose))


@pytest.mark.parametrize(
    ("name", "vehicles", "changes"),
    [
        ("formation", 1, {}),
        ("coverage", 1, {"covered": 0.2}),
        ("coverage", 200, {"steps": 400}),
        ("collective", 200, {"reach_mm": 1600, "steps": 400, **LOCAL}),
    ],
)
def test_one_vehicle_and_two_hundred_are_worlds_as_others_are(name, vehicles, changes):
    side_mm = 1030 * max(1.0, (vehicles / 5) ** 0.5)
    task = task_named(name, vehicles=vehicles, arena=Arena(x=(0, side_mm), y=(0, side_mm)), **changes)
    world = World(task, fastest_motion(table_of(), 2, vehicles), 2, seed=1, compiled=True)
    command = np.random.default_rng(0).uniform(-120, 120, (5, *world.shape))
    for given in command:
        step = world.step(given)
        expected = task.measure(world.scenario, world.pose)
        assert step.observation == pytest.approx(expected.observation, abs=2e-4)
        assert step.reward == pytest.approx(expected.reward, abs=1e-3)
        assert np.array_equal(step.events.collided, expected.events.collided)


def check_equal(plain, fast):
    assert fast.observation.dtype == np.float32
    assert fast.observation == pytest.approx(plain.observation, abs=2e-5)
    assert fast.reward == pytest.approx(plain.reward, abs=1e-4)
    for event in ("collided", "left_arena", "at_target"):
        assert np.array_equal(getattr(fast.events, event), getattr(plain.events, event))
    assert np.array_equal(fast.lost, plain.lost)
    assert plain.lost.any()
    assert plain.events.collided.any()
    assert not plain.events.collided.all()


def test_a_task_without_compiled_code_is_measured_by_its_formulas():
    task = task_named("obstacle")
    scenario = task.draw(np.random.default_rng(0), 5)
    plain, same = (measure(scenario, scenario.start) for measure in (task.measure, task.measure_compiled))
    assert np.array_equal(plain.observation, same.observation)


def test_a_table_moves_vehicles_as_the_simulation_does():
    simulation = table_of()
    plain, fast = SimulatedMotion(simulation, 40, 3), fastest_motion(simulation, 40, 3)
    assert isinstance(fast, TableMotion)
    random = np.random.default_rng(0)
    start = np.concatenate([random.uniform(0, 1000, (40, 3, 2)), random.uniform(-3.1, 3.1, (40, 3, 1))], axis=-1)
    for motion in (plain, fast):
        assert motion.place(np.arange(40), start) == pytest.approx(start)
    low, high = simulation.robot.command_low, simulation.robot.command_high
    for _ in range(30):
        command = random.uniform(1.2 * low, 1.2 * high, (40, 3, 2))
        expected, moved = plain.move(command), fast.move(command)
        assert moved[..., :2] == pytest.approx(expected[..., :2], abs=0.01)
        assert np.exp(1j * moved[..., 2]) == pytest.approx(np.exp(1j * expected[..., 2]), abs=3e-5)  # float32, added up
        assert (np.abs(moved[..., 2]) <= np.pi).all()


def test_the_random_part_of_a_table_s_motion_has_the_spread_of_the_simulation_s():
    simulation = table_of(NOISE)
    worlds, command = 40_000, np.array([90.0, -20.0])
    twists, measured = {}, {}
    for kind in (SimulatedMotion, TableMotion):
        motion = kind(simulation, worlds, 1, sampled=True, seed=3)
        placed = motion.place(np.arange(worlds), np.zeros((worlds, 1, 3)))
        moved = motion.move(np.tile(command, (worlds, 1, 1)))
        twists[kind] = log_map(displacement_between(np.zeros((worlds, 3)), moved[:, 0]))
        measured[kind] = placed[:, 0]
    for drawn in (twists, measured):
        plain, fast = drawn[SimulatedMotion], drawn[TableMotion]
        spread = plain.std(axis=0)
        assert (np.abs(plain.mean(axis=0) - fast.mean(axis=0)) < 5 * spread * np.sqrt(2 / worlds)).all()
        assert fast.std(axis=0) == pytest.approx(spread, rel=0.02)
        assert np.corrcoef(fast.T) == pytest.approx(np.corrcoef(plain.T), abs=0.03)


def test_a_table_s_motion_continues_from_where_it_was():
    simulation = table_of(NOISE)
    command = np.random.default_rng(1).uniform(-120, 120, (9, 4, 2, 2))
    motion = fastest_motion(simulation, 4, 2, sampled=True, seed=5)
    motion.place(np.arange(4), np.zeros((4, 2, 3)))
    for moment in range(4):
        motion.move(command[moment])
    kept = motion.state()
    expected = [motion.move(command[moment]) for moment in range(4, 9)]
    other = fastest_motion(simulation, 4, 2, sampled=True, seed=6)
    other.restore(kept)
    assert all(np.array_equal(other.move(command[moment]), expected[moment - 4]) for moment in range(4, 9))
    with pytest.raises(ValueError, match="does not fit"):
        fastest_motion(simulation, 5, 2).restore(kept)


def test_motion_that_is_not_known_to_vary_is_not_drawn():
    with pytest.raises(UserError, match="does not know how much its motion varies"):
        fastest_motion(table_of(), 1, 1, sampled=True)


def test_a_compiled_world_lives_through_the_same_as_a_plain_one():
    task, simulation = task_named("collective", vehicles=2, targets=2, targets_apart_mm=300, steps=80), table_of()
    worlds = [
        World(task, motion(simulation, 20, 2), 20, seed=4, compiled=compiled)
        for motion, compiled in ((SimulatedMotion, False), (fastest_motion, True))
    ]
    for world in worlds:
        world.step_count[:] = 3 * np.arange(20)
    random, ended = np.random.default_rng(0), 0
    for _ in range(100):
        command = random.uniform(-120, 120, worlds[0].shape)
        plain, fast = (world.step(command) for world in worlds)
        assert np.array_equal(plain.ended, fast.ended)
        assert np.array_equal(plain.events.collided, fast.events.collided)
        assert fast.reward == pytest.approx(plain.reward, abs=0.01)
        assert fast.observation == pytest.approx(plain.observation, abs=0.01)
        ended += int(plain.ended.sum())
        after = [worlds[0].restart(plain.ended), worlds[1].restart(fast.ended, fast.observation)]
        assert after[1] == pytest.approx(after[0], abs=0.01)
    assert ended >= 20


def test_scenarios_drawn_ahead_are_those_of_the_seed_and_continue():
    task = task_named("obstacle")
    supply, same = (ScenarioSupply(task.draw, at_a_time=10, seed=7) for _ in range(2))
    taken = [supply.take(count).start for count in (3, 4, 25, 1)]
    assert np.array_equal(np.concatenate(taken), same.take(33).start)
    kept, expected = supply.state(), supply.take(12).start
    other = ScenarioSupply(task.draw, at_a_time=10, seed=8)
    other.restore(kept)
    assert np.array_equal(other.take(12).start, expected)
    other.reseed(7)
    assert np.array_equal(other.take(3).start, taken[0])
