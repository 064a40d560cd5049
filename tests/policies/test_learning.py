"""Learning: a tiny problem is solved, a broken learner does not solve it, and interruptions change no number."""

import functools
import json
import random
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from swarmtwin.errors import UserError
from swarmtwin.policies import training
from swarmtwin.policies.algorithm import algorithm_config
from swarmtwin.policies.checkpoint import read_checkpoint
from swarmtwin.policies.initial_policy import InitialPolicy
from swarmtwin.policies.policy import Policy
from swarmtwin.policies.rollout_comparison import draw_scenarios
from swarmtwin.policies.seeds import best_of, learn_all
from swarmtwin.policies.training import Learner, policy_of, roll_out_in, task_in
from swarmtwin.robot import Arena
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.mechanism import mechanism_class
from swarmtwin.simulation.randomisation import Randomisation
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.simulation.simulation_folder import load_simulation
from swarmtwin.world.tasks.obstacle import Obstacle
from tiny_policies import ALGORITHMS, algorithm_named, policy_job, robot_named, simulation, small, task_named

# Nothing in the way to speak of: steer to a target that is not far.
EASY = {
    "steps": 40,
    "reach_mm": 150,
    "distance_mm": 360,
    "radius_mm": [5, 10],
    "clearance_mm": 0,
    "near_mm": 0,
}


class KilledError(Exception):
    """Stands for a kill: nothing catches it."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return simulation(tmp_path_factory.mktemp("simulation") / "kinematic", robot_named("mgr"))


@pytest.fixture(scope="module")
def undisturbed(folder):
    """What comes of a small algorithm's training with seed 1, by the algorithm's name; each is trained once."""
    return functools.cache(lambda name: policy_job(folder, algorithm=small(name)).run(None))


@pytest.fixture(scope="module")
def finished(folder, tmp_path_factory):
    """A small training that has come to its end: what came of it, and its checkpoint, to copy."""
    checkpoint = tmp_path_factory.mktemp("finished") / "seed-1.ckpt"
    return policy_job(folder, checkpoint=checkpoint).run(None), checkpoint


def quick(**changes):
    return algorithm_named(
        "ddpg", **{"steps": 400, "layers": [64, 64], "worlds": 16, "batch_size": 128, "random_steps": 50, **changes}
    )


def same_weights(first, second):
    return all(np.array_equal(first.weights[name], second.weights[name]) for name in first.weights)


def test_a_working_learner_solves_a_tiny_problem_and_a_broken_one_does_not(folder, monkeypatch):
    tiny = policy_job(folder, task_named("obstacle", **EASY), quick(steps=600), every=100, scenes=50)
    assert tiny.run(None).best.success > 0.6
    reward = Obstacle.reward
    monkeypatch.setattr(Obstacle, "reward", lambda self, scenario, pose: -reward(self, scenario, pose))
    assert tiny.run(None).best.success < 0.3


@pytest.mark.parametrize("name", ALGORITHMS)
def test_the_same_seed_gives_the_same_policy_and_another_seed_another(folder, undisturbed, name):
    first = undisturbed(name)
    again, other = (policy_job(folder, algorithm=small(name), seed=seed).run(None) for seed in (1, 2))
    assert same_weights(first, again)
    assert first.history == again.history
    assert not same_weights(first, other)


def check_continues(job, checkpoint, whole, evaluations=1):
    """Kill a job after so many evaluations, continue it, and return what came of it: the `whole`, as undisturbed."""
    resumed, last = job._replace(checkpoint=checkpoint), whole.history[evaluations - 1].step

    def kill_after_the_evaluations(seed, done, evaluation):
        if done > last:
            raise KilledError

    with pytest.raises(KilledError):
        resumed.run(kill_after_the_evaluations)
    seen = []
    result = resumed.run(lambda seed, done, evaluation: seen.append(done))
    assert min(seen) > last
    assert result.history == whole.history
    assert same_weights(result, whole)
    return result


@pytest.mark.parametrize("name", ALGORITHMS)
def test_an_interrupted_training_continues_to_the_same_numbers(folder, undisturbed, tmp_path, name):
    job = policy_job(folder, algorithm=small(name))
    check_continues(job, tmp_path / "seed-1.ckpt", undisturbed(name), evaluations=2)


def several_starts(folder, starts, every=20, seed=1):
    job = policy_job(folder, algorithm=small("ddpg", steps=80), seed=seed, every=every)
    return job._replace(schedule=job.schedule.model_copy(update={"starts": starts, "start_steps": 40}))


def test_of_several_starts_the_one_with_the_highest_reward_goes_on(folder):
    alone = []
    for number in range(3):
        learner = Learner(several_starts(folder, 1), number)
        learner.begin()
        learner.learn_until(80, None, lambda: None)
        alone.append(learner.history)
    after_starting = [history[1].reward for history in alone]
    assert len(set(after_starting)) == 3
    chosen = several_starts(folder, 3).run(None)
    assert list(chosen.history) == alone[int(np.argmax(after_starting))]


def test_several_starts_are_reported_as_one_training(folder):
    job = several_starts(folder, 3)
    reported = []
    job.run(lambda seed, done, evaluation: reported.append(done))
    assert reported == sorted(reported)
    assert reported[-1] == job.schedule.all_steps == 160


# while the first learns, at its end, while the second learns, at the last one's end, while the one that goes on does
@pytest.mark.parametrize("evaluations", [1, 2, 3, 6, 7])
def test_an_interrupted_training_with_several_starts_continues_to_the_same_numbers(folder, tmp_path, evaluations):
    job = several_starts(folder, 3)._replace(checkpoint=tmp_path / "seed-1.ckpt")
    whole = job._replace(checkpoint=None).run(None)

    def kill_after_the_evaluations(seed, done, evaluation):
        if done > 20 * evaluations:
            raise KilledError

    with pytest.raises(KilledError):
        job.run(kill_after_the_evaluations)
    seen = []
    result = job.run(lambda seed, done, evaluation: seen.append(done))
    assert min(seen) > 20 * evaluations
    assert result.history == whole.history
    assert same_weights(result, whole)


def test_a_start_that_diverges_is_not_the_one_that_goes_on(folder, monkeypatch):
    job = several_starts(folder, 2)
    evaluate = Learner._evaluate

    def break_the_first(learner):
        evaluate(learner)
        learner.diverged = learner.number == 0

    monkeypatch.setattr(Learner, "_evaluate", break_the_first)
    result = job.run(None)
    assert result.failed is None or "finite" not in result.failed
    assert [evaluation.step for evaluation in result.history] == [20, 40, 60, 80]


@pytest.fixture
def lossy(folder, monkeypatch):
    """A simulation in which commands are lost, actuators lag and motion varies, in place of the bare dynamics model."""
    bare = load_simulation(folder)
    mechanisms = [
        mechanism_class("command_loss")(name="command_loss", probability=0.4),
        mechanism_class("actuator_lag")(name="actuator_lag", time_constant_s=0.5),
    ]
    conditions = SessionConditions(arena_mm=Arena(x=(-200.0, 1200.0), y=(-100.0, 1100.0)), session_s=100.0)
    extended = Simulation(bare.dynamics, mechanisms, conditions).eval()
    monkeypatch.setattr(training, "load_simulation", lambda folder: extended)
    return extended


def test_a_policy_learned_in_a_simulation_with_lag_and_loss_feels_them(folder, lossy, monkeypatch):
    drawn, again, most_likely = (
        policy_job(folder)._replace(sampled=sampled).run(None) for sampled in (None, True, False)
    )
    assert drawn.history == again.history
    assert same_weights(drawn, again)
    assert drawn.history != most_likely.history
    monkeypatch.setattr(training, "load_simulation", lambda folder: Simulation(lossy.dynamics).eval())
    assert policy_job(folder).run(None).history != most_likely.history


def test_a_policy_learns_in_the_arena_that_its_simulation_states(folder, lossy):
    learner = Learner(policy_job(folder))
    assert learner.task.arena == lossy.conditions.arena_mm
    assert learner.scenarios.start[..., 0].min() < learner.job.robot.arena_mm.x[0] + learner.task.config.margin_mm
    assert task_in(folder, learner.job.robot, learner.job.task).arena == lossy.conditions.arena_mm


def test_a_policy_learns_in_another_arena_if_asked(folder):
    job = policy_job(folder, task_named("obstacle"))
    wide = job._replace(arena=Arena(x=(2000, 3500), y=(0, 1500)))
    learner = Learner(wide)
    assert learner.task.arena == wide.arena
    assert learner.scenarios.start[..., 0].min() > 2000
    assert task_in(folder, job.robot, job.task, arena=wide.arena).arena == wide.arena
    assert wide.identity != job.identity


@pytest.mark.usefixtures("lossy")
def test_an_interrupted_training_continues_to_the_same_drawn_numbers(folder, tmp_path):
    job = policy_job(folder)
    check_continues(job, tmp_path / "seed-1.ckpt", job.run(None))


@pytest.fixture
def randomised(folder):
    """A job in which roll-outs differ, fewer at a time than there are worlds in training or evaluation."""
    ranges = {
        "command_delay": {"delay_s": [0.1, 0.4]},
        "command_loss": {"probability": [0.0, 0.3]},
        "gain_change": {"gain": [0.7, 1.3], "of": "vehicle"},
    }
    randomisation = Randomisation.read(ranges, load_simulation(folder), draws=3)
    return policy_job(folder, algorithm=small("ddpg", steps=40))._replace(randomisation=randomisation)


def test_an_interrupted_training_in_a_randomised_world_continues_to_the_same_numbers(randomised, tmp_path):
    result = check_continues(randomised, tmp_path / "seed-1.ckpt", randomised.run(None))
    assert result.history != randomised._replace(randomisation=None).run(None).history


def test_every_evaluation_in_a_randomised_world_meets_the_same_draws(randomised):
    learner = Learner(randomised)
    learner._evaluate()
    learner.motion.move(np.zeros(learner.env.world.shape))
    learner._evaluate()
    assert learner.history[0] == learner.history[1]


def test_a_checkpoint_of_other_ranges_is_not_continued(randomised, folder):
    wider = {"command_delay": {"delay_s": [0.1, 0.5]}}
    other = Randomisation.read(wider, load_simulation(folder), draws=3)
    jobs = [randomised, randomised._replace(randomisation=other), randomised._replace(randomisation=None)]
    assert len({job.identity for job in jobs}) == 3


def test_a_finished_training_is_not_done_again(folder, finished, tmp_path):
    first, checkpoint = finished
    done = policy_job(folder, checkpoint=Path(shutil.copy(checkpoint, tmp_path)))
    reports = []
    assert done.run(lambda *told: reports.append(told)).history == first.history
    assert reports == []


@pytest.mark.parametrize("damage", ["cut", "text", "pickle"])
def test_a_damaged_checkpoint_is_named_and_the_seed_starts_anew(folder, finished, tmp_path, caplog, damage):
    first, checkpoint = finished
    path = tmp_path / "seed-1.ckpt"
    shutil.copy(checkpoint, path)
    kept = policy_job(folder, checkpoint=path)
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:5000])
    elif damage == "text":
        path.write_text("no checkpoint")
    else:
        torch.save({"identity": kept.identity, "something": random.Random()}, path)
    assert same_weights(kept.run(None), first)
    assert len(caplog.messages) == 1
    assert caplog.messages[0].startswith(f"seed 1 starts anew: checkpoint {path} is damaged (")
    assert "\n" not in caplog.messages[0]


def test_a_checkpoint_of_another_training_is_not_continued(folder, finished, caplog):
    _, path = finished
    other = policy_job(folder, algorithm=small("ddpg", exploration=0.3), checkpoint=path)
    assert read_checkpoint(path, other.identity, 1) == {}
    assert caplog.messages == [f"seed 1 starts anew: checkpoint {path} is of another training"]


def test_the_global_random_numbers_are_left_alone(folder):
    random.seed(1)
    np.random.seed(1)  # noqa: NPY002
    torch.manual_seed(1)
    expected = random.random(), np.random.random(), torch.rand(1).item()  # noqa: NPY002
    random.seed(1)
    np.random.seed(1)  # noqa: NPY002
    torch.manual_seed(1)
    policy_job(folder).run(None)
    assert (random.random(), np.random.random(), torch.rand(1).item()) == expected  # noqa: NPY002


def test_rewards_are_scaled_by_random_play_and_the_critic_begins_with_its_value(folder):
    learner = Learner(policy_job(folder, task_named("collective"), small("ddpg", gamma=0.9, reward_size=2.0)))
    learner.scale_rewards()
    assert 4 < 2.0 * learner.env.reward_scale < 12
    for layer in learner.job.algorithm.critics(learner.algorithm):
        assert layer.bias.item() == pytest.approx(-2.0 / 0.1)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_learning_goes_on_from_a_policy(folder, undisturbed, name):
    """It is what acts, what targets are made with, and the first that is evaluated."""
    before = undisturbed(name)
    job = policy_job(folder, algorithm=small(name), seed=2)
    learner = Learner(job._replace(initial=InitialPolicy("before", before.weights)))
    learner.begin()
    assert all(np.array_equal(before.weights[key], value) for key, value in learner.policy.state_dict().items())
    target = getattr(learner.algorithm.policy, "actor_target", None)
    if target is not None:
        pairs = zip(target.parameters(), learner.algorithm.policy.actor.parameters(), strict=True)
        assert all(np.array_equal(one.detach(), other.detach()) for one, other in pairs)
    assert [evaluation.step for evaluation in learner.history] == [0]
    assert learner.job.identity != job.identity


def test_an_interrupted_training_that_went_on_from_a_policy_continues_to_the_same_numbers(
    folder, undisturbed, tmp_path
):
    initial = InitialPolicy("before", undisturbed("ddpg").weights)
    job = policy_job(folder, algorithm=small("ddpg"), seed=2)._replace(initial=initial)
    check_continues(job, tmp_path / "seed.ckpt", job.run(None), evaluations=2)


def test_a_seed_that_diverges_is_flagged_and_the_others_go_on(folder, caplog):
    wild = small("ddpg", learning_rate=1e30)
    results = learn_all([policy_job(folder, algorithm=wild, seed=1), policy_job(folder, seed=2)], processes=1)
    assert results[0].failed == "its weights were no longer finite"
    assert "seed 1 has failed: its weights were no longer finite" in caplog.messages
    with pytest.raises(UserError, match=r"every seed has failed \(seed 1: its weights were no longer finite\)"):
        best_of(results[:1])


def test_the_best_policy_is_kept_and_not_the_last(folder):
    job = policy_job(folder, task_named("obstacle", **EASY), quick(steps=300), every=50, scenes=20)
    learner = Learner(job)
    learner.begin()
    learner.learn_until(job.schedule.steps, None, lambda: None)
    result = learner.result()
    ranked = sorted(result.history, key=lambda evaluation: evaluation.rank, reverse=True)
    assert [finalist.evaluation for finalist in learner.finalists] == ranked[:3]
    scenarios = draw_scenarios(learner.task, 40, "evaluation", seed=1)
    final = {}
    for evaluation, weights in learner.finalists:
        policy = Policy.with_weights(job.robot, learner.task.observation_names, job.algorithm.architecture, weights)
        # in the very motion it was chosen in: another one rounds otherwise, and a scenario in 40 may end otherwise
        rollout = roll_out_in(learner.simulation, learner.task, policy, scenarios, job)
        final[evaluation.step] = (rollout.success.mean(), rollout.mean_reward.mean())
        if evaluation.step == result.best.step:
            assert all(np.array_equal(result.weights[name], values) for name, values in weights.items())
    assert (result.best.success, result.best.reward) == final[result.best.step]
    assert result.best.success == max(success for success, _ in final.values())


def test_seeds_side_by_side_are_the_same_as_in_turn(folder):
    jobs = [policy_job(folder, seed=seed) for seed in (1, 2)]
    told = []
    beside = learn_all(jobs, lambda *report: told.append(report[0]), processes=2)
    for one, other in zip(beside, learn_all(jobs, processes=1), strict=True):
        assert one.history == other.history
        assert same_weights(one, other)
    assert set(told) == {1, 2}


def test_training_evaluation_rollouts_and_gate_have_scenarios_of_their_own():
    task = task_named("collective").build(robot_named("mgr"))
    scenarios = [draw_scenarios(task, 5, purpose, 0) for purpose in ("evaluation", "rollout", "gate")]
    scenarios.append(task.draw(np.random.default_rng(0), 5))
    starts = [json.dumps(scenario.start.tolist()) for scenario in scenarios]
    assert len(set(starts)) == 4
    assert np.array_equal(draw_scenarios(task, 5, "gate", 3).start, draw_scenarios(task, 5, "gate", 3).start)


def test_the_policy_of_a_seed_plays_as_its_evaluation_says(folder, undisturbed):
    taught, result = policy_job(folder), undisturbed("ddpg")
    task = taught.task.build(taught.robot)
    policy = policy_of(task, taught.algorithm, result)
    for name, tensor in policy.state_dict().items():
        assert np.array_equal(tensor.numpy(), result.weights[name])


def test_every_shipped_algorithm_is_known_and_takes_a_step(folder):
    assert ALGORITHMS == ("ddpg", "ppo", "sac", "td3")
    for name in ALGORITHMS:
        shipped = algorithm_named(name, steps=1)
        assert len(policy_job(folder, algorithm=shipped, every=1, scenes=2).run(None).history) == 1


def test_an_unknown_algorithm_names_the_one_meant():
    with pytest.raises(UserError, match=r"no such algorithm: 'dpg': did you mean 'ddpg'\? known: ddpg, ppo, sac, td3"):
        algorithm_config({"name": "dpg"}, "policy")
