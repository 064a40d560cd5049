"""What the simulation gets wrong of its reference is expected again, and so is what the reference cannot tell."""

import numpy as np
import torch
from exact_base import ExactBase, known_noise, session_of

from swarmtwin.diagnosis.cause_search import CauseSearch
from swarmtwin.diagnosis.discrepancy import Discrepancy
from swarmtwin.diagnosis.likelihood import SessionLikelihood
from swarmtwin.diagnosis.screening import sought_kinds
from swarmtwin.geometry import exp_map


def test_errors_of_the_simulation_look_like_mechanisms_of_their_plain_form_each_once(robots):
    base = ExactBase(robots["mur"])
    model = SessionLikelihood(base, known_noise(), session_of(base, np.random.default_rng(2)))
    directions = Discrepancy.learn(model, spread=0.3).mechanisms
    lags = [one for one in directions if one.name == "actuator_lag"]
    plays = [one for one in directions if one.name == "backlash"]
    assert lags
    assert all(one.own_time_constant_s is None for one in lags)
    assert plays
    assert all(one.by_width is None and one.servo_rad_s is None for one in plays)
    assert len({repr(one) for one in directions}) == len(directions)


def slower_where_held(moment):
    """True displacements (R, 3): a tenth less far where the command is that of the period before."""
    span = torch.as_tensor(moment.base.robot.command_high - moment.base.robot.command_low)
    change = ((moment.command - moment.previous_command) / span).square().sum(dim=-1, keepdim=True)
    return exp_map(moment.way * (1 - 0.1 * torch.exp(-change / (2 * 0.15**2))))


def test_what_the_simulation_gets_wrong_where_commands_hold_is_no_gap_though_the_reference_seldom_holds_them(robots):
    """Of commands that are drawn anew in each period few are like the one before: little is known of those that are."""
    base, rng = ExactBase(robots["mgr"]), np.random.default_rng(5)
    reference = SessionLikelihood(base, known_noise(), session_of(base, rng, slower_where_held, runs=100, steps=40))
    robot, steps, runs = base.robot, 40, 60
    held = np.repeat(rng.uniform(robot.command_low, robot.command_high, (steps // 8, runs, 2)), 8, axis=0)
    found = {}
    for name, moved in (
        ("as in the reference", slower_where_held),
        ("slower", lambda moment: exp_map(0.8 * moment.way)),
    ):
        session = session_of(base, rng, moved, command=held)
        for expected in (None, Discrepancy.learn(reference, spread=0.3)):
            model = SessionLikelihood(base, known_noise(), session, discrepancy=expected)
            best = CauseSearch(model, sought_kinds(model)).run().best
            found[name, expected is not None] = best.names
    assert found["as in the reference", False] != ()  # where nothing is known of it, it is accused
    assert found["as in the reference", True] == ()
    assert "gain_change" in found["slower", True]
