"""`swarmtwin learn`: a policy is learned in a simulation, kept whole, tracked and registered."""

import json
import signal
import subprocess
import time

import av
import mlflow
import pandas as pd
import pytest
import yaml

from swarmtwin.diagnosis.result import Cause, DiagnosisResult, Estimate, Gain, Gains
from swarmtwin.policies.policy_folder import load_policy, save_policy
from swarmtwin.tracking import registry
from swarmtwin.tracking.store import use_store
from tiny_policies import provenance, seeker, task_named

TASK = ("task=obstacle", "task.steps=40", "task.reach_mm=300", "task.distance_mm=360", "task.radius_mm=[5,10]")
SMALL = ("policy.layers=[16]", "policy.worlds=4", "policy.steps=150", "policy.random_steps=20", "policy.batch_size=64")
WITH_PICTURES = ("learn", "simulation=mlp", *TASK, *SMALL, "evaluate_every=50", "scenes=60", "final_scenes=100")
QUICK = (*WITH_PICTURES, "pictures=false")
FILES = [
    "history.csv",
    "history.png",
    "metrics.json",
    "policy.onnx",
    "policy.yaml",
    "provenance.json",
    "rollout.mp4",
    "rollouts.npz",
    "weights.safetensors",
]


@pytest.fixture
def still_challenger(workshop, robots):
    """Make a policy that stays where it is the challenger."""
    robot, folder = robots["mgr"], workshop / "still"
    task = task_named("obstacle", steps=40, reach_mm=300, distance_mm=360, radius_mm=[5, 10])
    folder.mkdir()
    save_policy(folder, seeker(robot, task, speed=0.0), task, robot.arena_mm, provenance())
    version = registry.register("mgr-policy", folder, folder.as_uri(), None, {"task": "obstacle"})
    registry.challenge(version, None)


def runs():
    use_store()
    return mlflow.search_runs(experiment_names=["swarmtwin/policy"], output_format="list")


@pytest.mark.usefixtures("still_challenger")
def test_a_policy_is_learned_kept_tracked_and_registered(swarmtwin, model, workshop):
    model("mlp")
    answer = swarmtwin(*WITH_PICTURES, "seeds=2", "output=out")
    assert answer.status == 0, answer.error
    assert sorted(path.name for path in (workshop / "out").iterdir()) == FILES
    policy = load_policy(workshop / "out")
    assert policy.task.name == "obstacle"
    assert policy.provenance.simulation.model_dump() == {
        "source": "mlp",
        "model": "mlp",
        "digest": registry.folder_digest(workshop / "mlp"),
        "recording": "reference",
        "origin": "real",
    }
    history = pd.read_csv(workshop / "out" / "history.csv")
    assert history.groupby("seed").step.agg(list).tolist() == [[50, 100, 150]] * 2
    metrics = json.loads((workshop / "out" / "metrics.json").read_text())
    finals = {int(seed): best for seed, best in metrics["seeds"].items()}
    best = finals[policy.provenance.seed]
    assert best == metrics["evaluation"]
    assert best["success"] == max(final["success"] for final in finals.values())
    test = metrics["test"]
    assert test["rollouts"] == 100
    assert test["success"]["low"] < best["success"] < test["success"]["high"] + 0.1
    assert f"the policy in 100 new scenarios: success {100 * test['success']['value']:.1f} % (" in answer.shown
    version = registry.find_version("models:/mgr-policy@challenger")
    assert version.tags["task"] == "obstacle"
    assert float(version.tags["success"]) == pytest.approx(best["success"], abs=1e-3)
    assert "registered as mgr-policy version 2, its challenger in place of version 1: success +" in answer.shown
    (run,) = runs()
    assert run.data.metrics["evaluation_success"] == pytest.approx(best["success"], abs=1e-5)
    tracked = mlflow.MlflowClient().get_metric_history(run.info.run_id, f"seed_{policy.provenance.seed}_success")
    mine = history[history.seed == policy.provenance.seed]
    assert [metric.step for metric in tracked] == mine.step.tolist()
    assert [metric.value for metric in tracked] == pytest.approx(mine.success.tolist(), abs=1e-5)
    kept = {file.path for file in mlflow.MlflowClient().list_artifacts(run.info.run_id, "figures")}
    assert kept == {"figures/history.png", "figures/rollout.mp4"}
    with av.open(str(workshop / "out" / "rollout.mp4")) as film:
        assert film.streams.video[0].frames > 40
    assert run.data.params["policy.name"] == "ddpg"
    assert load_policy(version.folder()).provenance == policy.provenance


def test_learning_goes_on_from_a_policy(swarmtwin, model, workshop):
    """It is the first that is evaluated, with what it reached where it was learned, and may be kept as the best."""
    model("mlp")
    once = (*QUICK, "register=false", "seeds=1")
    assert swarmtwin(*once, "output=first").status == 0
    answer = swarmtwin(*once, "start_from=first", "seed=5", "policy.critic_updates=50", "output=second")
    assert answer.status == 0, answer.error
    first, second = (pd.read_csv(workshop / name / "history.csv").set_index("step") for name in ("first", "second"))
    assert second.index.tolist() == [0, 50, 100, 150]
    begun = load_policy(workshop / "first").provenance.evaluation.step
    assert second.loc[0, "success"] == first.loc[begun, "success"]
    assert second.loc[0, "reward"] == first.loc[begun, "reward"]
    started_from = load_policy(workshop / "second").provenance.started_from
    assert started_from.source == "first"
    assert swarmtwin(*once, "start_from=first", "overwrite=true", "output=first").status == 2
    assert load_policy(workshop / "first").provenance.started_from is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["start_from=nowhere"], "no model folder nowhere: give a folder, models:/NAME@ALIAS or models:/NAME/VERS"),
        (
            ["start_from=still", "policy.layers=[8]"],
            "start_from=still: its network is another than that of policy=ddpg",
        ),
        (["start_from=still", "task.sees_commands=1"], "start_from=still: that policy, of task 'obstacle', looks at"),
    ],
)
def test_learning_goes_on_from_no_policy_that_does_not_fit(
    swarmtwin, model, still_challenger, workshop, options, message
):
    model("mlp")
    answer = swarmtwin(*QUICK, *options, "output=out")
    assert answer.status == 2
    assert answer.error.startswith(f"swarmtwin learn: {message}")
    assert len(answer.error.strip().splitlines()) == 1
    assert not (workshop / "out").exists()


@pytest.mark.end_to_end
def test_a_sweep_learns_with_each_algorithm(swarmtwin, model, workshop):
    model("mlp")
    answer = swarmtwin(
        *("learn", "-m", "policy=ddpg,td3", "simulation=mlp", *TASK, *SMALL, "evaluate_every=50", "scenes=60"),
        "final_scenes=60",
        *("seeds=1", "output=out_${policy.name}"),
    )
    assert answer.status == 0, answer.error
    better = "mgr-policy version 2, its challenger in place of version 1: success " in answer.shown
    not_better = "mgr-policy version 2; version 1 stays challenger: success " in answer.shown
    assert better != not_better
    assert registry.holder("mgr-policy", "challenger", "obstacle").number == 1 + better
    for name in ("ddpg", "td3"):
        content = yaml.safe_load((workshop / f"out_{name}" / "policy.yaml").read_text())
        assert content["provenance"]["algorithm"]["name"] == name
    children = [run for run in runs() if run.data.tags.get("kind") != "sweep"]
    assert len({run.data.tags["mlflow.parentRunId"] for run in children}) == 1


@pytest.mark.end_to_end
def test_an_interrupted_command_goes_on_to_the_same_policy(swarmtwin, program, model, workshop):
    model("mlp")
    options = (*QUICK, "policy.steps=150", "seeds=1", "register=false")
    process = subprocess.Popen([program, *options, "output=out"], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    checkpoint = workshop / ".out.partial" / "checkpoints" / "seed-1.ckpt"
    for _ in range(2400):
        if checkpoint.exists() or process.poll() is not None:
            break
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=60)
    assert process.returncode == 130
    assert checkpoint.exists()
    assert not (workshop / "out").exists()
    assert swarmtwin(*options, "output=out").status == 0
    assert swarmtwin(*options, "output=whole").status == 0
    for name in ("weights.safetensors", "policy.onnx", "history.csv"):
        assert (workshop / "out" / name).read_bytes() == (workshop / "whole" / name).read_bytes()
    assert not (workshop / "out" / "checkpoints").exists()


@pytest.mark.parametrize(
    ("options", "status", "message"),
    [
        (
            ["simulation=null"],
            2,
            "no simulation in artifacts/dynamics/mgr/crnet_synthetic: run `dvc repro` first, or give simulation=...",
        ),
        (["simulation=mlp", "robot=mur", "task=pair"], 2, "mlp is a model of robot 'mgr': add robot=mgr"),
        (["simulation=nowhere"], 2, "no model folder nowhere: give a folder, models:/NAME@ALIAS or models:/NAME/VERS"),
        (["simulation=mlp", "policy=ddgp"], 2, "no such policy: 'ddgp': did you mean 'ddpg'? known: ddpg, ppo, sac"),
        (["simulation=mlp", "task=obstacles"], 2, "no such task: 'obstacles': did you mean 'obstacle'?"),
        (["simulation=mlp", "policy.gama=1"], 2, "unknown option 'policy.gama': did you mean 'policy.gamma'?"),
        (["simulation=mlp", "policy.gamma=1"], 2, "policy: field 'gamma': Input should be less than 1, got 1"),
        (
            ["simulation=mlp", "task=collective", "task.vehicles=1"],
            2,
            "task: field 'vehicles': Input should be greater",
        ),
        (["simulation=mlp", "task=collective", "task.vehicles=100"], 2, "task 'collective': 100 vehicles"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_nothing(swarmtwin, model, workshop, options, status, message):
    model("mlp")
    answer = swarmtwin("learn", *options, "output=out")
    assert answer.status == status
    assert answer.error.startswith(f"swarmtwin learn: {message}")
    assert len(answer.error.strip().splitlines()) == 1
    assert not (workshop / "out").exists()


def test_a_simulation_with_weights_that_are_not_finite_is_refused(swarmtwin, model, workshop):
    from safetensors.numpy import load_file, save_file

    path = model("mlp") / "weights.safetensors"
    weights = load_file(path)
    weights["network.0.bias"] = weights["network.0.bias"] * float("nan")
    save_file(weights, path)
    answer = swarmtwin(*QUICK, "output=out")
    assert answer.status == 2
    assert "network.0.bias is not finite" in answer.error
    assert not (workshop / "out").exists()


def test_where_every_seed_fails_nothing_is_left(swarmtwin, model, workshop):
    model("mlp")
    answer = swarmtwin(*QUICK, "policy.learning_rate=1e30", "seeds=1", "output=out")
    assert answer.status == 2
    assert "every seed has failed (seed 1: its weights were no longer finite)" in answer.error
    assert not (workshop / "out").exists()
    assert [run.info.status for run in runs()] == ["FAILED"]


def test_a_policy_is_learned_against_what_a_diagnosis_measured(swarmtwin, model, workshop):
    model("mlp")
    delay = Cause(
        name="command_delay",
        parameters={"delay_s": Estimate(value=0.2, low=0.15, high=0.25, unit="s")},
        confidence=1.0,
        rivals=(),
        share_of_gap=1.0,
        evidence="",
    )
    nothing = Gain(before=1.0, after=1.0, low=0.0, high=0.0)
    result = DiagnosisResult(
        verdict="explained",
        causes=(delay,),
        depends_on=(),
        gain=Gains(position_mm=nothing, orientation_deg=nothing, open_loop_mm=nothing),
        next_recording=None,
        left_over=(),
        tests=(),
        robot="mgr",
        vehicles=("1",),
        runs={},
        transitions={},
        extension="mechanisms",
        seed=0,
    )
    (workshop / "found").mkdir()
    (workshop / "found" / "diagnosis.json").write_text(result.model_dump_json())
    options = ("randomisation=found", "draws=2", "task.sees_commands=2", "register=false", "pictures=false")
    answer = swarmtwin(*QUICK, *options, "policy.steps=50", "seeds=1", "output=out")
    assert answer.status == 0, answer.error
    policy = load_policy(workshop / "out")
    ranges = {"name": "command_delay", "of": "world", "ranges": {"delay_s": [0.15, 0.25]}, "fixed": {}}
    assert policy.provenance.randomisation == {"mechanisms": [ranges], "draws": 2}
    assert policy.policy.observation_names[-1] == "command_2_right"
    run = runs()[0]
    assert json.loads(run.data.tags["randomisation"]) == [ranges]
    assert "diagnosis" in {tag.value for one in run.inputs.dataset_inputs for tag in one.tags}


def test_a_range_that_makes_no_sense_is_refused_before_anything_is_learned(swarmtwin, model, workshop):
    model("mlp")
    answer = swarmtwin(*QUICK, "randomisation={command_delay: {delay_s: [0.0, 3.0]}}", "output=out")
    assert answer.status == 2
    assert "randomisation.command_delay.delay_s: [0, 3] is not within 0 to 0.5 s: narrow it" in answer.error
    assert not (workshop / "out").exists()
