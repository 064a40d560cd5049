"""A simulation with momentum and mechanisms moves as a car in small time steps does in which that is so."""

import dataclasses

import numpy as np
import pytest
import torch

import car
from swarmtwin.diagnosis.measured_session import MeasuredSession
from swarmtwin.diagnosis.reference import conditions_of
from swarmtwin.diagnosis.session_prediction import SessionPredictor
from swarmtwin.geometry import exp_map
from swarmtwin.learning.situation import Situation
from swarmtwin.simulation.mechanism import mechanism_class
from swarmtwin.simulation.open_loop import open_loop
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.transitions import from_recording

NOISE_FREE = (0.0, 0.0, 0.0)
DRIFT_MM_S = (60.0, -40.0)


def weaker(robot):
    """A car of which the throttle asks for a fifth less."""
    speed = car.PLANTED["speed_gain_mm_s_per_unit"]
    return car.recording(robot, runs=6, noise=NOISE_FREE, speed_gain_mm_s_per_unit=0.8 * speed)


def late(robot):
    """A car that is told everything 0.06 s late."""
    return car.recording(robot, runs=6, noise=NOISE_FREE, late_s=0.06)


def adrift(robot):
    """A car on ground that moves."""
    made = car.recording(robot, runs=6, noise=NOISE_FREE)
    tracks = []
    for track in made.tracks:
        moved = (track.time_s - track.time_s[0])[:, None] * np.array([*DRIFT_MM_S, 0.0])
        tracks.append(dataclasses.replace(track, pose=track.pose + moved))
    return dataclasses.replace(made, tracks=tuple(tracks))


REALLY = {
    "gain_change": (weaker, {"gain": 0.8}),
    "command_delay": (late, {"delay_s": 0.06}),
    "steady_drift": (adrift, {"x_mm_s": DRIFT_MM_S[0], "y_mm_s": DRIFT_MM_S[1]}),
}


@pytest.fixture(scope="module")
def planted_car(robots):
    return car.exact_dynamics(robots["car"])


@pytest.fixture(scope="module", params=sorted(REALLY))
def really(request, robots):
    """What happens, and the mechanism that says so."""
    happens, values = REALLY[request.param]
    return happens(robots["car"]), mechanism_class(request.param).at(values)


def test_whole_runs_are_predicted(really, planted_car):
    """Over six seconds: of a late command half is left, as what was in force before the first one is not known."""
    recording, mechanism = really
    extended, alone = (
        open_loop(Simulation(planted_car, mechanisms), recording.tracks) for mechanisms in ([mechanism], [])
    )
    wrong, wrong_alone = (np.mean([run.rmse_mm for run in runs]) for runs in (extended, alone))
    assert wrong < (45 if mechanism.latency_s() else 15)
    assert wrong < (0.5 if mechanism.latency_s() else 0.15) * wrong_alone


def test_measured_situations_are_predicted(really, planted_car):
    """The velocity is measured where the mechanism is at work: what it made of that is undone."""
    recording, mechanism = really
    transitions, _ = from_recording(recording)
    known = transitions.where(np.isfinite(transitions.velocity).all(axis=1))
    situation = Situation.from_transitions(known, dtype=torch.float64)
    predicted = (Simulation(planted_car, mechanisms).predict(situation).numpy() for mechanisms in ([mechanism], []))
    wrong, wrong_alone = (np.linalg.norm((one - known.displacement)[:, :2], axis=1).mean() for one in predicted)
    assert wrong < 0.2 * wrong_alone


def test_a_session_is_predicted(really, planted_car):
    """From the first measured velocity of each run, which is forgotten after some periods."""
    recording, mechanism = really
    transitions, _ = from_recording(recording)
    session = MeasuredSession.of(transitions, conditions_of(transitions))
    predictor = SessionPredictor(planted_car, session.conditions, session.situation, session.follows)
    wrong, wrong_alone = (
        np.linalg.norm(
            (exp_map(predictor.twist(mechanisms)).numpy() - session.transitions.displacement)[:, :2], axis=1
        ).mean()
        for mechanisms in ([mechanism], [])
    )
    assert wrong < 0.2 * wrong_alone
    assert wrong_alone > 3


def test_a_session_is_predicted_as_the_simulation_steps(robots, planted_car):
    """Late, gradual, and weaker at once."""
    values = {
        "command_delay": {"delay_s": 0.04},
        "actuator_lag": {"time_constant_s": 0.05},
        "gain_change": {"gain": 0.9},
    }
    mechanisms = [mechanism_class(name).at(one) for name, one in values.items()]
    made = car.recording(robots["car"], runs=3, noise=NOISE_FREE)
    runs = open_loop(Simulation(planted_car, mechanisms), made.tracks)
    stepped = [dataclasses.replace(run.track, pose=run.predicted) for run in runs]
    transitions, _ = from_recording(dataclasses.replace(made, tracks=tuple(stepped)))
    session = MeasuredSession.of(transitions, conditions_of(transitions))
    predictor = SessionPredictor(planted_car, session.conditions, session.situation, session.follows)
    wrong = (predictor.twist(mechanisms) - session.twist).abs().numpy()
    alone = (predictor.twist(()) - session.twist).abs().numpy()
    late_enough = np.tile(np.arange(2, 60), 3) > 40
    assert wrong[late_enough].max() < 0.05 < 3 < alone[late_enough].max()
