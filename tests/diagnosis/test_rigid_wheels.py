"""Lags and play of a rigid body's car, whose gears have friction and motors a curve that no formula of ours has."""

import numpy as np
import pytest

from swarmtwin.diagnosis.cause_report import reported_parameters
from swarmtwin.diagnosis.estimation import estimate, with_further_uncertainty
from swarmtwin.diagnosis.reference import Reference
from swarmtwin.simulation.mechanism import mechanism_class
from swarmtwin.standin.effects import parse_effects
from swarmtwin.standin.session import StandInSession
from swarmtwin.studies.stand_in_recording import record
from swarmtwin.transitions import from_recording

pytest.importorskip("mujoco")

from swarmtwin.standin.rigid_body.driving import drive_rigid_session

pytestmark = pytest.mark.claims
SEED = 20261130
"""Of both sessions: chosen when the law of friction was ready, for which others had been looked at."""


def driven(robot, seed, *effects):
    session = StandInSession(robot, ("1",), 100, 40, seed, parse_effects(effects, robot, 1))
    return record(session, drive=drive_rigid_session)[1]


@pytest.fixture(scope="module")
def reference(robots):
    return Reference.learn(from_recording(driven(robots["mgr"], SEED))[0], 0)


def test_friction_is_seen_in_the_reference_and_not_exaggerated(reference):
    """By the drawing, 0.0017 N·m of bearings slow a wheel by 9.6 mm/s, beside what the caster takes.

    It is read too small, by an amount that differs from one reference to the other, since what was learned of wheels
    that stop is smoother than they are: as 4.1 mm/s here.
    """
    assert 2 < reference.session.conditions.gear_friction_mm_s < 12


@pytest.mark.parametrize("lag_s", [0.015, 0.03, 0.06])
def test_an_added_lag_is_told_within_a_tenth_or_2_ms_and_its_interval_holds_it(robots, reference, lag_s):
    """The shortest one was told as 0.0151 s and, on another processor, whose rounding learns otherwise, as 0.0135 s."""
    measured = driven(robots["mgr"], SEED + 1, {"name": "actuator_lag", "time_constant_s": lag_s})
    session, _, _ = reference.comparable(measured)
    model = reference.likelihood_of(session)
    found = estimate(model, [mechanism_class("actuator_lag").at({"time_constant_s": 0.05})], polish=True)
    told = reported_parameters(model, found, np.random.default_rng(0))["actuator_lag"]["time_constant_s"]
    assert told.value == pytest.approx(lag_s, rel=0.1, abs=0.002)
    assert told.low <= lag_s <= told.high


@pytest.mark.parametrize("travel_mm", [0.8, 1.6, 2.7, 4.2])
def test_play_is_told_too_small_by_less_than_a_quarter_and_its_interval_holds_it(robots, reference, travel_mm):
    """A motor that takes up the play runs without its wheel, and so faster than any mechanism knows."""
    measured = driven(robots["mgr"], SEED + 1, {"name": "backlash", "travel_mm": travel_mm})
    session, _, _ = reference.comparable(measured)
    model = reference.likelihood_of(session)
    begun = mechanism_class("backlash").at({"travel_mm": 2.0, "coasting_mm": 1.0})
    found = with_further_uncertainty(model, estimate(model, [begun], polish=True, final=True))
    told = reported_parameters(model, found, np.random.default_rng(0))["backlash"]["travel_mm"]
    assert 0.75 * travel_mm < told.value < 1.05 * travel_mm
    assert told.low <= travel_mm <= told.high
