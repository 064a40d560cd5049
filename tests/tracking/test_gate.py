import numpy as np
import pytest

from swarmtwin.errors import UserError
from swarmtwin.tracking.gate import (
    DynamicsVerdict,
    Errors,
    Trials,
    judge_challenging_policy,
    judge_dynamics,
    judge_policy,
)

RUN = np.repeat(np.arange(40), 50)


def errors(rng, scale):
    base = np.random.default_rng(5).gamma(2, 2, len(RUN))
    return of_transitions(base * scale + rng.normal(0, 0.2, len(RUN)), RUN)


def of_transitions(error, run):
    """The same error in position and orientation, of each transition."""
    return Errors.by_run(np.column_stack([error, error]), run)


def test_a_better_model_passes_and_a_worse_one_does_not():
    rng = np.random.default_rng(0)
    better, same = errors(rng, 0.95), errors(rng, 1.0)
    verdict = judge_dynamics(better, same)
    assert verdict.passed
    assert verdict.low < -0.05 < verdict.high
    assert not judge_dynamics(same, better).passed


def test_the_change_is_the_mean_over_transitions_however_many_each_run_has():
    rng = np.random.default_rng(3)
    run = rng.integers(0, 8, 500)
    candidate, rival = rng.gamma(2, 2, (2, 500, 2))
    by_hand = 0.5 * sum(candidate.mean(axis=0) / rival.mean(axis=0) - 1)
    verdict = judge_dynamics(Errors.by_run(candidate, run), Errors.by_run(rival, run))
    assert verdict.change == pytest.approx(by_hand)


def test_a_gain_is_said_in_words_with_its_interval_from_the_smallest_on():
    assert DynamicsVerdict(True, -0.123, -0.25, -0.04).gain == "12.3% smaller (95 % interval 4.0% to 25.0% smaller)"


def test_an_equal_model_rarely_passes():
    passed = 0
    for seed in range(200):
        rng = np.random.default_rng(seed)
        passed += judge_dynamics(errors(rng, 1.0), errors(rng, 1.0), seed=seed).passed
    assert passed / 200 <= 0.06  # nominal 2.5 %, plus three standard errors of 200 draws


def test_runs_and_not_transitions_are_independent():
    rng = np.random.default_rng(1)
    run = np.repeat(np.arange(6), 500)
    shift = rng.normal(-0.1, 0.5, 6)[run]
    by_runs, by_transitions = (
        judge_dynamics(of_transitions(4.0 + shift, blocks), of_transitions(np.full(3000, 4.0), blocks))
        for blocks in (run, np.arange(3000))
    )
    assert by_runs.high - by_runs.low > 5 * (by_transitions.high - by_transitions.low)


def test_the_verdict_is_the_same_every_time():
    rng = np.random.default_rng(2)
    first, second = errors(rng, 0.99), errors(rng, 1.0)
    assert judge_dynamics(first, second) == judge_dynamics(first, second)


DEMANDS = {"least_success": 0.85, "most_collisions": 0.05, "margin": 0.05}


def trials(succeeded, collided=0, count=200, reward=-1.0):
    """Roll-outs of which the first ones succeeded, and the last ones collided."""
    order = np.arange(count)
    return Trials(order < succeeded, order >= count - collided, np.full(count, reward))


def test_a_policy_must_succeed_often_enough_and_collide_seldom_enough():
    assert judge_policy(trials(170), None, **DEMANDS).passed
    assert judge_policy(trials(169), None, **DEMANDS).refusals == ("success is below 85%",)
    assert judge_policy(trials(191, 9), None, **DEMANDS).passed
    assert judge_policy(trials(190, 10), None, **DEMANDS).refusals == ("collisions are not below 5%",)
    assert str(judge_policy(trials(100, 20), None, **DEMANDS)) == (
        "success 50.0%, collisions 10.0% of 200 roll-outs on stand-ins: success is below 85%; "
        "collisions are not below 5%"
    )


def test_a_policy_must_not_be_worse_than_the_champion_from_the_same_starts():
    assert judge_policy(trials(196), trials(196), **DEMANDS).passed
    assert judge_policy(trials(198), trials(180), **DEMANDS).passed
    worse = judge_policy(trials(180), trials(196), **DEMANDS)
    assert worse.refusals == ("it may be worse than the champion by more than 5%",)
    assert "success -8.0% against the champion (95 % interval" in worse.found


def test_other_failures_than_the_champions_widen_the_interval():
    champion = trials(180)
    same, others = trials(180), Trials(np.flip(champion.succeeded), champion.collided, champion.reward)
    assert judge_policy(same, champion, **DEMANDS).passed
    assert not judge_policy(others, champion, **DEMANDS).passed


def test_a_policy_that_is_truly_worse_by_more_than_the_margin_seldom_passes():
    passed = 0
    for seed in range(200):
        rng = np.random.default_rng(seed)
        champion, candidate = (
            Trials(rng.random(300) < rate, np.zeros(300, bool), np.zeros(300)) for rate in (0.96, 0.90)
        )
        passed += judge_policy(candidate, champion, **DEMANDS, seed=seed).passed
    assert passed / 200 <= 0.06


def test_too_few_rollouts_judge_no_policy():
    expected = "99 roll-outs on stand-ins are too few to judge a policy by: ask for 100 or more"
    with pytest.raises(UserError, match=expected):
        judge_policy(trials(99, count=99), None, **DEMANDS)


@pytest.mark.parametrize(
    ("candidate", "refusals"),
    [
        (trials(196), ()),
        (trials(180, reward=-0.9), ()),
        (trials(180), ("it is not measurably better",)),
        (trials(182), ("it is not measurably better",)),
        (trials(164, reward=-0.5), ("it is not measurably better",)),
        (trials(196, 12), ("it collides measurably more often",)),
    ],
    ids=["more success", "more reward", "the same", "hardly more success", "less success", "more collisions"],
)
def test_a_policy_challenges_by_more_success_or_reward_and_never_by_more_collisions(candidate, refusals):
    assert judge_challenging_policy(candidate, trials(180)).refusals == refusals


def test_an_equal_policy_rarely_challenges():
    passed = 0
    for seed in range(200):
        rng = np.random.default_rng(seed)
        pair = (Trials(rng.random(100) < 0.9, rng.random(100) < 0.03, rng.normal(-1, 0.1, 100)) for _ in range(2))
        passed += judge_challenging_policy(*pair, seed=seed).passed
    assert passed / 200 <= 0.09  # two chances of nominally 2.5 %, plus three standard errors of 200 draws


def test_policies_that_did_not_begin_alike_are_compared_as_two_samples():
    """An equal policy, deployed as often but not from the same starts, is rarely found better or worse by a margin."""
    beaten = 0
    for seed in range(200):
        rng = np.random.default_rng(seed)
        candidate, champion = (
            Trials(rng.random(60) < 0.9, np.zeros(60, bool), np.zeros(60), "deployments", paired=False)
            for _ in range(2)
        )
        verdict = judge_policy(candidate, champion, **DEMANDS | {"margin": 0.0}, fewest_rollouts=20, seed=seed)
        low = float(verdict.found.split("interval ")[1].split("%")[0]) / 100
        beaten += low > 0
    assert beaten / 200 <= 0.06
    assert "of 60 deployments" in verdict.found
