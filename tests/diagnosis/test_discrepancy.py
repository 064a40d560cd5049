"""What the simulation is expected to get wrong looks like mechanisms of their plain form."""

import numpy as np
from exact_base import ExactBase, known_noise, session_of

from swarmtwin.diagnosis.discrepancy import Discrepancy
from swarmtwin.diagnosis.likelihood import SessionLikelihood


def test_errors_of_the_simulation_look_like_mechanisms_of_their_plain_form_each_once(robots):
    base = ExactBase(robots["mur"])
    model = SessionLikelihood(base, known_noise(), session_of(base, np.random.default_rng(2)))
    directions = Discrepancy.learn(model, spread=0.3).mechanisms
    lags = [one for one in directions if one.name == "actuator_lag"]
    plays = [one for one in directions if one.name == "backlash"]
    assert lags
    assert all(one.own_time_constant_s is None for one in lags)
    assert plays
    assert all(one.missing is None and one.servo_rad_s is None for one in plays)
    assert len({repr(one) for one in directions}) == len(directions)
