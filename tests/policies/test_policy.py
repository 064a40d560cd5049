"""Policies by themselves: extraction, limits, their folder, ONNX."""

import copy
import shutil

import numpy as np
import onnxruntime
import pytest
import torch
import yaml
from safetensors.torch import save_file

from swarmtwin.errors import UserError
from swarmtwin.policies.onnx_export import check_equal, onnx_model
from swarmtwin.policies.policy import Architecture, Policy
from swarmtwin.policies.policy_folder import TaskChanges, load_policy, save_policy
from swarmtwin.policies.pyfunc import serve
from swarmtwin.policies.training import Learner
from swarmtwin.robot import Arena
from tiny_policies import (
    ALGORITHMS,
    ARCHITECTURE,
    policy_job,
    provenance,
    robot_named,
    save_seeker,
    simulation,
    small,
    task_named,
)

TASK = task_named("collective")


@pytest.fixture
def policy(written):
    """A policy of the same weights."""
    return copy.deepcopy(written[0])


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A policy and its folder, not to be changed."""
    robot, folder = robot_named("mgr"), tmp_path_factory.mktemp("policy")
    torch.manual_seed(0)
    policy = Policy(robot, TASK.build(robot).observation_names, ARCHITECTURE).eval()
    save_policy(folder, policy, TASK, robot.arena_mm, provenance())
    return policy, folder


@pytest.fixture
def saved(written, tmp_path):
    """A copy of the folder."""
    return shutil.copytree(written[1], tmp_path / "policy")


def observations(count=200, size=25, seed=0):
    return np.random.default_rng(seed).normal(0, 2, (count, size)).astype(np.float32)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_policy_commands_what_its_algorithm_would(tmp_path, name):
    folder = simulation(tmp_path / "simulation", robot_named("mgr"))
    learner = Learner(policy_job(folder, algorithm=small(name)))
    learner.algorithm.learn(learner.job.algorithm.steps * learner.env.num_envs)
    seen = observations(size=len(learner.task.observation_names))
    action, _ = learner.algorithm.predict(seen, deterministic=True)
    robot = learner.job.robot
    expected = robot.command_low + (robot.command_high - robot.command_low) * (action + 1) / 2
    np.testing.assert_allclose(learner.policy.act(seen[None])[0], expected, rtol=1e-5, atol=1e-3)
    assert np.abs(action).max() > 0


@pytest.mark.parametrize("squashing", ["tanh", "clip"])
@pytest.mark.parametrize("name", ["mgr", "mur"])
def test_commands_stay_within_the_robots_limits_whatever_is_seen(name, squashing):
    robot = robot_named(name)
    architecture = Architecture(layers=(8,), activation="tanh", squashing=squashing)
    policy = Policy(robot, tuple("abc"), architecture)
    with torch.no_grad():
        policy.network[-1].weight.mul_(1e3)
    command = policy.act(1e6 * observations(500, 3)[None])
    assert (command >= robot.command_low).all()
    assert (command <= robot.command_high).all()
    assert (command == robot.command_high).any()


def test_outputs_of_minus_one_and_one_are_the_limits():
    robot = robot_named("mur")
    policy = Policy(robot, ("a",), Architecture(layers=(4,), activation="relu", squashing="clip"))
    middle = (robot.command_low + robot.command_high) / 2
    for sign, limit in ((-1, robot.command_low), (0, middle), (1, robot.command_high)):
        with torch.no_grad():
            policy.network[-1].weight.zero_()
            policy.network[-1].bias.fill_(sign)
        np.testing.assert_allclose(policy.act(np.zeros((1, 1, 1)))[0, 0], limit, rtol=1e-6, atol=1e-5)


def test_each_vehicle_decides_alone_and_all_alike(policy):
    seen = observations(12).reshape(3, 4, 25)
    together = policy.act(seen)
    alone = np.stack([[policy.act(seen[w, k][None, None])[0, 0] for k in range(4)] for w in range(3)])
    np.testing.assert_allclose(together, alone, rtol=1e-5, atol=1e-3)


def test_a_command_that_is_not_finite_is_an_error(policy):
    seen = observations(4)[None]
    seen[0, 2, 1] = np.nan
    with pytest.raises(UserError, match="the policy of 'mgr' gives a command that is not finite: train it anew"):
        policy.act(seen)


def test_observations_of_another_size_are_a_programming_error(policy):
    with pytest.raises(ValueError, match="observations of 3 numbers, the policy looks at 25"):
        policy.act(np.zeros((1, 1, 3)))


def test_a_policy_saved_and_loaded_commands_the_same_bit_for_bit(policy, saved):
    loaded = load_policy(saved)
    seen = observations()[None]
    assert np.array_equal(loaded.policy.act(seen), policy.act(seen))
    assert (loaded.robot, loaded.task, loaded.provenance) == (policy.robot, TASK, provenance())
    assert sorted(path.name for path in saved.iterdir()) == ["policy.onnx", "policy.yaml", "weights.safetensors"]


def test_the_description_can_be_read_by_people(saved):
    content = yaml.safe_load((saved / "policy.yaml").read_text())
    assert content["format"] == 1
    assert content["task"]["vehicles"] == 5
    assert content["observation"][:2] == ["target_forward", "target_left"]
    assert content["architecture"] == {"layers": [16, 16], "activation": "relu", "squashing": "tanh"}
    assert content["command"]["left"] == {"low": -120.0, "high": 120.0, "unit": "PWM"}
    assert content["provenance"]["simulation"]["origin"] == "real"


@pytest.mark.parametrize("architecture", [ARCHITECTURE, Architecture(layers=(8,), activation="tanh", squashing="clip")])
def test_onnx_commands_the_same_for_any_number_of_vehicles(architecture):
    policy = Policy(robot_named("mur"), tuple("abcdef"), architecture).eval()
    session = onnxruntime.InferenceSession(onnx_model(policy).SerializeToString())
    span = policy.robot.command_high - policy.robot.command_low
    for vehicles in (1, 5, 64):
        observed = observations(vehicles, 6)
        (command,) = session.run(None, {"observation": observed})
        assert np.max(np.abs(command - policy.act(observed[None])[0]) / span) < 1e-5


def test_onnx_tells_nothing_of_the_machine_that_made_it(policy):
    content = onnx_model(policy).SerializeToString()
    assert b"swarmtwin" not in content
    assert b"site-packages" not in content


def test_onnx_that_commands_something_else_is_not_written(policy):
    content = onnx_model(policy).SerializeToString()
    with torch.no_grad():
        policy.network[0].weight.mul_(1.01)
    with pytest.raises(UserError, match="computes other commands as ONNX"):
        check_equal(content, policy)
    assert onnx_model(policy).SerializeToString() == onnx_model(policy).SerializeToString()


def test_large_weights_round_more_and_are_written_all_the_same():
    torch.manual_seed(0)
    architecture = Architecture(layers=(128, 128), activation="relu", squashing="tanh")
    policy = Policy(robot_named("mur"), tuple("abcdef"), architecture).eval()
    with torch.no_grad():
        for layer in policy.network:
            if isinstance(layer, torch.nn.Linear):
                layer.weight.mul_(20)
    check_equal(onnx_model(policy).SerializeToString(), policy)
    content = onnx_model(policy).SerializeToString()
    with torch.no_grad():
        policy.network[0].weight.mul_(1.001)
    with pytest.raises(UserError, match="computes other commands as ONNX"):
        check_equal(content, policy)


def change(folder, **changes):
    path = folder / "policy.yaml"
    path.write_text(yaml.safe_dump({**yaml.safe_load(path.read_text()), **changes}))


def refusal(folder, robot=None):
    with pytest.raises(UserError) as error:
        load_policy(folder, robot)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_a_folder_without_a_policy_is_refused(tmp_path):
    assert refusal(tmp_path) == f"no policy in {tmp_path}: policy.yaml is missing; name a folder that learn made"


def test_another_format_is_refused(saved):
    change(saved, format=2)
    assert refusal(saved) == f"{saved}/policy.yaml: format 2 is not known here: update swarmtwin, or learn anew"


@pytest.mark.parametrize("length", [0, 100, -50])
def test_damaged_weights_are_refused(saved, length):
    path = saved / "weights.safetensors"
    path.write_bytes(path.read_bytes()[:length])
    assert refusal(saved).startswith(f"{path} is damaged (")


def test_a_damaged_description_is_refused(saved):
    (saved / "policy.yaml").write_text("format: [1")
    assert refusal(saved).startswith(f"{saved}/policy.yaml is damaged: ")


def test_weights_of_another_architecture_are_refused(saved):
    change(saved, architecture={"layers": [8, 8], "activation": "relu", "squashing": "tanh"})
    expected = f"{saved}/weights.safetensors does not belong to policy.yaml beside it: learn the policy anew"
    assert refusal(saved) == expected


def test_weights_that_are_not_finite_are_refused(policy, saved):
    weights = policy.state_dict()
    weights["network.0.bias"] = torch.full((16,), torch.nan)
    save_file(weights, saved / "weights.safetensors")
    assert "network.0.bias is not finite" in refusal(saved)


def test_a_policy_is_for_the_arena_that_it_learned_in(policy, saved):
    assert load_policy(saved).build_task().arena == policy.robot.arena_mm
    change(saved, arena_mm={"x": [0, 3000], "y": [-500, 2000]})
    assert load_policy(saved).build_task().arena == Arena(x=(0, 3000), y=(-500, 2000))
    content = yaml.safe_load((saved / "policy.yaml").read_text())
    del content["arena_mm"]
    (saved / "policy.yaml").write_text(yaml.safe_dump(content))
    assert load_policy(saved).build_task().arena == policy.robot.arena_mm


def test_a_policy_of_another_robot_is_refused(saved):
    assert refusal(saved, robot_named("mur")) == f"{saved} is a policy of robot 'mgr': add robot=mgr"


def test_a_task_that_shows_something_else_than_the_policy_looks_at_is_refused(saved):
    content = yaml.safe_load((saved / "policy.yaml").read_text())
    change(saved, task={**content["task"], "vehicles": 3})
    assert refusal(saved) == (
        f"{saved}/policy.yaml: the policy looks at 25 numbers that are not the 15 that its task 'collective' shows: "
        "learn the policy anew"
    )


def test_a_policy_that_sees_past_commands_is_served_with_them_by_name(tmp_path):
    folder = save_seeker(tmp_path / "seeker", sees_commands=2)
    served = serve(folder)
    assert served.required[-4:] == ("command_1_left", "command_1_right", "command_2_left", "command_2_right")
    assert (served.example[list(served.required[-4:])] == 0).all(axis=None)
    assert served.predict(served.example).shape == (2, 2)


def test_a_policy_is_not_shown_another_number_of_past_commands(tmp_path):
    stored = load_policy(save_seeker(tmp_path / "seeker", sees_commands=2))
    with pytest.raises(UserError, match=r"last 2 commands, and is to be shown 0: .* task\.sees_commands=0"):
        stored.in_changed_task(TaskChanges(changes={"sees_commands": 0}))
