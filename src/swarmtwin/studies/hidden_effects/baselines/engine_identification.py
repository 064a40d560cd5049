"""System identification by `mujoco.sysid`: the true rigid-body model, all its parameters free, fitted to a session."""

import importlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from io import StringIO
from typing import Any

import numpy as np

from swarmtwin.diagnosis.settings import SearchSettings
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
from swarmtwin.studies.hidden_effects.baselines.engine_parameters import BODY, SETTING, Freedom, Reading, readings
from swarmtwin.studies.hidden_effects.baselines.recorded_poses import recorded_poses


def load_identification() -> Any:
    """Return `mujoco.sysid`.

    Raises:
        UserError: MuJoCo is not installed, or not with what its toolbox needs.
    """
    try:
        toolbox = importlib.import_module("mujoco.sysid")
    except ImportError:
        toolbox = None
    if not hasattr(toolbox, "optimize"):  # without what it needs it is there, and empty
        raise UserError(
            "mujoco.sysid, which family 'rigid_body' is compared with, is not installed: "
            "pip install 'mujoco[sysid]>=4.0.0,<5', or true_model.quick=0 true_model.full=0"
        )
    return toolbox


def is_identification_available() -> bool:
    """Return whether `mujoco.sysid` can be used here."""
    try:
        load_identification()
    except UserError:
        return False
    return True


@dataclass(frozen=True)
class Identified:
    """What was identified.

    Attributes:
        values: of each of the P parameters.
        causes: that it names, the first found first, with their parameters.
    """

    values: dict[str, float]
    causes: dict[str, dict[str, float]]


@dataclass(frozen=True)
class EngineIdentification:
    """The least-squares problem: one-step predictions of a rigid-body model with P free parameters.

    The model is the true one, of the very unit; its state is carried through each run by itself, and its pose is set to
    the measured one each period. What the toolbox finds is read as the fewest causes that change the model so, and read
    again where these are, since the equations are not linear.

    Attributes:
        session: what was recorded; who drove is known, effects are not looked at.
        driven: its commands and its clock.
        measured: (R, T + 1, V, 3) poses as recorded, NaN where there is none.
        transitions: fitted to, those of the first runs: about as many as fit into a minute.
        iterations: of the toolbox's optimiser at most.
        most_causes: that are named.
        search: settings of the diagnosis' own search: the prior of a cause.
    """

    session: StandInSession
    driven: DrivenSession
    measured: np.ndarray
    transitions: int = 600
    iterations: int = 2
    most_causes: int = 4
    search: SearchSettings = field(default_factory=SearchSettings)

    @classmethod
    def of(cls, driven: DrivenSession, recording: Recording) -> "EngineIdentification":
        """Take a session and its recording."""
        return cls(driven.session, driven, recorded_poses(driven, recording))

    @property
    def robot(self) -> Robot:
        """The robot."""
        return self.session.robot

    @property
    def body(self) -> tuple[str, ...]:
        """Properties of the body that are free."""
        return tuple(BODY[self.robot.name])

    @cached_property
    def freedoms(self) -> dict[str, Freedom]:
        """The P parameters."""
        return {**BODY[self.robot.name], **SETTING[self.robot.name]}

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
        body = {name: named[name] for name in self.body}
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
        if "stroke" in named:
            entries.append({"name": "gain_change", "gain": named["stroke"]})
        if "voltage_ratio" in named:
            entries.append({"name": "actuator_asymmetry", "ratio": named["voltage_ratio"]})
        return parse_effects(entries, self.robot, len(self.session.vehicles))

    def predicted(self, values: np.ndarray, runs: np.ndarray) -> np.ndarray:
        """Return the displacements (runs, T, V, 3) that the model expects of some runs, as the camera sees them."""
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

    def identify(self) -> Identified:
        """Fit all parameters to the first runs, and read what was found.

        Raises:
            UserError: the toolbox is not installed.
        """
        toolbox = load_identification()
        runs = np.arange(min(len(self.measured), self._runs_fitted()))
        measured = displacement_between(self.measured[runs, :-1], self.measured[runs, 1:])
        at_nominal = _apart(self.predicted(self.nominal, runs), measured)
        known = np.isfinite(at_nominal).all(axis=-1)
        usual = 1.4826 * np.median(np.abs(at_nominal[known]), axis=0)

        def residual(shifts: np.ndarray, _: Any) -> tuple[list[np.ndarray], list[Any], list[Any]]:
            columns = shifts.reshape(len(self.nominal), -1).T
            values = self.nominal + self.steps * columns
            apart = [(_apart(self.predicted(one, runs), measured)[known] / usual).ravel() for one in values]
            return [np.stack(apart, axis=-1) if shifts.ndim > 1 else apart[0]], [], []

        parameters = self._parameters(toolbox)
        _, found = toolbox.optimize(
            parameters, residual, verbose=False, output=StringIO(), eps=0.5, max_iters=self.iterations, xtol=0.05
        )
        shifts = np.asarray(found.x).ravel()
        values = dict(zip(self.freedoms, (self.nominal + self.steps * shifts).tolist(), strict=True))
        (left,), _, _ = residual(shifts, parameters)
        by_period = np.zeros((*known.shape, 3))
        by_period[known] = left.reshape(-1, 3)
        variance = float(left @ left) / (len(left) - len(shifts)) * _inflation(by_period)
        jacobian = np.asarray(found.jac)
        nearest = self._shifts(self._read(jacobian, jacobian @ shifts - left, variance))
        (left,), _, _ = residual(nearest, parameters)
        (nudged,), _, _ = residual(nearest[:, None] + 0.5 * np.eye(len(shifts)), parameters)
        jacobian = (nudged - left[:, None]) / 0.5
        read = self._read(jacobian, jacobian @ nearest - left, variance)
        return Identified(values, {reading.name: reading.told(sizes) for reading, sizes in read})

    def _runs_fitted(self, least: int = 8) -> int:
        return max(least, self.transitions // (self.session.steps * len(self.session.vehicles)))

    def _parameters(self, toolbox: Any) -> Any:
        """Return the toolbox's parameters: shifts from nominal, begun there, but a step off a bound."""
        parameters = toolbox.ParameterDict()
        for name, freedom in self.freedoms.items():
            low, high = ((bound - freedom.nominal) / freedom.step for bound in (freedom.low, freedom.high))
            parameters.add(toolbox.Parameter(name, max(0.0, low + 1.0), low, high))
        return parameters

    def _read(self, jacobian: np.ndarray, wanted: np.ndarray, variance: float) -> list[tuple[Reading, np.ndarray]]:
        """Return the fewest causes that do to the model what was found, with their sizes, the first found first.

        A cause is worth its name where it gains more nats than its prior costs, and half a log of the number of
        residuals for each of its parameters.

        Args:
            jacobian: (N, P) of the residuals, by shifts.
            wanted: (N,) by how much they must change, from the nominal model on.
            variance: of the residuals.
        """
        price = -np.log(self.search.prior / (1.0 - self.search.prior))
        chosen: list[Reading] = []
        sizes, left = np.empty(0), float(wanted @ wanted)
        while len(chosen) < self.most_causes:
            tried = []
            for reading in readings(self.robot.name):
                if reading.name not in [one.name for one in chosen]:
                    own_sizes, own_left = self._fit([*chosen, reading], jacobian, wanted)
                    cost = price + 0.5 * len(reading.directions) * np.log(len(wanted))
                    tried.append((0.5 * (left - own_left) / variance - cost, reading, own_sizes, own_left))
            gained, reading, own_sizes, own_left = max(tried, key=lambda one: one[0])
            if gained <= 0:
                break
            chosen.append(reading)
            sizes, left = own_sizes, own_left
        parts = np.split(sizes, np.cumsum([len(reading.directions) for reading in chosen]))
        return list(zip(chosen, parts, strict=False))

    def _directions(self, reading: Reading) -> np.ndarray:
        """Return the shifts (P, k) by one unit of each size of a cause."""
        weights = [[direction.get(name, 0.0) for name in self.freedoms] for direction in reading.directions]
        return np.array(weights).T / self.steps[:, None]

    def _shifts(self, read: Sequence[tuple[Reading, np.ndarray]]) -> np.ndarray:
        """Return the shifts (P,) by causes of some sizes, within the parameters' bounds."""
        shifts = sum((self._directions(reading) @ sizes for reading, sizes in read), np.zeros(len(self.freedoms)))
        low, high = np.array([(freedom.low, freedom.high) for freedom in self.freedoms.values()]).T
        return np.clip(shifts, (low - self.nominal) / self.steps, (high - self.nominal) / self.steps - 1.0)

    def _fit(self, chosen: Sequence[Reading], jacobian: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the sizes of causes that come nearest to what is wanted, and the squared distance that is left."""
        design = jacobian @ np.concatenate([self._directions(reading) for reading in chosen], axis=-1)
        least = np.concatenate([np.full(len(reading.directions), reading.least) for reading in chosen])
        sizes = np.maximum(np.linalg.lstsq(design, wanted, rcond=None)[0], least)
        return sizes, float(((wanted - design @ sizes) ** 2).sum())


def _inflation(residual: np.ndarray, lags: int = 4) -> float:
    """Return by how much residuals (R, T, V, 3) that follow each other vary more, in sums, than independent ones."""
    size = float((residual**2).sum())
    products = [float((residual[:, lag:] * residual[:, :-lag]).sum()) for lag in range(1, lags + 1)]
    return max(1.0, 1.0 + 2.0 * sum(products) / size)


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
