"""A car that rolls on: what models, the bicycle and whole predicted runs make of its measured velocity."""

import dataclasses

import numpy as np
import pytest
import torch

import car
from swarmtwin.dynamics.evaluation import one_step
from swarmtwin.dynamics.model_config import config_class
from swarmtwin.dynamics.models.kinematic import Config as Kinematic
from swarmtwin.dynamics.plain_baseline import fit_kinematics
from swarmtwin.dynamics.predictor import NetworkDynamics
from swarmtwin.dynamics.training import train
from swarmtwin.errors import UserError
from swarmtwin.files import new_folder
from swarmtwin.geometry import displacement_between, exp_map, log_map
from swarmtwin.kinematics import Before
from swarmtwin.kinematics.bicycle import Equations
from swarmtwin.learning.situation import Situation
from swarmtwin.recordings.reading import read_recording
from swarmtwin.recordings.writing import write_recording
from swarmtwin.simulation.best_prediction import best_prediction
from swarmtwin.simulation.open_loop import open_loop
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.transitions import Fractions, from_recording, split_by_run
from swarmtwin.world.motion import SimulatedMotion
from toy import recipe

NOISE_FREE = (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def recorded(robots, tmp_path_factory):
    """The transitions of 60 runs, from a recording that was written, read, judged as a whole, and split by run."""
    made = car.recording(robots["car"], runs=60)
    with new_folder(tmp_path_factory.mktemp("car") / "recording", "test") as folder:
        write_recording(folder, robots["car"], made.header, made.tracks)
    read = read_recording(tmp_path_factory.getbasetemp() / folder.parent.name / "recording", robots["car"])
    assert not read.warnings
    transitions, counts = from_recording(read)
    assert counts.kept == counts.considered == 60 * 60
    return split_by_run(transitions, Fractions(train=0.6, validation=0.2, test=0.2), seed=1)


@pytest.fixture(scope="module")
def planted(robots):
    """The bicycle with the values of the car."""
    return car.exact_dynamics(robots["car"])


def held_out_error_mm(recorded, *parts):
    """Mean distance on held-out runs of a small network that is given so much."""
    config = config_class("mlp")(situation=("command", *parts), steps=600)
    dynamics = train(recorded, config, recipe(batch_size=128), [0]).dynamics
    return one_step(dynamics, recorded.part("test")).position_mm


def test_a_network_that_is_given_the_velocity_errs_less_than_half_as_much(recorded):
    """The noise alone, of two poses of 1.5 mm, errs by 1.5 √π = 2.7 mm."""
    without, with_velocity = held_out_error_mm(recorded), held_out_error_mm(recorded, "velocity")
    assert 2.7 < with_velocity < 6
    assert with_velocity < 0.4 * without
    assert with_velocity < 0.7 * held_out_error_mm(recorded, "previous_command", "earlier_command")


def test_the_floor_knows_what_velocity_is_worth(recorded):
    own = recorded.part("test")
    given = [best_prediction(own, parts, None).mean for parts in (("command",), ("command", "velocity"))]
    without, with_velocity = (np.linalg.norm((mean - own.displacement)[:, :2], axis=1).mean() for mean in given)
    assert with_velocity < 0.5 * without


# ---- the bicycle


def test_the_planted_bicycle_and_its_momentum_are_recovered(recorded):
    """Though velocity and motion carry the camera's noise: time constant and marker within 4 %, speeds within 5 %.

    A steering gain and a wheelbase, which differ by the tangent's bend alone, within 8 %, their quotient within 1.5 %.
    """
    robot, found = recorded.robot, fit_kinematics(recorded.part("train"))
    assert found.inputs == ("command", "previous_command", "velocity")
    values = found.network.physical_parameters()
    for name in ("marker_ahead_mm", "time_constant_s"):
        assert values[name] == pytest.approx(car.PLANTED[name], rel=0.04), name
    for name in ("wheelbase_mm", "steering_gain"):
        assert values[name] == pytest.approx(car.PLANTED[name], rel=0.08), name
    quotient = values["steering_gain"] / values["wheelbase_mm"]
    assert quotient == pytest.approx(car.PLANTED["steering_gain"] / car.PLANTED["wheelbase_mm"], rel=0.015)
    throttle = torch.tensor([[one, 0.0] for one in (-0.6, 0.0, 0.2, 0.5, 1.0)])
    speeds = Equations().velocities(throttle, {name: torch.tensor(value) for name, value in values.items()}, robot)[0]
    np.testing.assert_allclose(speeds, car.asked_mm_s(throttle[:, 0].numpy()), rtol=0.05, atol=20)
    assert values["trim_deg"] == pytest.approx(car.PLANTED["trim_deg"], abs=0.2)


def test_a_bicycle_without_momentum_errs_much_more(recorded):
    steady, moving = (
        train(recorded, Kinematic(situation=parts, steps=600), recipe(batch_size=256), [0]).dynamics
        for parts in (("command",), ("command", "velocity"))
    )
    assert "time_constant_s" not in steady.network.physical_parameters()
    errors = [one_step(dynamics, recorded.part("test")).position_mm for dynamics in (steady, moving)]
    assert errors[1] < 0.4 * errors[0]


def test_the_planted_bicycle_is_exact_without_noise(robots, planted):
    """Of all periods but the first: the equations in closed form are the small time steps of the car."""
    transitions, _ = from_recording(car.recording(robots["car"], runs=3, noise=NOISE_FREE))
    known = transitions.where(np.isfinite(transitions.velocity).all(axis=1))
    assert len(known) == len(transitions) - 3
    predicted = planted.predict(Situation.from_transitions(known, planted.inputs)).numpy()
    np.testing.assert_allclose(predicted[:, :2], known.displacement[:, :2], atol=0.02)
    np.testing.assert_allclose(predicted[:, 2], known.displacement[:, 2], atol=1e-4)


def test_a_fast_motor_has_no_momentum(robots):
    equations, robot = Equations(), robots["car"]
    values = {name: torch.tensor(value) for name, value in car.PLANTED.items()}
    command = torch.tensor([[0.5, 10.0], [-0.7, -20.0], [0.02, 0.0]])
    before = Before(command.flip(0), torch.tensor([[900.0, 0.0, 0.3]] * 3))
    after = equations.velocities_after(before, command, values | {"time_constant_s": torch.tensor(1e-4)}, robot)
    for one, steady in zip(after, equations.velocities(command, values, robot), strict=True):
        torch.testing.assert_close(one, steady, rtol=0, atol=2.0)  # mm/s, of 2,000


def test_equations_without_momentum_refuse_a_velocity(robots):
    with pytest.raises(UserError, match=r"kinematics 'differential_drive' know no momentum: set model.situation="):
        NetworkDynamics(robots["mgr"], Kinematic(situation=("command", "velocity")))
    assert NetworkDynamics(robots["mgr"], Kinematic(situation=None)).inputs == ("command",)


def test_a_previous_command_alone_is_refused():
    with pytest.raises(UserError, match="look at previous_command beside velocity alone"):
        Kinematic.parse({"name": "kinematic", "situation": ["command", "previous_command"]}, "here")


# ---- roll-outs


def test_a_whole_run_is_predicted_by_its_simulated_velocity(robots, planted):
    """Without noise the run itself results; with velocities of 0 it would stay behind by metres."""
    tracks = car.recording(robots["car"], runs=4, noise=NOISE_FREE).tracks
    for run in open_loop(Simulation(planted), tracks):
        assert np.linalg.norm(run.track.pose[-1, :2] - run.track.pose[0, :2]) > 1000
        np.testing.assert_allclose(run.predicted[:, :2], run.track.pose[:, :2], atol=2.0)


def test_measured_velocities_play_no_part_in_a_predicted_run(robots, planted):
    [track] = car.recording(robots["car"], runs=1, noise=NOISE_FREE).tracks
    elsewhere = track.pose.copy()
    elsewhere[1:] += np.random.default_rng(1).normal(0, 100, elsewhere[1:].shape) * [1, 1, 0.01]
    [own], [other] = (
        open_loop(Simulation(planted), [one]) for one in (track, dataclasses.replace(track, pose=elsewhere))
    )
    np.testing.assert_array_equal(own.predicted, other.predicted)


def test_a_step_leaves_the_velocity_of_its_own_motion(robots, planted):
    """Also where a period is longer than usual; and the next motion is what the model says of that velocity."""
    simulation = Simulation(planted)
    state = simulation.start(torch.tensor([[[0.0, 0.0, 0.5], [3.0, 4.0, -3.0]]]))
    assert not state.velocity.any()
    duration_s = torch.full((1, 2), 0.12, dtype=torch.float64)
    moved = simulation.step(state, torch.tensor([[[1.0, 20.0], [-1.0, 5.0]]]), duration_s)
    moved = simulation.step(moved, torch.tensor([[[1.0, 20.0], [-1.0, 5.0]]]), duration_s)
    after = simulation.step(moved, torch.tensor([[[0.0, 20.0], [0.3, 5.0]]]), duration_s)
    torch.testing.assert_close(log_map(displacement_between(moved.pose, after.pose)), 0.12 * after.velocity)
    asked = Situation(
        command=torch.tensor([[0.0, 20.0], [0.3, 5.0]], dtype=torch.float64),
        previous_command=moved.previous_command[0],
        velocity=moved.velocity[0],
    )
    expected = exp_map(0.12 * after.velocity[0])
    torch.testing.assert_close(planted.predict(asked).double(), expected, rtol=1e-5, atol=1e-3)
    standing = dataclasses.replace(asked, velocity=torch.zeros(2, 3))
    assert (planted.predict(standing) - expected).norm(dim=1).min() > 20


def test_a_world_that_is_restored_rolls_on(robots, planted):
    command = np.full((2, 1, 2), 0.5)
    first, second = (SimulatedMotion(Simulation(planted), worlds=2, vehicles=1) for _ in range(2))
    first.move(command)
    second.restore(first.state())
    stopped = 0 * command
    np.testing.assert_array_equal(first.move(stopped), second.move(stopped))
    old = {name: values for name, values in first.state().items() if name != "velocity"}
    second.restore(old)  # a checkpoint of an earlier version begins at rest
    assert np.abs(second.move(stopped) - first.move(stopped)).max() > 10
    first.place(np.array([1]), np.zeros((1, 1, 3)))
    assert not first.state()["velocity"][1].any()
    assert first.state()["velocity"][0].any()
