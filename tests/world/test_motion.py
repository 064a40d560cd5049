import numpy as np
import pytest
import torch
from tiny_worlds import dynamics_of, robot_named, task_named

from swarmtwin.dynamics.model_config import model_names
from swarmtwin.dynamics.motion_noise import MotionNoise
from swarmtwin.dynamics.predictor import NetworkDynamics
from swarmtwin.errors import UserError
from swarmtwin.geometry import compose, wrap_angle
from swarmtwin.learning.situation import ALL_PARTS, Situation
from swarmtwin.recordings.recording import Header, Recording, Track
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.transitions import from_recording
from swarmtwin.world.motion import SimulatedMotion
from swarmtwin.world.world import World

START = np.array([[(300.0, 300.0, 0.5), (700.0, 300.0, -2.0)], [(300.0, 700.0, 3.0), (500.0, 500.0, 1.0)]])


class Witness(torch.nn.Module):
    """Stands in for a dynamics model: keeps what it is given and moves everything as told."""

    inputs = ALL_PARTS

    def __init__(self, robot, displacement):
        super().__init__()
        self.robot, self.displacement, self.seen = robot, torch.tensor(displacement), []

    def predict(self, situation):
        self.seen.append(situation)
        return self.displacement.expand(len(situation), 3)


def moved_by(dynamics, worlds, vehicles):
    return SimulatedMotion(Simulation(dynamics), worlds, vehicles)


def at_start(dynamics):
    motion = moved_by(dynamics, 2, 2)
    assert np.array_equal(motion.place(np.arange(2), START), START)
    return motion


@pytest.mark.parametrize("name", model_names())
@pytest.mark.parametrize("robot", ["mgr", "mur"])
def test_every_model_moves_vehicles_as_it_predicts(name, robot):
    robot = robot_named(robot)
    dynamics = dynamics_of(robot, name)
    motion = at_start(dynamics)
    command = np.random.default_rng(0).uniform(robot.command_low, robot.command_high, (2, 2, len(robot.command)))
    parts = {"command": command.reshape(4, -1), "pose": START.reshape(4, 3)}
    tensors = {part: torch.as_tensor(parts[part], dtype=torch.float32) for part in dynamics.inputs}
    with torch.inference_mode():
        displacement = dynamics(Situation(**tensors)).numpy().astype(float).reshape(2, 2, 3)
    assert np.array_equal(motion.move(command), compose(START, displacement))


def test_a_model_is_told_the_pose_the_command_before_and_the_time():
    robot = robot_named("mgr")
    witness = Witness(robot, [10.0, 0.0, 0.1])
    motion = at_start(witness)
    first, second = np.full((2, 2, 2), 30.0), np.full((2, 2, 2), -40.0)
    moved = motion.move(first)
    motion.move(second)
    before, after = witness.seen
    assert before.previous_command.isnan().all()
    assert torch.equal(before.command, torch.full((4, 2), 30.0))
    assert torch.equal(after.previous_command, before.command)
    assert torch.equal(after.command, torch.full((4, 2), -40.0))
    assert np.allclose(before.pose.numpy(), START.reshape(4, 3))
    assert np.allclose(after.pose.numpy(), moved.reshape(4, 3))
    assert before.elapsed_s.tolist() == [0.0] * 4
    assert after.elapsed_s.tolist() == [0.5] * 4
    assert after.duration_s.tolist() == [0.5] * 4


def test_a_model_is_told_of_the_vehicles_of_the_same_world_as_a_recording_of_them_would_tell():
    robot = robot_named("mgr")
    witness = Witness(robot, [10.0, -4.0, 0.1])
    motion = moved_by(witness, 2, 3)
    poses = [np.random.default_rng(0).uniform(400, 600, (2, 3, 3))]
    poses[0][..., 2] /= 100
    motion.place(np.arange(2), poses[0])
    poses[0][..., 2] = wrap_angle(poses[0][..., 2])
    poses += [motion.move(np.zeros((2, 3, 2))) for _ in range(4)]
    time_s, command = robot.period_s * np.arange(5), np.zeros((5, 2))
    tracks = [
        Track(f"run-{world}", str(vehicle), time_s, command, np.array([pose[world, vehicle] for pose in poses]))
        for world in range(2)
        for vehicle in range(3)
    ]
    header = Header(robot=robot.name, period_s=robot.period_s, arena_mm=robot.arena_mm, source="simulated")
    recorded = from_recording(Recording(robot, header, tuple(tracks)))[0].neighbours.reshape(6, 4, 2, 3)
    seen = torch.stack([situation.neighbours for situation in witness.seen], dim=1).numpy()
    assert np.isfinite(recorded).all()
    assert recorded == pytest.approx(seen, abs=1e-3)


def test_a_vehicle_alone_in_its_world_has_no_neighbours():
    witness = Witness(robot_named("mgr"), [10.0, 0.0, 0.0])
    moved_by(witness, 3, 1).move(np.zeros((3, 1, 2)))
    assert witness.seen[0].neighbours.shape == (3, 0, 3)


def test_placed_vehicles_have_no_past_and_the_others_keep_theirs():
    witness = Witness(robot_named("mgr"), [10.0, 0.0, 0.0])
    motion = at_start(witness)
    motion.move(np.full((2, 2, 2), 30.0))
    motion.place(np.array([1]), START[1:])
    pose = motion.move(np.full((2, 2, 2), 50.0))
    situation = witness.seen[-1]
    assert situation.previous_command[:2].tolist() == [[30.0, 30.0]] * 2
    assert situation.previous_command[2:].isnan().all()
    assert situation.elapsed_s.tolist() == [0.5, 0.5, 0.0, 0.0]
    assert pose[1] == pytest.approx(compose(START[1], np.array([(10.0, 0, 0)] * 2)))


def test_a_model_is_told_the_command_before_the_previous_one():
    witness = Witness(robot_named("mgr"), [10.0, 0.0, 0.0])
    motion = at_start(witness)
    drives = np.random.default_rng(2).integers(-100, 100, (5, 2, 2, 2)).astype(float)
    for step, drive in enumerate(drives):
        if step == 3:
            motion.place(np.array([1]), START[1:])
        motion.move(drive)
    earlier = torch.stack([situation.earlier_command for situation in witness.seen]).reshape(5, 2, 2, 2)
    assert earlier[:2].isnan().all()
    assert np.array_equal(earlier[2:, 0].numpy(), drives[:3, 0])
    assert np.array_equal(earlier[2, 1].numpy(), drives[0, 1])
    assert earlier[3:, 1].isnan().all()


def test_a_restored_motion_goes_on_with_all_that_it_remembers():
    witness = Witness(robot_named("mgr"), [10.0, 0.0, 0.0])
    motion = at_start(witness)
    for speed in (30.0, 50.0):
        motion.move(np.full((2, 2, 2), speed))
    other = moved_by(witness, 2, 2)
    other.restore(motion.state())
    for speed in (70.0, 90.0):
        assert np.array_equal(motion.move(np.full((2, 2, 2), speed)), other.move(np.full((2, 2, 2), speed)))
        expected, restored = witness.seen[-2:]
        for part in ALL_PARTS:
            assert torch.equal(getattr(expected, part), getattr(restored, part)), part
    with pytest.raises(ValueError, match="does not fit"):
        moved_by(witness, 3, 2).restore(motion.state())


def noisy_motion(sampled, seed=0, worlds=2000):
    noise = MotionNoise(at_rest=(4.0, 1.0, 0.01), with_motion=(0, 0, 0), usual_mm=20, usual_rad=0.5, camera=(0, 0, 0))
    simulation = Simulation(Witness(robot_named("mgr"), [10.0, 0.0, 0.0]), motion_noise=noise)
    motion = SimulatedMotion(simulation, worlds, 1, sampled, seed)
    motion.place(np.arange(worlds), np.full((worlds, 1, 3), (500.0, 500.0, 0.0)))
    return motion


def test_a_bare_dynamics_model_moves_most_likely_unless_it_is_sampled():
    still = np.zeros((2000, 1, 2))
    assert np.array_equal(noisy_motion(None).move(still), noisy_motion(False).move(still))
    assert (noisy_motion(None).move(still)[..., 0] == 510).all()
    drawn = noisy_motion(True).move(still)[:, 0] - (510.0, 500.0, 0.0)
    assert drawn.mean(axis=0) == pytest.approx([0, 0, 0], abs=0.25)
    assert drawn.std(axis=0) == pytest.approx([2.0, 1.1, 0.1], rel=0.1)


def test_what_is_drawn_depends_on_the_seed_alone_and_goes_on_after_a_restart():
    still = np.zeros((2000, 1, 2))
    first, again, other = noisy_motion(True, 1), noisy_motion(True, 1), noisy_motion(True, 2)
    assert np.array_equal(first.move(still), again.move(still))
    assert not np.array_equal(first.move(still), other.move(still))
    restored = noisy_motion(True, 3)
    restored.restore(first.state())
    assert np.array_equal(restored.move(still), first.move(still))


def test_a_simulation_that_knows_nothing_random_cannot_be_sampled():
    simulation = Simulation(Witness(robot_named("mgr"), [10.0, 0.0, 0.0]))
    with pytest.raises(UserError, match="sampled=true: this simulation of 'mgr' does not know how much its motion var"):
        SimulatedMotion(simulation, 1, 1, sampled=True)


def test_straight_ahead_is_along_the_heading():
    motion = at_start(Witness(robot_named("mgr"), [10.0, 0.0, 0.0]))
    shift = motion.move(np.zeros((2, 2, 2)))[..., :2] - START[..., :2]
    assert shift == pytest.approx(10 * np.stack([np.cos(START[..., 2]), np.sin(START[..., 2])], axis=-1))


def test_a_pose_given_out_is_not_changed_afterwards():
    motion = at_start(Witness(robot_named("mgr"), [10.0, 0.0, 0.0]))
    pose = motion.move(np.zeros((2, 2, 2)))
    kept = pose.copy()
    motion.place(np.array([0]), START[1:])
    motion.move(np.zeros((2, 2, 2)))
    assert np.array_equal(pose, kept)


def test_large_batches_are_predicted_in_parts_with_the_same_result(monkeypatch):
    dynamics = dynamics_of(robot_named("mur"), "mlp")
    command = np.random.default_rng(1).uniform(0, 9, (2, 2, 3))
    whole = at_start(dynamics).move(command)
    monkeypatch.setattr(NetworkDynamics, "batch_size", 3)
    assert at_start(dynamics).move(command) == pytest.approx(whole, abs=1e-4)


def test_a_broken_model_is_refused():
    dynamics = dynamics_of(robot_named("mgr"), "mlp")
    with torch.no_grad():
        next(dynamics.network.parameters()).fill_(torch.nan)
    with pytest.raises(UserError, match="the simulation of 'mgr' predicts a displacement that is not finite"):
        at_start(dynamics).move(np.zeros((2, 2, 2)))


def test_a_model_of_all_that_networks_take_plays_a_task_and_draws_no_random_number():
    task = task_named("collective")
    dynamics = dynamics_of(task.robot, "mlp", ALL_PARTS)
    before = torch.random.get_rng_state()
    world = World(task, moved_by(dynamics, 2, 5), 2, 0)
    for _ in range(3):
        assert np.isfinite(world.step(np.full(world.shape, 60.0)).observation).all()
    assert torch.equal(before, torch.random.get_rng_state())
