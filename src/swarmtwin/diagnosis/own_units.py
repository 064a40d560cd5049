"""Step 4. What vehicles that are not known by themselves do otherwise by fabrication: it is told, and no gap."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from swarmtwin.diagnosis.estimation import estimate
from swarmtwin.diagnosis.likelihood import SessionLikelihood, arriving, loses_commands
from swarmtwin.diagnosis.random_effects import RandomEffects
from swarmtwin.diagnosis.result import UnitDifference, UnitFactor
from swarmtwin.robot import Robot
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.mechanism import Mechanism, Parameter, offered
from swarmtwin.simulation.mechanisms import gain_change


def unit_differences(model: SessionLikelihood, causes: Sequence[Mechanism]) -> tuple[UnitDifference, ...]:
    """Return how far each vehicle that is not known by itself goes and turns, over what is simulated.

    By the likeliest sizes of the random effects of units beside the causes that are named, and how sure these are; over
    all of the session's motion, least squares.
    """
    if not model.unknown_vehicles:
        return ()
    effects = model.effects if loses_commands([type(one) for one in causes]) else model.effects_with(causes)
    directions, sizes = model.unit_directions, effects.sizes(model.evaluate(causes).whitened)
    motion = model.predictor.twist(arriving(causes)).numpy()
    transitions, usual, told = model.session.transitions, model.unit_spread.of, []
    for vehicle in model.unknown_vehicles:
        own = transitions.vehicle == transitions.vehicles.index(vehicle)
        way, turn = (
            _factor(effects, sizes, directions[own, axis], motion[own, axis], usual(name))
            for axis, name in ((0, "ahead"), (2, "turn"))
        )
        sides, actuation = None, model.robot.actuation
        if actuation.kind == "wheel" and not actuation.steering and (track_mm := model.session.conditions.track_mm):
            turned = -motion[own, 0] / track_mm  # a left wheel that is faster turns it to the right
            sides = _factor(effects, sizes, directions[own, 2], turned, usual("left_to_right"))
        told.append(UnitDifference(vehicle=vehicle, way=way, turn=turn, left_to_right=sides))
    return tuple(told)


def _factor(
    effects: RandomEffects, sizes: np.ndarray, directions: np.ndarray, motion: np.ndarray, usual: float
) -> UnitFactor:
    """Return the factor on motion (n,) along one axis that sizes (K,) of effects with directions (n, k) amount to."""
    count = directions.shape[1]
    share = motion @ directions / max(float(motion @ motion), 1e-12)
    value = 1.0 + float(share @ sizes[:count])
    half = 1.96 * math.sqrt(float(share @ effects.inverse[:count, :count] @ share))
    return UnitFactor(value=value, low=value - half, high=value + half, unit="", usual=usual)


class OwnGain(gain_change.Config):
    """What a unit does faster or slower by fabrication: it goes by one factor and turns by another."""

    @classmethod
    def parameters_of(cls, robot: Robot, conditions: SessionConditions) -> Mapping[str, Parameter]:
        """Return both factors."""
        gain = cls.parameters["gain"]
        return {"gain": gain, "turning": gain}


def with_own_unit(
    causes: tuple[Mechanism, ...], model: SessionLikelihood, alone: SessionLikelihood
) -> tuple[Mechanism, ...]:
    """Return causes, and beside them what a vehicle does otherwise by fabrication, if the reference does not know it.

    That is no cause, but without it a simulation extended by them would be one of another vehicle.

    Args:
        causes: with values from which they are estimated anew.
        model: of the session.
        alone: of the same session, no unit expected to differ.
    """
    if len(model.unknown_vehicles) != 1 or len(model.session.transitions.vehicles) != 1:
        return causes
    kinds = offered(model.robot, model.session.conditions) | {"gain_change": OwnGain}
    known = {one.name for one in causes}
    own = [
        kinds[name].at(_doing_nothing(kinds[name], model))
        for name in ("gain_change", "actuator_asymmetry")
        if name in kinds and name not in known
    ]
    return estimate(alone, [*causes, *own]).mechanisms


def _doing_nothing(kind: type[Mechanism], model: SessionLikelihood) -> dict[str, float]:
    parameters = kind.parameters_of(model.robot, model.session.conditions)
    return {name: one.null_value for name, one in parameters.items() if one.null_value is not None}
