"""An extended simulation is a dynamics model: it moves worlds and runs, and comes back from its folder bit by bit."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml
from exact import ExactBase, drive_of, surroundings_of

from drives import drive as made_drive
from swarmtwin.dynamics.open_loop import open_loop
from swarmtwin.dynamics.situation import Situation
from swarmtwin.dynamics.store import save_dynamics
from swarmtwin.dynamics.twist import displacement_of
from swarmtwin.errors import UserError
from swarmtwin.gap.base import Columns, LearnedBase
from swarmtwin.gap.catalogue import mechanism_class, mechanism_names
from swarmtwin.gap.ensemble import Ensemble
from swarmtwin.gap.extended import ExtendedDynamics
from swarmtwin.gap.learned import LearnedResidual, columns
from swarmtwin.gap.motion import likeliest_displacement
from swarmtwin.gap.store import load_dynamics
from swarmtwin.geometry import compose
from swarmtwin.world.motion import SimulatedMotion

SMOOTH = {
    "command_delay": {"delay_s": 0.12},
    "battery_sag": {"loss": 0.3, "shape": 1.5},
    "steady_drift": {"x_mm_s": 3.0, "y_mm_s": -2.0},
    "neighbour_interaction": {"strength_mm_s": 8.0, "reach_mm": 120.0},
    "marker_yaw": {"angle_rad": 0.1},
}


def mechanisms(**values):
    return [mechanism_class(name).at(own) for name, own in values.items()]


def random_ensemble(members, groups, seed):
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        ensemble = Ensemble(members, groups)
        for parameter in ensemble.parameters():
            parameter.data += 0.05 * torch.randn_like(parameter)
        ensemble.offset.copy_(torch.tensor([3.0, 0.1, 0.02]))
        ensemble.scale.copy_(torch.tensor([10.0, 1.0, 0.2]))
    return ensemble.eval()


def learned(robot, extended_by=SMOOTH):
    """An extension of a learned base, with a learned residual beyond its mechanisms."""
    surroundings = surroundings_of(robot)
    parts = ("command", "previous_command", "pose")
    base = LearnedBase(robot, parts, surroundings, random_ensemble(4, Columns(robot, parts, surroundings).groups(), 1))
    width = columns(drive_of(robot, np.random.default_rng(0), count=1)).shape[1]
    residual = LearnedResidual(robot, surroundings, random_ensemble(3, [[0, 1], list(range(width))], 2), share=0.37)
    return ExtendedDynamics(base, mechanisms(**extended_by), surroundings, residual).eval()


def situation_of(robot, seed=3):
    drive = drive_of(robot, np.random.default_rng(seed))
    parts = ("command", "previous_command", "earlier_command", "pose", "elapsed_s", "duration_s", "neighbours")
    return Situation(**{part: getattr(drive, part).float() for part in parts})


@pytest.mark.parametrize("robot", ["mgr", "mur"])
def test_a_model_comes_back_from_its_folder_bit_by_bit(robots, tmp_path, robot):
    model = learned(robots[robot])
    save_dynamics(tmp_path, model, {})
    back = load_dynamics(tmp_path)
    situation = situation_of(robots[robot])
    with torch.inference_mode():
        assert torch.equal(back(situation), model(situation))
    assert back.parts == model.parts
    assert back.mechanisms == model.mechanisms
    assert back.config == model.config


def test_everything_in_the_folder_counts(robots):
    """The base, each mechanism and the learned residual all say something: leaving one out changes the answer."""
    robot = robots["mgr"]
    situation = situation_of(robot)
    model = learned(robot)
    whole = model(situation)
    for name in SMOOTH:
        fewer = {other: values for other, values in SMOOTH.items() if other != name}
        assert (learned(robot, fewer)(situation) - whole).abs().max() > 0.05, name
    alone = ExtendedDynamics(model.base, model.mechanisms, model.surroundings)
    assert (alone(situation) - whole).abs().max() > 0.05


def test_every_mechanism_comes_back(robots, tmp_path):
    robot = robots["mgr"]
    everything = {}
    for name in mechanism_names():
        kind = mechanism_class(name)
        read = kind.observed(np.array([0.45, 0.55]), 0.5) or {}
        everything[name] = {**kind.starts(robot, surroundings_of(robot))[0], **read}
    model = learned(robot, everything)
    save_dynamics(tmp_path, model, {})
    situation = situation_of(robot)
    back = load_dynamics(tmp_path)
    assert torch.equal(back(situation), model(situation))
    assert {one.name for one in back.mechanisms} == set(mechanism_names())


def cut(folder):
    weights = folder / "weights.safetensors"
    weights.write_bytes(weights.read_bytes()[:-100])


def without_weights(folder):
    (folder / "weights.safetensors").unlink()


def changed(**content):
    def change(folder):
        path = folder / "model.yaml"
        description = yaml.safe_load(path.read_text())
        description["model"].update(content)
        path.write_text(yaml.safe_dump(description))

    return change


def with_weights_of_another(folder):
    robot = load_dynamics(folder).robot
    surroundings = surroundings_of(robot)
    small = LearnedBase(robot, ("command",), surroundings, random_ensemble(2, [[0], [0, 1]], 5))
    other = ExtendedDynamics(small, [], surroundings)
    aside = folder / "other"
    aside.mkdir()
    save_dynamics(aside, other, {})
    (aside / "weights.safetensors").replace(folder / "weights.safetensors")


def not_finite(folder):
    model = load_dynamics(folder)
    model.base.ensemble.scale[0] = torch.nan
    save_dynamics(folder, model, {})


@pytest.mark.parametrize(
    ("tamper", "said"),
    [
        (cut, "weights.safetensors is damaged"),
        (without_weights, "weights.safetensors is missing"),
        (not_finite, "is not finite"),
        (with_weights_of_another, "does not belong to"),
        (changed(mechanisms=[{"name": "gain_chance", "gain": 1.0}]), "gain_change"),
        (changed(mechanisms=[{"name": "gain_change"}]), "gain"),
        (changed(base={"kind": "pickled"}), "pickled"),
        (changed(base={"kind": "learned"}), "does not belong to"),
        (changed(strange=1), "strange"),
    ],
)
def test_a_damaged_folder_is_one_clear_error(robots, tmp_path, tamper, said):
    save_dynamics(tmp_path, learned(robots["mgr"]), {})
    tamper(tmp_path)
    with pytest.raises(UserError, match=said):
        load_dynamics(tmp_path)


def test_it_answers_as_its_parts_do(robots):
    robot = robots["mgr"]
    drive = drive_of(robot, np.random.default_rng(4))
    base, chosen = ExactBase(robot), mechanisms(**SMOOTH)
    answer = ExtendedDynamics(base, chosen, drive.surroundings)(situation_of(robot, 4))
    torch.testing.assert_close(answer.double(), likeliest_displacement(base, chosen, drive), rtol=1e-4, atol=1e-3)


def test_what_nobody_knows_is_rest_and_nominal(robots):
    robot = robots["mgr"]
    model = ExtendedDynamics(ExactBase(robot), mechanisms(command_delay={"delay_s": 0.1}), surroundings_of(robot))
    command = torch.tensor([[60.0, 60.0]])
    unknown = model(Situation(command=command, previous_command=torch.full((1, 2), torch.nan)))
    rest = model(Situation(command=command, previous_command=torch.zeros(1, 2)))
    torch.testing.assert_close(unknown, rest)
    torch.testing.assert_close(unknown, torch.tensor([[0.8 * 0.35 * 60, 0.0, 0.0]]))


def test_in_a_world_a_period_of_delay_moves_a_period_late(robots):
    robot = robots["mgr"]
    late = mechanisms(command_delay={"delay_s": robot.period_s})
    worlds = [
        SimulatedMotion(ExtendedDynamics(ExactBase(robot), chosen, surroundings_of(robot)), worlds=3, vehicles=2)
        for chosen in ([], late)
    ]
    rng = np.random.default_rng(5)
    start = np.concatenate([rng.uniform(300, 700, (3, 2, 2)), rng.uniform(-3, 3, (3, 2, 1))], axis=2)
    for world in worlds:
        world.place(np.arange(3), start)
    commands = rng.uniform(robot.command_low, robot.command_high, (12, 3, 2, 2))
    prompt = [start, *(worlds[0].move(command) for command in commands)]
    delayed = [worlds[1].move(command) for command in commands]
    np.testing.assert_allclose(delayed, prompt[:-1], atol=1e-3)
    assert np.abs(np.array(delayed) - np.array(prompt[1:])).max() > 5


def test_a_learned_extension_moves_a_world_and_looks_at_everything(robots):
    robot = robots["mgr"]
    rng = np.random.default_rng(6)
    start = np.concatenate([rng.uniform(400, 600, (2, 3, 2)), rng.uniform(-3, 3, (2, 3, 1))], axis=2)
    world = SimulatedMotion(learned(robot), worlds=2, vehicles=3)
    world.place(np.arange(2), start)
    for _ in range(8):
        pose = world.move(rng.uniform(robot.command_low, robot.command_high, (2, 3, 2)))
    assert np.isfinite(pose).all()
    assert set(world._dynamics.parts) >= {"neighbours", "elapsed_s", "pose", "previous_command"}


def test_open_loop_is_exact_with_what_happened_and_wrong_without(robots):
    """Runs of a robot that is a third of a period late, and drifts."""
    robot = robots["mgr"]
    base, surroundings = ExactBase(robot), surroundings_of(robot)
    tracks = []
    for track in made_drive(robot, runs=3, steps=15, vehicles=("1",), seed=7):
        command = torch.as_tensor(track.command)
        poses = [torch.as_tensor(track.pose[0])]
        before = torch.zeros(2, dtype=torch.float64)
        for now in command[:-1]:
            ways = [base.way(one[None], one[None], None)[0] for one in (before, now)]
            end = compose(compose(poses[-1], displacement_of(ways[0] / 3)), displacement_of(ways[1] * 2 / 3))
            poses.append(end + torch.tensor([1.5, -1.0, 0.0], dtype=torch.float64))
            before = now
        tracks.append(replace(track, pose=torch.stack(poses).numpy()))
    happened = mechanisms(command_delay={"delay_s": robot.period_s / 3}, steady_drift={"x_mm_s": 3.0, "y_mm_s": -2.0})
    with_it, without = (
        [run.rmse_mm for run in open_loop(ExtendedDynamics(base, chosen, surroundings), tracks)]
        for chosen in (happened, [])
    )
    assert max(with_it) < 0.01
    assert min(without) > 10


def test_looking_at_no_more_than_it_needs(robots):
    robot = robots["mgr"]
    surroundings = surroundings_of(robot)
    needed = {
        (): ("command",),
        ("gain_change",): ("command",),
        ("battery_sag",): ("command", "elapsed_s"),
        ("command_delay",): ("command", "previous_command"),
        ("marker_yaw",): ("command", "pose"),
    }
    values = {**SMOOTH, "gain_change": {"gain": 1.1}}
    for names, parts in needed.items():
        chosen = mechanisms(**{name: values[name] for name in names})
        assert ExtendedDynamics(ExactBase(robot), chosen, surroundings).parts == parts
