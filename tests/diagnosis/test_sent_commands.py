"""Commands at the times they were sent: a delay is told from them to the moment, and not from their means a period."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from exact_base import ExactBase, known_noise, session_of, still

from swarmtwin.diagnosis.discrepancy import Discrepancy
from swarmtwin.diagnosis.estimation import estimate
from swarmtwin.diagnosis.likelihood import SessionLikelihood
from swarmtwin.diagnosis.measured_session import MeasuredSession
from swarmtwin.geometry import exp_map
from swarmtwin.recordings.resampling import mean_held
from swarmtwin.simulation.mechanism import mechanism_class

SLOTS = 10
"""Commands in a period, each another one."""


def asynchronous(base, delay_s, runs=30, steps=30):
    """A session whose vehicles move by the mean of what was sent `delay_s` before, and the log of it."""
    robot, rng = base.robot, np.random.default_rng(41)
    plain = session_of(base, rng, spread=still, runs=runs, steps=steps).transitions
    period_s = robot.period_s
    time_s = np.arange(plain.time_s.min() - 3 * period_s, plain.time_s.max() + 2 * period_s, period_s / SLOTS)
    wanted = rng.uniform(robot.command_low, robot.command_high, (len(time_s) // 7 + 1, len(robot.command)))
    sent = {"1": (time_s, np.repeat(wanted, 7, axis=0)[: len(time_s)])}

    def mean(start_s):
        edges = np.column_stack([start_s, start_s + period_s]).ravel()
        return mean_held(*sent["1"], edges, 10 * period_s)[::2]

    way = base.twist(torch.as_tensor(mean(plain.time_s - delay_s)))
    noise = torch.as_tensor(rng.normal(size=way.shape)) * torch.tensor([1.0, 1.0, 0.02])
    recorded = {
        name: mean(plain.time_s - periods * period_s)
        for periods, name in enumerate(("command", "previous_command", "earlier_command"))
    }
    return replace(plain, displacement=exp_map(way + noise).numpy(), **recorded), sent


def test_a_delay_is_found_to_the_moment_where_the_log_is_known(robots):
    base = ExactBase(robots["mgr"])
    transitions, sent = asynchronous(base, delay_s=0.2)
    conditions = session_of(base, np.random.default_rng(1), runs=2, steps=3).conditions
    found = {}
    for name, log in (("log", sent), ("means", None)):
        model = SessionLikelihood(base, known_noise(), MeasuredSession.of(transitions, conditions, log))
        found[name] = estimate(model, [mechanism_class("command_delay").at({"delay_s": 0.1})])
    error = found["log"].covariance[0, 0] ** 0.5
    assert found["log"].values[0] == pytest.approx(0.2, abs=3 * error)
    assert error < 0.003
    assert found["log"].evidence > found["means"].evidence + 100


def test_what_was_sent_several_times_a_period_cannot_be_lost(robots):
    base = ExactBase(robots["mgr"])
    transitions, sent = asynchronous(base, delay_s=0.0, runs=8, steps=10)
    conditions = session_of(base, np.random.default_rng(1), runs=2, steps=3).conditions
    once = {vehicle: (time_s[::SLOTS], command[::SLOTS]) for vehicle, (time_s, command) in sent.items()}
    shown = [
        SessionLikelihood(base, known_noise(), MeasuredSession.of(transitions, conditions, log)).can_show(
            mechanism_class("command_loss")
        )
        for log in (sent, once, None)
    ]
    assert shown == [False, True, True]


def test_where_the_log_is_silent_the_recorded_commands_hold(robots):
    base = ExactBase(robots["mgr"])
    transitions, sent = asynchronous(base, delay_s=0.0, runs=4, steps=10)
    conditions = session_of(base, np.random.default_rng(1), runs=2, steps=3).conditions
    time_s, command = sent["1"]
    kept = time_s < transitions.time_s[len(transitions) // 2]
    session = MeasuredSession.of(transitions, conditions, {"1": (time_s[kept], command[kept])})
    late, recorded = session.sent.late(0.1)[0], session.transitions.command
    silent = session.transitions.time_s > time_s[kept][-1] + 2
    np.testing.assert_array_equal(late[silent], recorded[silent])
    assert not np.allclose(late[~silent], recorded[~silent])


def test_what_the_simulation_gets_wrong_of_its_reference_s_rows_is_expected_of_rows_whatever_the_log_says(robots):
    """The simulation answers rows: that these act late in its reference is said by the rows of a session as well."""
    base, late = ExactBase(robots["mgr"]), mechanism_class("command_delay").at({"delay_s": 0.1})
    reference = SessionLikelihood(base, known_noise(), session_of(base, np.random.default_rng(2), runs=40))
    acting = reference.predictor.twist((late,))
    moved = replace(reference.session.transitions, displacement=exp_map(acting).numpy())
    session = MeasuredSession.of(moved, reference.session.conditions)
    learned = Discrepancy.learn(SessionLikelihood(base, known_noise(), session), 0.3)
    transitions, sent = asynchronous(base, delay_s=0.0, runs=8, steps=10)
    sessions = [MeasuredSession.of(transitions, session.conditions, log) for log in (sent, None)]
    expected = [learned.expected(SessionLikelihood(base, known_noise(), one)) for one in sessions]
    assert np.abs(expected[1][0]).max() > 5.0
    for with_log, without in zip(*expected, strict=True):
        np.testing.assert_allclose(with_log, without, atol=1e-9)
