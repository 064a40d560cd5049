"""A session is predicted as the simulation steps: what actuators remember is carried through each run."""

import numpy as np
import pytest
import torch
from exact_base import ExactBase, session_of, still

from exact_model import conditions_of
from swarmtwin.diagnosis.session_prediction import SessionPredictor
from swarmtwin.geometry import displacement_between, exp_map, log_map
from swarmtwin.learning.situation import Situation
from swarmtwin.simulation.mechanism import mechanism_class
from swarmtwin.simulation.simulation import Simulation

REMEMBERING = {
    "actuator_lag": {"time_constant_s": 0.3},
    "backlash": {"travel_mm": 4.0},
    "command_delay": {"delay_s": 0.2},
}


def stepped(base, mechanisms):
    """Vehicles that move as the simulation with mechanisms steps them, from rest."""
    simulation, known = Simulation(base, mechanisms, conditions_of(base.robot)), {}

    def moved(moment):
        if moment.step == 0:
            known["state"] = simulation.start(moment.pose[:, None])
        state = simulation.step(known["state"], moment.command[:, None])
        before, known["state"] = known["state"].pose[:, 0], state
        return displacement_between(before, state.pose[:, 0])

    return moved


@pytest.mark.parametrize("names", [*([name] for name in REMEMBERING), list(REMEMBERING)])
def test_a_session_is_predicted_as_the_simulation_steps(robots, names):
    """From the fourth period of a run on: what the command before the first was is not measured."""
    base = ExactBase(robots["mgr"])
    mechanisms = [mechanism_class(name).at(REMEMBERING[name]) for name in names]
    session = session_of(base, np.random.default_rng(1), stepped(base, mechanisms), spread=still, runs=20, steps=20)
    predictor = SessionPredictor(base, session.conditions, session.situation, session.follows)
    measured = log_map(torch.as_tensor(session.transitions.displacement))
    wrong = (predictor.twist(mechanisms) - measured).abs().numpy()
    step = np.tile(np.arange(1, 20), 20)
    assert wrong[step >= 6].max() < 0.05
    alone = (predictor.twist(()) - measured).abs().numpy()
    assert alone[step >= 6].max() > 2.0


def test_what_two_commands_leave_is_not_enough(robots):
    """A lag as long as the period: without the state that is carried, the prediction would be off."""
    base = ExactBase(robots["mgr"])
    lag = [mechanism_class("actuator_lag").at({"time_constant_s": 0.5})]
    session = session_of(base, np.random.default_rng(2), stepped(base, lag), spread=still, runs=20, steps=20)
    measured = log_map(torch.as_tensor(session.transitions.displacement))
    late = np.tile(np.arange(1, 20), 20) >= 8
    carried, apart = (
        SessionPredictor(base, session.conditions, session.situation, follows)
        for follows in (session.follows, np.full(len(session), -1))
    )
    wrong, wrong_apart = ((one.twist(lag) - measured).abs().numpy()[late].max() for one in (carried, apart))
    assert wrong < 0.1 < 1.0 < wrong_apart


def test_neighbours_are_where_the_next_transition_measures_them_and_where_the_camera_truly_sees_them(robots):
    """Two vehicles that push each other under a camera whose scale is off, the first from its tracks alone."""
    base, rng = ExactBase(robots["mgr"]), np.random.default_rng(5)
    values = {
        "neighbour_interaction": {"strength_mm_s": 40.0, "reach_mm": 100.0},
        "camera_scale": {"scale": 1.2},
    }
    mechanisms = [mechanism_class(name).at(own) for name, own in values.items()]
    conditions, steps, runs = conditions_of(base.robot), 6, 20
    simulation = Simulation(base, mechanisms, conditions)
    start = np.concatenate([rng.uniform(400, 600, (runs, 2, 2)), rng.uniform(-3, 3, (runs, 2, 1))], axis=2)
    states, commands = (
        [simulation.start(torch.as_tensor(start))],
        torch.as_tensor(rng.uniform(0, 90, (steps, runs, 2, 2))),
    )
    for command in commands:
        states.append(simulation.step(states[-1], command))
    pose = torch.stack([simulation.observe(state) for state in states])
    own, other = pose[:, :, 0], pose[:, :, 1]
    before, command = own[:-1].flatten(0, 1), commands[:, :, 0].flatten(0, 1)
    situation = Situation(
        command=command,
        previous_command=command,
        earlier_command=command,
        pose=before,
        elapsed_s=torch.zeros(len(before), dtype=torch.float64),
        duration_s=torch.full((len(before),), base.robot.period_s, dtype=torch.float64),
        neighbours=displacement_between(before, other[:-1].flatten(0, 1))[:, None],
    )
    row = np.arange(steps * runs).reshape(steps, runs)
    follows = np.concatenate([np.full((1, runs), -1), row[:-1]]).ravel()
    measured = displacement_between(before, own[1:].flatten(0, 1))
    wrong_mm, alone_mm = (
        (exp_map(SessionPredictor(base, conditions, situation, rows).twist(mechanisms)) - measured)[:, :2].norm(dim=-1)
        for rows in (follows, np.full(len(follows), -1))
    )
    followed = slice(0, (steps - 1) * runs)
    assert float(wrong_mm[followed].mean()) < 0.05
    assert float(alone_mm[followed].mean()) > 4 * float(wrong_mm[followed].mean())


def test_a_prediction_is_made_once(robots):
    """The same values give what is known, others are predicted anew; how probable a loss is changes no outcome."""
    base = ExactBase(robots["mgr"])
    session = session_of(base, np.random.default_rng(3), runs=10, steps=10)
    predictor, again = (
        SessionPredictor(base, session.conditions, session.situation, session.follows) for _ in range(2)
    )
    lag, slower = ([mechanism_class("actuator_lag").at({"time_constant_s": value})] for value in (0.1, 0.2))
    assert predictor.twist(lag) is predictor.twist(lag)
    for mechanisms in (slower, lag, ()):
        torch.testing.assert_close(predictor.twist(mechanisms), again.twist(mechanisms), rtol=0, atol=1e-12)
    for one, other in zip(predictor.outcomes(lag), again.outcomes(lag), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-12)
    assert not torch.equal(predictor.outcomes(lag).lost, predictor.twist(lag))
    lossy = [*lag, mechanism_class("command_loss").at({"probability": 0.3})]
    assert predictor.outcomes(lossy).lost is predictor.outcomes(lag).lost
