"""A car that rolls on is diagnosed: its reference goes on from its own velocity, and what is planted is named."""

import pytest

import car
from swarmtwin.diagnosis.diagnose import diagnose
from swarmtwin.diagnosis.reference import Reference
from swarmtwin.diagnosis.session_prediction import SessionPredictor
from swarmtwin.transitions import from_recording

SEED = 7


def learned(robot):
    transitions, _ = from_recording(car.recording(robot, runs=60, scattered=True))
    return Reference.learn(transitions, SEED)


@pytest.fixture(scope="module")
def reference(robots):
    return learned(robots["car"])


def session(robot, **changed):
    return car.recording(robot, runs=24, seed=11, scattered=True, **changed)


def test_a_reference_goes_on_from_its_own_velocity(robots, reference):
    """Of runs without noise it errs by little, measured velocities forgotten; a tenth of the way that they go."""
    assert reference.base.inputs == ("command", "previous_command", "velocity")
    known = reference.comparable(session(robots["car"], noise=(0.0, 0.0, 0.0))).session
    predictor = SessionPredictor(reference.base, known.conditions, known.situation, known.follows)
    wrong_mm = (predictor.simulated() - known.twist)[:, 0].abs()
    steady, before = predictor.steady_twists()
    assert wrong_mm.mean() < 2
    assert (steady - before)[:, 0].abs().mean() > 5


@pytest.mark.claims
def test_a_car_as_it_was_has_no_gap(robots, reference):
    result = diagnose(reference, session(robots["car"]), SEED).result
    assert (result.verdict, result.causes) == ("no_gap", ())


@pytest.mark.claims
def test_a_weaker_motor_is_named(robots, reference):
    """A tenth: the speed that the throttle asks for, and as momentum is linear any speed."""
    speed_mm_s = 0.9 * car.PLANTED["speed_gain_mm_s_per_unit"]
    result = diagnose(reference, session(robots["car"], speed_gain_mm_s_per_unit=speed_mm_s), SEED).result
    assert [cause.name for cause in result.causes] == ["gain_change"]
    gain = result.causes[0].parameters["gain"]
    assert gain.value == pytest.approx(0.9, abs=0.02)
    assert gain.low < 0.9 < gain.high
    assert result.gain.open_loop_mm.after < 0.5 * result.gain.open_loop_mm.before
