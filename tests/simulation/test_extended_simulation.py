"""An extended simulation is a dynamics model: it moves worlds and runs, and comes back from its folder bit by bit."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml
from safetensors.torch import load_file, save_file

from drives import drive as made_drive
from exact_model import (
    ExactDynamics,
    LaggingDynamics,
    conditions_of,
    mechanisms,
    simulation_with,
    situation_of,
)
from swarmtwin.dynamics.motion_noise import MotionNoise
from swarmtwin.errors import UserError
from swarmtwin.geometry import compose, displacement_between, exp_map
from swarmtwin.learning.ensemble import Ensemble
from swarmtwin.learning.situation import Situation
from swarmtwin.simulation.ensemble_dynamics import EnsembleDynamics, ensemble_encoding
from swarmtwin.simulation.mechanism import mechanism_class, mechanism_names
from swarmtwin.simulation.open_loop import open_loop
from swarmtwin.simulation.residual_model import ResidualModel, residual_encoding
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.simulation.simulation_folder import load_simulation, save_extended
from swarmtwin.world.motion import SimulatedMotion

SMOOTH = {
    "command_delay": {"delay_s": 0.12},
    "battery_sag": {"loss": 0.3, "shape": 1.5},
    "steady_drift": {"x_mm_s": 3.0, "y_mm_s": -2.0},
    "neighbour_interaction": {"strength_mm_s": 8.0, "reach_mm": 120.0},
    "marker_yaw": {"angle_rad": 0.1},
}
NOISE = MotionNoise(at_rest=(1, 0.5, 1e-4), with_motion=(0, 0, 0), usual_mm=20, usual_rad=0.5, camera=(0.1, 0.1, 1e-5))


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
    conditions = conditions_of(robot)
    inputs = ("command", "previous_command", "pose")
    _, groups = ensemble_encoding(robot, inputs, (60.0,), conditions)
    base = EnsembleDynamics(robot, inputs, (60.0,), conditions, random_ensemble(4, groups, 1))
    width = residual_encoding(robot, conditions).width
    residual = ResidualModel(robot, conditions, random_ensemble(3, [[0, 1], list(range(width))], 2), share=0.37)
    return Simulation(base, mechanisms(**extended_by), conditions, residual, NOISE).eval()


@pytest.mark.parametrize("robot", ["mgr", "mur"])
def test_a_model_comes_back_from_its_folder_bit_by_bit(robots, tmp_path, robot):
    model = learned(robots[robot])
    save_extended(tmp_path, model, {})
    back = load_simulation(tmp_path)
    situation = situation_of(robots[robot], np.random.default_rng(3))
    with torch.inference_mode():
        assert torch.equal(back.predict(situation), model.predict(situation))
    assert back.inputs == model.inputs
    assert back.mechanisms == model.mechanisms
    assert back.conditions == model.conditions
    assert back.motion_noise == model.motion_noise


def test_everything_in_the_folder_counts(robots):
    """The base, each mechanism and the learned residual all say something: leaving one out changes the answer."""
    robot = robots["mgr"]
    situation = situation_of(robot, np.random.default_rng(3))
    model = learned(robot)
    whole = model.predict(situation)
    for name in SMOOTH:
        fewer = {other: values for other, values in SMOOTH.items() if other != name}
        assert (learned(robot, fewer).predict(situation) - whole).abs().max() > 0.05, name
    alone = Simulation(model.dynamics, model.mechanisms, model.conditions)
    assert (alone.predict(situation) - whole).abs().max() > 0.05


def test_every_mechanism_comes_back(robots, tmp_path):
    robot = robots["mgr"]
    everything = {}
    for name in mechanism_names():
        kind = mechanism_class(name)
        read = kind.read_from_clock(np.array([0.45, 0.55]), robot) or {}
        everything[name] = {**kind.initial_points(robot, conditions_of(robot))[0], **read}
    model = learned(robot, everything)
    save_extended(tmp_path, model, {})
    situation = situation_of(robot, np.random.default_rng(3))
    back = load_simulation(tmp_path)
    assert torch.equal(back.predict(situation), model.predict(situation))
    assert {one.name for one in back.mechanisms} == set(mechanism_names())


@pytest.mark.parametrize("values", [{"gain_change": {"gain": 0.7}}, {"battery_sag": {"loss": 0.3, "shape": 1.5}}])
def test_the_form_of_a_mechanism_comes_back(robots, tmp_path, values):
    ((name, own),) = values.items()
    robot = robots["mur"]
    situation = situation_of(robot, np.random.default_rng(3))
    predicted = []
    for acts_on in ("speed", "effort"):
        model = learned(robot, {name: {**own, "acts_on": acts_on}})
        save_extended(tmp_path, model, {})
        back = load_simulation(tmp_path)
        predicted.append(back.predict(situation))
        assert torch.equal(predicted[-1], model.predict(situation))
    assert (predicted[0] - predicted[1]).abs().max() > 0.5


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
    robot = load_simulation(folder).robot
    conditions = conditions_of(robot)
    small = EnsembleDynamics(robot, ("command",), (), conditions, random_ensemble(2, [[0], [0, 1]], 5))
    other = Simulation(small, [], conditions)
    aside = folder / "other"
    aside.mkdir()
    save_extended(aside, other, {})
    (aside / "weights.safetensors").replace(folder / "weights.safetensors")


def not_finite(folder):
    model = load_simulation(folder)
    model.dynamics.ensemble.scale[0] = torch.nan
    save_extended(folder, model, {})


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
    save_extended(tmp_path, learned(robots["mgr"]), {})
    tamper(tmp_path)
    with pytest.raises(UserError, match=said):
        load_simulation(tmp_path)


def test_a_folder_of_an_earlier_version_still_loads(robots, tmp_path):
    """It named no spread, and kept a scaling and settings that nobody read."""
    model = learned(robots["mgr"])
    save_extended(tmp_path, model, {})
    path = tmp_path / "model.yaml"
    description = yaml.safe_load(path.read_text())
    del description["model"]["motion_noise"]
    for unknown in ("own_lags", "gear_friction_mm_s", "effort_exponents"):
        description["model"]["surroundings"].pop(unknown)
    description["model"] |= {"learning_rate": 1.0, "steps": 1}
    path.write_text(yaml.safe_dump(description))
    trained = load_file(tmp_path / "weights.safetensors") | {"encoding.scaling.offset": torch.zeros(4)}
    save_file(trained, tmp_path / "weights.safetensors")
    situation = situation_of(robots["mgr"], np.random.default_rng(3))
    torch.testing.assert_close(load_simulation(tmp_path).predict(situation), model.predict(situation))


@pytest.mark.parametrize("dynamics", [ExactDynamics, LaggingDynamics])
@pytest.mark.parametrize(("robot", "friction_mm_s"), [("mgr", 0.0), ("mgr", 8.0), ("mur", 0.0)])
def test_one_step_from_a_measured_situation_is_a_step_of_the_state(robots, robot, friction_mm_s, dynamics):
    """With memory carried through the commands before, from the same pose."""
    robot = robots[robot]
    travel = {"travel_mm": 3.0} if robot.actuation.kind == "wheel" else {"travel_rad": 0.1}
    chosen = {"command_delay": {"delay_s": 0.1}, "actuator_lag": {"time_constant_s": 0.06}, "backlash": travel}
    shown = conditions_of(robot, own_lags=(0.1,) * 3, gear_friction_mm_s=friction_mm_s)
    simulation = simulation_with(robot, dynamics(robot), shown, **chosen)
    situation = situation_of(robot, np.random.default_rng(4))
    state = simulation.start(situation.pose[:, None])
    for command in (situation.earlier_command,) * 12 + (situation.previous_command,):
        state = simulation.step(state, command[:, None])
    moved = simulation.step(replace(state, pose=situation.pose[:, None]), situation.command[:, None])
    expected = displacement_between(situation.pose, moved.pose[:, 0])
    torch.testing.assert_close(simulation.predict(situation), expected, rtol=0, atol=1e-3)


def test_a_null_mechanism_leaves_the_learned_transient_as_it_is(robots):
    robot = robots["mgr"]
    situation = situation_of(robot, np.random.default_rng(4))
    alone = LaggingDynamics(robot).predict(situation)
    for chosen in ({"actuator_lag": {"time_constant_s": 1e-9}}, {"command_delay": {"delay_s": 1e-9}}):
        simulation = simulation_with(robot, LaggingDynamics(robot), conditions_of(robot, own_lags=(0.2,) * 3), **chosen)
        torch.testing.assert_close(simulation.predict(situation), alone, rtol=0, atol=1e-5)


def test_what_nobody_knows_is_rest_and_nominal(robots):
    robot = robots["mgr"]
    model = simulation_with(robot, command_delay={"delay_s": 0.1})
    command = torch.tensor([[60.0, 60.0]])
    unknown = model.predict(Situation(command=command, previous_command=torch.full((1, 2), torch.nan)))
    rest = model.predict(Situation(command=command, previous_command=torch.zeros(1, 2)))
    torch.testing.assert_close(unknown, rest)
    torch.testing.assert_close(unknown, torch.tensor([[0.8 * 0.35 * 60, 0.0, 0.0]], dtype=torch.float64))


def test_in_a_world_a_period_of_delay_moves_a_period_late(robots):
    robot = robots["mgr"]
    late = {"command_delay": {"delay_s": robot.period_s}}
    worlds = [SimulatedMotion(simulation_with(robot, **chosen), worlds=3, vehicles=2) for chosen in ({}, late)]
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
    assert set(world.simulation.inputs) >= {"neighbours", "elapsed_s", "pose", "previous_command"}


def test_open_loop_is_exact_with_what_happened_and_wrong_without(robots):
    """Runs of a robot that is a third of a period late, and drifts."""
    robot = robots["mgr"]
    base = ExactDynamics(robot)
    tracks = []
    for track in made_drive(robot, runs=3, steps=15, vehicles=("1",), seed=7):
        command = torch.as_tensor(track.command)
        poses = [torch.as_tensor(track.pose[0])]
        before = torch.zeros(2, dtype=torch.float64)
        for now in command[:-1]:
            ways = [base.twist(one[None])[0] for one in (before, now)]
            end = compose(compose(poses[-1], exp_map(ways[0] / 3)), exp_map(ways[1] * 2 / 3))
            poses.append(end + torch.tensor([1.5, -1.0, 0.0], dtype=torch.float64))
            before = now
        tracks.append(replace(track, pose=torch.stack(poses).numpy()))
    happened = {"command_delay": {"delay_s": robot.period_s / 3}, "steady_drift": {"x_mm_s": 3.0, "y_mm_s": -2.0}}
    with_it, without = (
        [run.rmse_mm for run in open_loop(simulation_with(robot, **chosen), tracks)] for chosen in (happened, {})
    )
    assert max(with_it) < 0.01
    assert min(without) > 10


def test_looking_at_no_more_than_it_needs(robots):
    robot = robots["mgr"]
    needed = {
        (): ("command",),
        ("gain_change",): ("command",),
        ("battery_sag",): ("command", "elapsed_s"),
        ("command_delay",): ("command", "previous_command", "earlier_command"),  # whose transients may go on
        ("marker_yaw",): ("command", "pose"),
    }
    values = {**SMOOTH, "gain_change": {"gain": 1.1}}
    for names, parts in needed.items():
        chosen = {name: values[name] for name in names}
        assert simulation_with(robot, **chosen).inputs == parts
