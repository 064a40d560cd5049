"""Policies to learn in seconds: a robot whose motion is its kinematic model, untrained, and small networks."""

import functools
import shutil
import tempfile
from pathlib import Path

import torch
import yaml

from swarmtwin.dynamics.model_config import config_class
from swarmtwin.dynamics.model_folder import save_dynamics
from swarmtwin.dynamics.predictor import NetworkDynamics
from swarmtwin.policies.algorithm import algorithm_config, algorithm_names
from swarmtwin.policies.policy import Architecture, Policy
from swarmtwin.policies.policy_folder import PolicyProvenance, SeedOutcome, SimulationOrigin, save_policy
from swarmtwin.policies.rollout_comparison import Evaluation
from swarmtwin.policies.schedule import Schedule
from swarmtwin.policies.training import PolicyJob
from swarmtwin.robot import Robot
from swarmtwin.world.task import task_config

CONF = Path(__file__).resolve().parents[1] / "conf"
ALGORITHMS = algorithm_names()
SMALL = {"layers": [32, 32], "worlds": 4, "batch_size": 64}
SMALL_OF = {"ppo": {"collected_steps": 16, "steps": 80, "epochs": 2}}
ARCHITECTURE = Architecture(layers=(16, 16), activation="relu", squashing="tanh")


def robot_named(name):
    return Robot.load(CONF / "robot" / f"{name}.yaml")


def task_named(name, /, **changes):
    """A shipped task's configuration, with changes."""
    content = yaml.safe_load((CONF / "task" / f"{name}.yaml").read_text())
    return task_config({**content, **changes}, name)


def algorithm_named(name, **changes):
    """A shipped algorithm's configuration, with changes."""
    content = yaml.safe_load((CONF / "policy" / f"{name}.yaml").read_text())
    return algorithm_config({**content, **changes}, name)


def small(name, **changes):
    """An algorithm with small networks and few steps."""
    few = {"steps": 60} if name == "ppo" else {"steps": 60, "random_steps": 20, "buffer_size": 4000}
    return algorithm_named(name, **{**SMALL, **few, **SMALL_OF.get(name, {}), **changes})


def simulation(folder, robot):
    """Save the kinematic model of a robot as it is before any training: a plausible vehicle; return its folder."""
    folder.mkdir(parents=True, exist_ok=True)
    provenance = {
        "recording": "none",
        "digest": "none",
        "source": "a test",
        "vehicles": ["1"],
        "runs": {},
        "learned": [],
        "recipe": {},
        "seed": 1,
        "seeds": [{"seed": 1, "best_epoch": 1, "position_mm": 1.0, "orientation_deg": 1.0, "dead": None}],
    }
    config = config_class("kinematic")(learning_rate=0.03, steps=1, situation=("command",))
    save_dynamics(folder, NetworkDynamics(robot, config), provenance)
    return folder


def policy_job(simulation, task="obstacle", algorithm=None, seed=1, checkpoint=None, every=20, scenes=6):
    """A job of the MGR in a simulation's folder; of a task by its name, roll-outs are short."""
    algorithm = algorithm or small("ddpg")
    task = task_named(task, steps=40) if isinstance(task, str) else task
    schedule = Schedule(steps=algorithm.steps, evaluate_every=every, scenes=scenes, final_scenes=2 * scenes)
    return PolicyJob(robot_named("mgr"), task, algorithm, schedule, simulation, "digest", seed, checkpoint)


def provenance(source="nowhere", success=1.0, digest="digest"):
    """Where a policy comes from, invented."""
    best = Evaluation(step=20, success=success, reward=-1.0, collision=0.0, left_arena=0.0)
    origin = SimulationOrigin(source=str(source), model="kinematic", digest=digest, recording="none", origin="real")
    return PolicyProvenance(
        simulation=origin,
        algorithm={"name": "ddpg"},
        schedule={"steps": 20},
        seed=1,
        seeds=(SeedOutcome(seed=1, best=best, failed=None),),
    )


def seeker(robot, task, speed=1.0):
    """A policy put together by hand: turn to the target, drive until some 200 mm from it; with no speed, stay.

    Near an obstacle, where there is one, it turns right.
    """
    names = task.build(robot).observation_names
    architecture = Architecture(layers=(4,), activation="relu", squashing="clip")
    policy = Policy(robot, names, architecture).eval()
    away, aside = names.index("target_distance"), names.index("target_direction_left")
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.zero_()
        policy.network[0].weight[0, away] = 1.0
        policy.network[0].bias[0] = -0.4
        policy.network[0].weight[1, aside] = 1.0
        policy.network[0].weight[2, aside] = -1.0
        if "obstacle_1_closeness" in names:
            policy.network[0].weight[3, names.index("obstacle_1_closeness")] = 3.0
            policy.network[0].weight[3, names.index("obstacle_1_forward")] = 0.5
            policy.network[0].bias[3] = -1.5
        turn = 0.8 if speed else 0.0
        policy.network[2].weight.copy_(torch.tensor([[speed, -turn, turn, turn], [speed, turn, -turn, -turn]]))
    return policy


def save_seeker(folder, source="nowhere", speed=1.0, success=1.0, digest="digest", **changes):
    """Save a seeker for two vehicles of the MGR, or for another `task`, as `learn` would; return its folder."""
    shutil.copytree(_seeker_folder(speed, tuple(changes.items())).name, folder)
    description = yaml.safe_load((folder / "policy.yaml").read_text())
    description["provenance"] = provenance(source, success, digest).model_dump(mode="json")
    (folder / "policy.yaml").write_text(yaml.safe_dump(description, sort_keys=False))
    return folder


@functools.cache
def _seeker_folder(speed, changes):
    """A folder to copy: writing a policy takes a second."""
    changes = dict(changes)
    robot, name = robot_named("mgr"), changes.pop("task", "collective")
    task = task_named(name, **({"vehicles": 2, "steps": 100} if name == "collective" else {}), **changes)
    folder = tempfile.TemporaryDirectory()
    save_policy(Path(folder.name), seeker(robot, task, speed), task, robot.arena_mm, provenance())
    return folder
