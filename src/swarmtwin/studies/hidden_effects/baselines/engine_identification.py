"""System identification by `mujoco.sysid`: the true rigid-body model, all its parameters free, fitted to the session."""

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from io import StringIO
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import norm

from swarmtwin.errors import UserError
from swarmtwin.geometry import displacement_between, wrap_angle
from swarmtwin.recordings.recording import Recording
from swarmtwin.robot import Robot
from swarmtwin.standin.active_effects import ActiveEffects
from swarmtwin.standin.effect import Effect
from swarmtwin.standin.effects import parse_effects
from swarmtwin.standin.physics import Period
from swarmtwin.standin.rigid_body.driving import machine_of
from swarmtwin.standin.rigid_body.machine import Machine
from swarmtwin.standin.session import DrivenSession, StandInSession
from swarmtwin.studies.hidden_effects.baselines.recorded_poses import recorded_poses


def load_identification() -> Any:
    """Return `mujoco.sysid`.

    Raises:
        UserError: MuJoCo is not installed, or what its toolbox needs beside it.
    """
    if find_spec("mujoco") is None or find_spec("absl") is None:
        raise UserError("mujoco.sysid needs MuJoCo and absl: pip install 'mujoco>=4.0.0,<5' absl-py")
    return importlib.import_module("mujoco.sysid")


def is_identification_available() -> bool:
    """Return whether `mujoco.sysid` can be used here."""
    try:
        return hasattr(load_identification(), "optimize")
    except UserError:
        return False


class Freedom(NamedTuple):
    """A parameter of the model: its nominal value, its bounds, and by how much it is changed to see what that does."""

    nominal: float
    low: float
    high: float
    step: float


FACTORS: dict[str, tuple[str, ...]] = {
    "mgr": (
        *("left_motor", "right_motor", "left_radius", "right_radius", "left_friction", "right_friction"),
        *("track", "mass", "rotor", "caster_grip", "tyre_grip", "resistance"),
    ),
    "mur": (
        *("mass", "drag", "stiffness", "chord", "span", "trim"),
        *("servo_gain", "servo_damping", "bend_damping", "plate_mass", "tail_mass", "setting_s"),
    ),
}
"""Properties of each body that are free, over their true values. A gear and a voltage would be the motors' over again."""

SETTING: dict[str, Freedom] = {
    "carried_x_mm_s": Freedom(0.0, -60.0, 60.0, 0.5),
    "carried_y_mm_s": Freedom(0.0, -60.0, 60.0, 0.5),
    "marker_forward_mm": Freedom(0.0, -90.0, 90.0, 1.0),
    "marker_left_mm": Freedom(0.0, -90.0, 90.0, 1.0),
    "marker_rad": Freedom(0.0, -1.2, 1.2, 0.01),
    "camera_gain": Freedom(1.0, 0.51, 1.9, 0.01),
    "delay_s": Freedom(0.0, 0.0, 0.45, 0.005),
}
"""What is free beside the body: the velocity of floor or water, where the marker sits, and what the toolbox knows as
gains of sensors and delays of controls."""

Contrast = Mapping[str, float]

NAMES: dict[str, dict[str, Sequence[Contrast]]] = {
    "mgr": {
        "gain_change": [{"left_radius": 0.5, "right_radius": 0.5}],
        "actuator_asymmetry": [{"left_motor": 1.0, "right_motor": -1.0}],
        "dead_band": [{"left_friction": 0.5, "right_friction": 0.5}],
        "actuator_lag": [{"rotor": 1.0}],
    },
    "mur": {
        "gain_change": [{"chord": 0.5, "span": 0.5}],
        "actuator_asymmetry": [{"trim": 1.0}],
        "actuator_lag": [{"setting_s": 1.0}],
    },
}
"""Which cause a change of the body is: of each cause the sums of parameters that tell of it."""

NAMES_OF_SETTING: dict[str, Sequence[Contrast]] = {
    "steady_drift": [{"carried_x_mm_s": 1.0}, {"carried_y_mm_s": 1.0}],
    "marker_offset": [{"marker_forward_mm": 1.0}, {"marker_left_mm": 1.0}],
    "marker_yaw": [{"marker_rad": 1.0}],
    "camera_scale": [{"camera_gain": 1.0}],
    "command_delay": [{"delay_s": 1.0}],
}


@dataclass(frozen=True)
class Identified:
    """What was identified.

    Attributes:
        values: of each parameter.
        causes: that it names, the surest first.
        displacement: (R, T, V, 3) predicted for every row, NaN where its pose was not seen.
    """

    values: dict[str, float]
    causes: tuple[str, ...]
    displacement: np.ndarray


@dataclass(frozen=True)
class EngineIdentification:
    """The least-squares problem: one-step predictions of a rigid-body model with P free parameters.

    The model is the true one, of the very unit; its state is carried through each run by itself, and its pose is set to
    the measured one each period. Effects' names are given to what differs significantly from the true model.

    Attributes:
        session: what was recorded; who drove is known, effects are not looked at.
        driven: its commands and its clock.
        measured: (R, T + 1, V, 3) poses as recorded, NaN where there is none.
        significance: at which anything is named, over all causes together.
        iterations: of the toolbox's optimiser at most.
    """

    session: StandInSession
    driven: DrivenSession
    measured: np.ndarray
    significance: float = 0.003
    iterations: int = 4

    @classmethod
    def of(cls, driven: DrivenSession, recording: Recording, iterations: int = 4) -> "EngineIdentification":
        """Take a session and its recording."""
        return cls(driven.session, driven, recorded_poses(driven, recording), iterations=iterations)

    @property
    def robot(self) -> Robot:
        """The robot."""
        return self.session.robot

    @cached_property
    def freedoms(self) -> dict[str, Freedom]:
        """The P parameters."""
        return {name: Freedom(1.0, 0.2, 4.0, 0.02) for name in FACTORS[self.robot.name]} | SETTING

    @cached_property
    def nominal(self) -> np.ndarray:
        """The true model's parameters (P,)."""
        return np.array([freedom.nominal for freedom in self.freedoms.values()])

    @cached_property
    def steps(self) -> np.ndarray:
        """By how much parameters (P,) are changed: the toolbox is given them in these units, from their nominals."""
        return np.array([freedom.step for freedom in self.freedoms.values()])

    def machine(self, values: np.ndarray) -> Machine:
        """Return the model with parameters (P,)."""
        named = dict(zip(self.freedoms, values.tolist(), strict=True))
        body = {name: named[name] for name in FACTORS[self.robot.name]}
        unit = machine_of(StandInSession(self.robot, self.session.vehicles, 1, 1, 0))
        return unit.altered(body, self._setting(named))

    def _setting(self, named: dict[str, float]) -> Sequence[Effect]:
        """Return floor, marker, camera and link with some parameters; what is nominal is left out."""
        x_mm_s, y_mm_s = named["carried_x_mm_s"], named["carried_y_mm_s"]
        entries = [
            {
                "name": "steady_drift",
                "speed_mm_s": max(float(np.hypot(x_mm_s, y_mm_s)), 1e-9),
                "direction_rad": float(np.arctan2(y_mm_s, x_mm_s)),
            },
            {"name": "marker_offset", "forward_mm": named["marker_forward_mm"], "left_mm": named["marker_left_mm"]},
            {"name": "marker_yaw", "angle_rad": named["marker_rad"]},
            {"name": "camera_scale", "scale": named["camera_gain"]},
            {"name": "command_delay", "delay_s": max(named["delay_s"], 1e-9)},
        ]
        return parse_effects(entries, self.robot, len(self.session.vehicles))

    def predicted(self, values: np.ndarray, runs: np.ndarray) -> np.ndarray:
        """Return the displacements (runs, T, V, 3) that the model expects of some runs, as the camera would see them."""
        machine, measured = self.machine(values), self.measured[runs]
        seen = machine.conditions.seen
        pose = _unseen(machine.conditions, np.where(np.isfinite(measured[:, 0]), measured[:, 0], 0.0))
        state = machine.put(pose)
        active = np.empty((len(machine.resting_command), *state.shape[1:]))
        active[:] = np.reshape(machine.resting_command, (-1, 1, 1))
        calm = np.zeros((machine.pieces, machine.noises, *state.shape[1:]))
        displacements = []
        for step in range(self.session.steps):
            command = np.moveaxis(self.driven.command[runs, step], -1, 0)
            duration_s = np.diff(self.driven.time_s[runs, step : step + 2])
            state = machine.advance(state, Period(command, active, duration_s, np.zeros_like(duration_s)), calm)
            active, expected = command, np.moveaxis(state[:3], 0, -1)
            displacements.append(displacement_between(measured[:, step], seen(expected)))
            shown = measured[:, step + 1]
            known = np.isfinite(shown).all(axis=-1, keepdims=True)
            pose = np.where(known, _unseen(machine.conditions, np.where(known, shown, expected)), expected)
            state = machine.carried_to(pose, state)
        return np.stack(displacements, axis=1)

    def identify(self, runs: np.ndarray, most_transitions: int = 600) -> Identified:
        """Fit all parameters to the first of some runs, as many as have so many transitions; predict all runs."""
        sysid = load_identification()
        fitted = runs[: max(8, most_transitions // (self.session.steps * len(self.session.vehicles)))]
        measured = displacement_between(self.measured[fitted, :-1], self.measured[fitted, 1:])
        at_nominal = _apart(self.predicted(self.nominal, fitted), measured)
        known = np.isfinite(at_nominal).all(axis=-1)
        usual = 1.4826 * np.median(np.abs(at_nominal[known]), axis=0)

        def residual(shifts: np.ndarray, _: Any) -> tuple[list[np.ndarray], list[Any], list[Any]]:
            columns = shifts.reshape(len(self.nominal), -1).T
            apart = [
                (_apart(self.predicted(self.nominal + self.steps * one, fitted), measured)[known] / usual).ravel()
                for one in columns
            ]
            return [np.stack(apart, axis=-1) if shifts.ndim > 1 else apart[0]], [], []

        parameters = sysid.ParameterDict()
        for name, freedom in self.freedoms.items():
            low, high = ((bound - freedom.nominal) / freedom.step for bound in (freedom.low, freedom.high))
            parameters.add(sysid.Parameter(name, max(0.0, low + 1.0 if low >= 0 else low), low, high))  # the toolbox dislikes a bound
        _, found = sysid.optimize(
            parameters, residual, verbose=False, output=StringIO(), eps=0.5, max_iters=self.iterations, xtol=0.05
        )
        shifts = np.asarray(found.x).ravel()
        at_best, _, _ = residual(shifts, parameters)
        covariance, _ = sysid.calculate_intervals(at_best, np.asarray(found.jac))
        values = self.nominal + self.steps * shifts
        everything = np.arange(len(self.measured))
        named = dict(zip(self.freedoms, values.tolist(), strict=True))
        causes = self._causes(shifts, np.asarray(covariance))
        return Identified(named, causes, self.predicted(values, everything))

    def _causes(self, shifts: np.ndarray, covariance: np.ndarray) -> tuple[str, ...]:
        """Return the causes whose sums of parameters differ from nominal by more than chance, the surest first."""
        causes = {**NAMES[self.robot.name], **NAMES_OF_SETTING}
        tests = sum(len(sums) for sums in causes.values())
        least_z, order = float(norm.isf(self.significance / tests / 2)), list(self.freedoms)
        strongest: dict[str, float] = {}
        for name, sums in causes.items():
            for parts in sums:
                weights = np.zeros(len(shifts))
                for parameter, weight in parts.items():
                    weights[order.index(parameter)] = weight
                z = abs(float(weights @ shifts)) / np.sqrt(float(weights @ covariance @ weights))
                strongest[name] = max(strongest.get(name, 0.0), z)
        outside = [name for name, z in strongest.items() if z > least_z]
        return tuple(sorted(outside, key=lambda name: -strongest[name]))


def _apart(predicted: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Return how far predicted displacements (..., 3) are from measured ones."""
    apart: np.ndarray = predicted - measured
    return np.concatenate([apart[..., :2], wrap_angle(apart[..., 2:])], axis=-1)


def _unseen(conditions: ActiveEffects, shown: np.ndarray, rounds: int = 4) -> np.ndarray:
    """Return the poses (..., 3) that a camera without noise shows as these."""
    pose = shown.copy()
    for _ in range(rounds):
        pose = pose + _apart(shown, conditions.seen(pose))
    return pose
