"""Sessions of several units of a robot whose wheels differ."""

import dataclasses

import numpy as np
import torch
from exact_base import SPREAD, ExactBase, known_noise, session_of

from exact_model import TRACK_MM
from swarmtwin.diagnosis.measured_session import MeasuredSession
from swarmtwin.diagnosis.settings import UnitSettings
from swarmtwin.diagnosis.unit_spread import ReferenceUnits
from swarmtwin.geometry import displacement_between, exp_map, log_map
from swarmtwin.simulation.efforts import twist_of_wheels, wheel_travel


def of_wheels(left, right):
    """A unit whose wheels are so much faster; one factor each, or one for each run."""
    factor = torch.tensor(np.stack(np.broadcast_arrays(left, right), axis=-1), dtype=torch.float64).reshape(-1, 2)

    def moved(moment):
        wheels = wheel_travel(moment.way, TRACK_MM) * factor
        return exp_map(twist_of_wheels(wheels, moment.way, TRACK_MM))

    return moved


def fleet_session(robot, units, spread, seed, runs=12, in_turn=True, noise=1.0, about=None, unlike=None):
    """A session of several units, so many runs of each, whose left and right wheels' speeds spread as said.

    Their mean is `about`, or else as it was drawn. Of the last one both wheels are `unlike` times as fast beside that.
    """
    base, rng = ExactBase(robot), np.random.default_rng(seed)
    number = np.arange(runs * units)
    vehicle = number % units if in_turn else number // runs
    own = 1 + spread * rng.normal(size=(units, 2))
    if about is not None:
        own += about - own.mean(axis=0)
    if unlike is not None:
        own[-1] *= unlike
    drawn = noise * torch.tensor(SPREAD, dtype=torch.float64)
    session = session_of(base, rng, of_wheels(*own[vehicle].T), runs=len(number), spread=lambda way: drawn)
    transitions = dataclasses.replace(
        session.transitions,
        vehicle=vehicle[session.run],
        vehicles=tuple(str(unit + 1) for unit in range(units)),
    )
    return base, MeasuredSession.of(transitions, session.conditions)


def shown_by(base, session, prior_units=2.0):
    twist = base.twist(session.situation.command)
    settings = UnitSettings(prior_units=prior_units)
    return ReferenceUnits.estimate(base, known_noise(), errors_of(base, session), session, twist, settings)


def errors_of(base, session):
    """From where a base leads to where units were measured."""
    measured = torch.as_tensor(session.transitions.displacement)
    return log_map(displacement_between(exp_map(base.twist(session.situation.command)), measured)).numpy()
