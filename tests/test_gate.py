import numpy as np

from swarmtwin.gate import Errors, judge

RUN = np.repeat(np.arange(40), 50)


def errors(rng, scale):
    base = np.random.default_rng(5).gamma(2, 2, len(RUN))
    noise = rng.normal(0, 0.2, len(RUN))
    return Errors(base * scale + noise, base * scale + noise)


def test_a_better_model_passes_and_a_worse_one_does_not():
    rng = np.random.default_rng(0)
    better, same = errors(rng, 0.95), errors(rng, 1.0)
    verdict = judge(better, same, RUN)
    assert verdict.passed
    assert verdict.low < -0.05 < verdict.high
    assert not judge(same, better, RUN).passed


def test_an_equal_model_rarely_passes():
    passed = 0
    for seed in range(200):
        rng = np.random.default_rng(seed)
        passed += judge(errors(rng, 1.0), errors(rng, 1.0), RUN, seed).passed
    assert passed / 200 <= 0.06  # nominal 2.5 %, plus three standard errors of 200 draws


def test_runs_and_not_transitions_are_independent():
    rng = np.random.default_rng(1)
    run = np.repeat(np.arange(6), 500)
    shift = rng.normal(-0.1, 0.5, 6)[run]
    incumbent, candidate = Errors(np.full(3000, 4.0), np.full(3000, 4.0)), Errors(4.0 + shift, 4.0 + shift)
    by_runs = judge(candidate, incumbent, run)
    by_transitions = judge(candidate, incumbent, np.arange(3000))
    assert by_runs.high - by_runs.low > 5 * (by_transitions.high - by_transitions.low)


def test_the_verdict_is_the_same_every_time():
    rng = np.random.default_rng(2)
    first, second = errors(rng, 0.99), errors(rng, 1.0)
    assert judge(first, second, RUN) == judge(first, second, RUN)
