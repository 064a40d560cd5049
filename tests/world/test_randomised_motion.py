"""Worlds whose vehicles differ: each roll-out has its own draw, and all goes on as it was from a checkpoint."""

import numpy as np
import pytest
from tiny_worlds import robot_named, simulation_of, task_named

from swarmtwin.simulation.mechanism import mechanism_class
from swarmtwin.simulation.randomisation import Randomisation, with_known_actuation
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.world.motion import SimulatedMotion
from swarmtwin.world.parallel_env import parallel_env
from swarmtwin.world.randomised_motion import RandomisedMotion
from swarmtwin.world.world import World

RANGES = {
    "command_delay": {"delay_s": [0.05, 0.3]},
    "command_loss": {"probability": [0.0, 0.3]},
    "gain_change": {"gain": [0.8, 1.2], "of": "vehicle"},
}


@pytest.fixture(scope="module")
def bare():
    return simulation_of(robot_named("mgr"), "kinematic")


def motion_of(bare, ranges=RANGES, worlds=6, vehicles=2, draws=16, **options):
    return RandomisedMotion(bare, Randomisation.read(ranges, bare, draws), worlds, vehicles, **options)


def commands(count, worlds=6, vehicles=2, seed=1):
    return np.random.default_rng(seed).uniform(-120, 120, (count, worlds, vehicles, 2))


def starts(worlds=6, vehicles=2):
    return np.random.default_rng(0).uniform(300, 700, (worlds, vehicles, 3))


def test_worlds_and_vehicles_differ_within_the_ranges(bare):
    motion = motion_of(bare)
    delay_s, probability, gain = motion.parameters[motion.dealt].transpose(2, 0, 1)
    assert len(np.unique(motion.dealt)) == 6
    for values, (low, high) in zip((delay_s, probability, gain), ((0.05, 0.3), (0.0, 0.3), (0.8, 1.2)), strict=True):
        assert ((values >= low) & (values <= high)).all()
    assert len(np.unique(delay_s)) == len(np.unique(probability)) == 6
    assert len(np.unique(gain)) == 12


def test_each_vehicle_moves_as_its_own_parameters_say(bare):
    motion = motion_of(bare, {"gain_change": {"gain": [0.5, 1.5], "of": "vehicle"}}, sampled=False)
    start = np.zeros((6, 2, 3))
    assert np.array_equal(motion.place(np.arange(6), start), start)
    straight = np.full((6, 2, 2), 60.0)
    moved = motion.move(straight)[..., 0]
    usual = SimulatedMotion(bare, 6, 2)
    usual.place(np.arange(6), start)
    expected = usual.move(straight)[..., 0] * motion.parameters[motion.dealt, :, 0]
    assert moved == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("sampled", [None, False])
def test_ranges_without_width_are_the_extended_simulation_exactly(bare, sampled):
    ranges = {
        "command_delay": {"delay_s": [0.3, 0.3]},
        "command_loss": {"probability": [0.2, 0.2]},
        "marker_offset": {"forward_mm": [12.0, 12.0], "left_mm": [-5.0, -5.0]},
        "timing_jitter": {"spread": [0.1, 0.1]},
    }
    base = with_known_actuation(bare)
    kinds = [
        mechanism_class(name).at({one: low for one, (low, _) in values.items()}) for name, values in ranges.items()
    ]
    extended = Simulation(base.dynamics, kinds, base.conditions, None, base.motion_noise)
    motions = [motion_of(bare, ranges, sampled=sampled, seed=5), SimulatedMotion(extended, 6, 2, sampled, seed=5)]
    for motion in motions:
        motion.place(np.arange(6), starts())
    for command in commands(6):
        assert np.array_equal(motions[0].move(command), motions[1].move(command))
        again = np.array([1, 4])
        first, second = (motion.place(again, starts()[again]) for motion in motions)
        assert np.array_equal(first, second)


def test_a_roll_out_that_starts_anew_has_a_new_draw_and_the_others_keep_theirs(bare):
    motion = motion_of(bare)
    motion.place(np.arange(6), starts())
    before, seen = motion.parameters[motion.dealt].copy(), set()
    for _ in range(20):
        motion.place(np.array([2]), starts()[[2]])
        after = motion.parameters[motion.dealt]
        assert np.array_equal(after[[0, 1, 3, 4, 5]], before[[0, 1, 3, 4, 5]])
        seen.add(after[2, 0, 0])
    assert len(seen) == 20


def test_more_worlds_than_draws_share_them_evenly_and_each_draw_is_given_up_in_turn(bare):
    motion = motion_of(bare, worlds=24, draws=4)
    motion.place(np.arange(24), starts(24))
    assert np.bincount(motion.dealt).tolist() == [6] * 4
    seen = {float(values[0, 0]) for values in motion.parameters}
    for start in range(4 * 24):
        motion.place(np.array([start % 24]), starts(24)[[start % 24]])
        assert set(motion.dealt) <= set(range(4))
        seen |= {float(values[0, 0]) for values in motion.parameters}
    assert len(seen) >= 4 + 4


def test_the_same_seed_draws_the_same_and_another_seed_others(bare):
    first, again, other = (motion_of(bare, seed=seed) for seed in (1, 1, 2))
    for motion in (first, again, other):
        motion.place(np.arange(6), starts())
    command = commands(1)[0]
    moved = [motion.move(command) for motion in (first, again, other)]
    assert np.array_equal(moved[0], moved[1])
    assert not np.array_equal(moved[0], moved[2])


@pytest.mark.parametrize("draws", [16, 2])
def test_a_world_continues_bit_for_bit(bare, draws):
    task = task_named("collective", vehicles=2, steps=45, sees_commands=1)

    def world_of(seed):
        return World(task, motion_of(bare, draws=draws, seed=seed), 6, seed)

    def play(world, drives):
        for drive in drives:
            step = world.step(drive)
            world.restart(step.ended)
        return world.observe()

    world, drives = world_of(0), commands(30)
    world.step_count[:] = np.arange(6) * 8
    play(world, drives[:12])
    kept, kept_motion = world.state(), world.motion.state()
    expected = play(world, drives[12:])
    other = world_of(9)
    other.motion.restore(kept_motion)
    other.restore(kept)
    assert np.array_equal(play(other, drives[12:]), expected)


def test_a_checkpoint_of_other_draws_is_refused(bare):
    with pytest.raises(ValueError, match="does not fit"):
        motion_of(bare, draws=2).restore(motion_of(bare, draws=3).state())
    with pytest.raises(ValueError, match="does not fit"):
        motion_of(bare, worlds=5).restore(motion_of(bare).state())


def test_pettingzoo_agents_may_be_unlike(bare):
    task = task_named("collective", vehicles=2)
    motion = motion_of(bare, {"gain_change": {"gain": [0.5, 1.5], "of": "vehicle"}}, worlds=1, sampled=False)
    env = parallel_env(task, motion, seed=3)
    env.reset(seed=3)
    start = motion.state()["pose"][0, :, :2]
    env.step(dict.fromkeys(env.agents, np.array([60.0, 60.0], np.float32)))
    way_mm = np.linalg.norm(motion.state()["pose"][0, :, :2] - start, axis=-1)
    gain = motion.parameters[motion.dealt[0], :, 0]
    assert way_mm[0] / way_mm[1] == pytest.approx(gain[0] / gain[1], rel=1e-5)
