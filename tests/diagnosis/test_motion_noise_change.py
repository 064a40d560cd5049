"""Whether the motion is more random than the reference's: what the reference's own shows is no change."""

import math

import numpy as np
import pytest
import torch
from exact_base import SPREAD, ExactBase, as_simulated, known_noise, session_of

from swarmtwin.diagnosis.likelihood import SessionLikelihood
from swarmtwin.diagnosis.motion_noise_change import motion_noise_change


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
