"""Whether the motion is more random than the reference's: what the reference's own shows is no change."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from exact_base import SPREAD, ExactBase, as_simulated, known_noise, session_of

from swarmtwin.diagnosis.likelihood import SessionLikelihood
from swarmtwin.diagnosis.motion_noise_change import expected_noise_log, motion_noise_change, usual_noise_spread
from swarmtwin.diagnosis.noise import NoiseScales, motion_scale_log
from swarmtwin.geometry import exp_map
from swarmtwin.simulation.mechanism import mechanism_class


@pytest.fixture(scope="module")
def model(robots):
    """A session whose motion is a fifth more random than its model says."""
    base = ExactBase(robots["mgr"])
    noise = torch.tensor(SPREAD, dtype=torch.float64) * 1.2
    session = session_of(
        base, np.random.default_rng(3), as_simulated, spread=lambda way: noise.expand_as(way), runs=60, steps=40
    )
    return SessionLikelihood(base, known_noise(), session)


@pytest.mark.parametrize(("usual_log", "is_cause"), [(-0.05, True), (0.0, False), (0.08, False)])
def test_the_noise_is_compared_with_what_the_reference_shows(model, usual_log, is_cause):
    log, _ = model.motion_noise_log()
    found = motion_noise_change(model, (), lambda: usual_log)
    assert found.usual == pytest.approx(math.exp(usual_log))
    assert found.factor == pytest.approx(math.exp(log - usual_log))
    assert found.low < found.factor < found.high
    assert (found.probability > 0.5) is is_cause


@pytest.mark.parametrize(
    "poor", [NoiseScales(4.0, 0.05, 0.05), NoiseScales(0.3, 9.0, 1.0), NoiseScales(1.0, 0.1, 20.0)]
)
def test_how_random_the_motion_is_does_not_hang_on_where_its_search_begins(model, poor):
    """Far from the likeliest factors the likelihood is not curved downwards, and one step leads nowhere."""
    left, spread = model.unpredicted_errors, model.settings.noise.scale_spread
    noise = model.reference_noise.scaled(poor)
    log, error = motion_scale_log(noise, poor, left, model.motion, model.session, spread)
    known_log, known_error = model.motion_noise_log()
    assert log == pytest.approx(known_log, abs=0.1 * known_error)
    assert error == pytest.approx(known_error, rel=0.05)


def growing_noise(usual, share):
    """The noise of `steady_spread`, of which a share of the variance grows with the square of the way ahead."""
    noise = known_noise()
    growth = np.column_stack([(1 - share) * noise.growth[:, 0], share * noise.growth[:, 0], np.zeros(3)])
    return replace(noise, usual=usual, growth=growth)


def halved(moment):
    """Where vehicles go half as far as simulated."""
    return exp_map(0.5 * moment.way)


@pytest.mark.parametrize(
    ("share", "factor", "is_cause"),
    [(1.0, 0.5, False), (1.0, 1.0, False), (1.0, 2.0, True), (0.0, 1.0, False), (0.0, 1.3, True)],
)
def test_noise_that_goes_with_the_motion_or_with_the_command_is_no_cause_beside_a_lower_speed(
    robots, share, factor, is_cause
):
    """Vehicles go half as far as simulated: noise that grows may be half as large, or as ever."""
    base, rng = ExactBase(robots["mgr"]), np.random.default_rng(4)
    ahead = torch.zeros(1)

    def spread(way):  # of the simulated way, twice the real one
        return (
            torch.tensor(SPREAD, dtype=torch.float64)
            * factor
            * torch.sqrt(1 - share + share * (2 * way[:, :1] / ahead) ** 2)
        )

    commands = rng.uniform(base.robot.command_low, base.robot.command_high, (4000, 2))
    usual = np.sqrt((base.twist(torch.as_tensor(commands)).numpy()[:, [0, 2]] ** 2).mean(axis=0))
    ahead = float(usual[0])
    session = session_of(base, rng, halved, spread=spread, runs=60, steps=40)
    slower = [mechanism_class("gain_change").at({"gain": 0.5})]
    model = SessionLikelihood(base, growing_noise(usual, share), session).explained_by(slower)
    assert expected_noise_log(model, slower) == pytest.approx(share * math.log(2) / 2, abs=0.05)
    assert expected_noise_log(model, []) == 0.0
    found = motion_noise_change(model, slower, float)
    assert (found.probability > 0.5) is is_cause


@pytest.mark.parametrize(
    ("name", "values", "leaves_motion"),
    [
        ("marker_yaw", {"angle_rad": 0.1}, True),
        ("camera_scale", {"scale": 1.0}, True),
        ("command_loss", {"probability": 0.02}, True),
        ("gain_change", {"gain": 1.0}, False),
        ("command_delay", {"delay_s": 0.05}, False),
    ],
)
def test_noise_beside_causes_that_leave_the_motion_as_it_is_is_known_as_well_as_alone(
    model, name, values, leaves_motion
):
    settings = model.settings.motion_noise
    alone, beside = (usual_noise_spread(model, mechanisms) for mechanisms in ([], [mechanism_class(name).at(values)]))
    more = 0.0 if leaves_motion else settings.usual_spread_beside**2 - settings.usual_spread**2
    assert beside**2 - alone**2 == pytest.approx(more, abs=2e-4)
