"""The watching simulation: whether what each vehicle does is what the registered simulation expects.

Each period's residual is standardised by the motion's noise; by what units differ where nothing is wrong, a constant of
each vehicle, with a prior of the units' spread; and by what the simulation itself errs here and now, which persists
while vehicles go on alike. The latter two are estimated on the way (a Kalman filter), so that the innovations are
independent from period to period, with the tails of a t distribution.

What may be wrong is named beforehand: all speeds, one of them, or one wheel have changed by some share, or the vehicle
follows its commands gradually. Each of these alternatives has a detector of Shiryaev and Roberts, M ← (1 + M)·e, where
e is the likelihood ratio of the innovation; one more takes what is none of them, by the e-value of the innovation's
p-value (the calibrator ∫κp^(κ−1)dκ of Vovk and Sellke). Since each e is 1 on average where nothing is wrong, the
detectors' mean reaches A no earlier than after A periods on average (Shin, Ramdas and Rinaldo, E-detectors, 2022).

What was wrong from the beginning is taken for a unit's own difference at first. So each of the same changes is also
weighed from the first period on, by the likelihood ratio of all that was measured with the unit's prior centred there
instead of at no difference: a filter with the same gains, and another mean. That pools what speeds and turns say alike.
The mean of these ratios is a martingale of mean 1 where the prior holds, so it ever reaches 1/α with a probability of
at most α (Ville). The estimate of the difference is a martingale, too; it passes the distance at which fabrication is
no explanation any more with a probability that is at most twice that of a unit to lie there.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from scipy import stats

from swarmtwin.deploy.control.settings import WatchSettings
from swarmtwin.geometry import log_map, wrap_angle
from swarmtwin.simulation.efforts import twist_of_wheels, wheel_travel
from swarmtwin.simulation.simulation import Simulation


class Expectation:
    """Compares measured with expected displacements of V vehicles, period by period.

    Attributes:
        limit: the average number of periods between false alarms.
        z: (V, 3) the last standardised innovations, forward, left, turn; NaN where there was none.
        rung: (V,) how often each alarm has begun.
        is_severe: (V,) whether it is under alarm and has long moved far otherwise than expected.
    """

    def __init__(self, simulation: Simulation, vehicles: Sequence[str], settings: WatchSettings) -> None:
        count = len(vehicles)
        self.limit = settings.periods_between_false_alarms
        self.z = np.full((count, 3), np.nan)
        self.rung = np.zeros(count, int)
        self.is_severe = np.zeros(count, bool)
        self._simulation = simulation
        self._robot = simulation.robot
        self._settings = settings
        self._vehicles = tuple(vehicles)
        self._far_for = np.zeros(count, int)
        self._is_under = np.zeros(count, bool)
        spread = math.sqrt(2) * (settings.unit_spread or self._robot.unit_spread or settings.usual_unit_spread)
        self._track_mm = simulation.conditions.track_mm or self._robot.actuation.track_mm
        if self._robot.actuation.kind == "wheel" and self._track_mm is None:
            self._track_mm = min(self._robot.vehicle_size_mm)
        self._differences = differences = 4 if self._track_mm else 3
        self._twist_before = np.full((count, 3), np.nan)
        error = settings.simulation_error * np.sqrt(self._usual_variance())
        prior = np.concatenate([np.full(differences, spread), error]) ** 2
        self._kept = np.concatenate([np.ones(differences), np.full(3, settings.error_persists)])
        self._drifts = np.diag((1 - self._kept**2) * prior)
        self._hidden = np.zeros((count, differences + 3))  # of the unit, then the simulation's error here and now
        self._covariance = np.broadcast_to(np.diag(prior), (count, differences + 3, differences + 3)).copy()
        self._alternatives = _alternatives(differences, settings.changes)
        in_all = 2.0 * 2.0 * differences  # two sides, and the martingale's way there (reflection)
        self._strange_unit = spread * stats.norm.isf(settings.unit_alarm_periods / self.limit / in_all)
        self._strange_ratio = self.limit / settings.unit_alarm_periods
        self._since_start = np.zeros((count, differences + 3, self._alternatives.shape[1]))  # less what is learned
        self._since_start[:, :differences] = self._alternatives
        self._log_ratio = np.zeros((count, self._alternatives.shape[1]))
        self._detectors = np.zeros((count, self._alternatives.shape[1] + len(settings.lag_shares) + 1))

    def update(self, expected: np.ndarray, measured: np.ndarray, duration_s: np.ndarray) -> list[int]:
        """Take in one period.

        Args:
            expected: (V, 3) displacements by the simulation.
            measured: (V, 3) displacements, NaN where a vehicle was not seen.
            duration_s: (V,) of these.

        Returns:
            the vehicles (indices) whose alarm begins now.
        """
        known = np.isfinite(measured).all(axis=1) & (duration_s > 0)
        twist = log_map(np.where(known[:, None], expected, 0.0))
        residual = log_map(np.where(known[:, None], measured, 0.0)) - twist
        residual[:, 2] = wrap_angle(residual[:, 2])
        self._pass_period(known)
        shows = self._unit_changes(twist)
        covariance = shows @ self._covariance @ shows.transpose(0, 2, 1)
        covariance[:, range(3), range(3)] += self._variance(twist, duration_s)
        innovation = residual - (shows @ self._hidden[..., None])[..., 0]
        root = np.linalg.cholesky(covariance)
        z = np.linalg.solve(root, innovation[..., None])[..., 0]
        self.z = np.where(known[:, None], z, np.nan)
        evidence = self._evidence(z, np.linalg.solve(root, self._shifts(twist, shows)))
        self._weigh_since_start(known, z, np.linalg.solve(root, shows @ self._since_start))
        grown = ((1 + self._detectors) * evidence).clip(max=1e300)
        self._detectors = np.where(known[:, None], grown, self._detectors)
        self._twist_before = np.where(known[:, None], twist, np.nan)
        self._learn_unit(known, shows, covariance, innovation)
        under = (self.alarm >= self.limit) | self._is_strange
        begun = under & ~self._is_under
        self._is_under = under
        self._judge_severity(known, residual)
        self.rung += begun
        return [int(index) for index in np.flatnonzero(begun)]

    @property
    def alarm(self) -> np.ndarray:
        """The mean of each vehicle's detectors, (V,); a vehicle is under alarm where it reaches `limit`."""
        mean: np.ndarray = self._detectors.mean(axis=1)
        return mean

    def restart(self, vehicles: Sequence[int]) -> None:
        """Begin to watch some vehicles (indices) anew, with what is known of their units."""
        self._detectors[vehicles] = 0.0
        self._log_ratio[vehicles] = -np.inf  # of what was wrong from the beginning there is but one beginning
        self._is_under[vehicles] = False

    @property
    def is_under_alarm(self) -> np.ndarray:
        """Whether each vehicle does not behave as expected, (V,)."""
        return self._is_under

    def words(self, vehicle: int) -> str:
        """Say how a vehicle deviates."""
        ahead, aside, turn = self.z[vehicle]
        return (
            f"vehicle {self._vehicles[vehicle]} does not move as the simulation expects (standard deviations in the "
            f"last period: forward {ahead:+.1f}, left {aside:+.1f}, turn {turn:+.1f}; a false alarm once in "
            f"{self.limit:.0f} periods)"
        )

    def _shifts(self, twist: np.ndarray, shows: np.ndarray) -> np.ndarray:
        """Return by what residuals (V, 3) shift under each alternative, (V, 3, A)."""
        lags = np.array(self._settings.lag_shares)
        change = np.nan_to_num(self._twist_before - twist)
        return np.concatenate([shows[..., : self._differences] @ self._alternatives, change[..., None] * lags], axis=-1)

    def _evidence(self, z: np.ndarray, shifts: np.ndarray) -> np.ndarray:
        """Return the e-values (V, A + 1) of standardised innovations (V, 3), given their shifts (V, 3, A).

        The densities are those of t distributions as wide that in the middle they fall as a normal one does.
        """
        other = _e_value(stats.f.sf((z**2).sum(axis=1)[:, None] / 3, 3, self._settings.tails))
        return np.concatenate([np.exp(self._log_ratios(z, shifts)), other], axis=1)

    def _log_ratios(self, z: np.ndarray, shifts: np.ndarray) -> np.ndarray:
        """Return the logarithms (V, A) of likelihood ratios of innovations (V, 3), given their shifts (V, 3, A)."""
        width = self._settings.tails + 3.0
        here, there = (z**2).sum(axis=1)[:, None], ((z[..., None] - shifts) ** 2).sum(axis=1)
        ratios: np.ndarray = width / 2 * (np.log1p(here / width) - np.log1p(there / width))
        return ratios

    def _weigh_since_start(self, known: np.ndarray, z: np.ndarray, shifts: np.ndarray) -> None:
        """Weigh what may have been wrong from the beginning by innovations (V, 3), given their shifts (V, 3, A)."""
        self._log_ratio = np.where(known[:, None], self._log_ratio + self._log_ratios(z, shifts), self._log_ratio)

    def _unit_changes(self, twist: np.ndarray) -> np.ndarray:
        """Return by what twists (V, 3) change: per unit of each difference, and by the error, (V, 3, D + 3)."""
        changes = [twist[:, axis, None] * np.eye(3)[axis] for axis in range(3)]
        if self._track_mm:
            moved = torch.as_tensor(twist)
            apart = wheel_travel(moved, self._track_mm) * torch.tensor([[0.5, -0.5]], dtype=moved.dtype)
            changes.append(twist_of_wheels(apart, torch.zeros_like(moved), self._track_mm).numpy())
        own = np.broadcast_to(np.eye(3), (len(twist), 3, 3))
        return np.concatenate([np.stack(changes, axis=-1), own], axis=-1)

    def _variance(self, twist: np.ndarray, duration_s: np.ndarray) -> np.ndarray:
        """Return the variance of residual twists (V, 3): of motion, camera and the simulation itself."""
        settings, noise = self._settings, self._simulation.motion_noise
        path2 = (twist[:, :2] ** 2).sum(axis=1)
        least = np.array([settings.least_spread_mm, settings.least_spread_mm, settings.least_spread_rad])
        length2 = np.stack([path2, path2, twist[:, 2] ** 2], axis=1)
        late = np.nan_to_num(self._twist_before - twist) * settings.timing_spread_s / self._robot.period_s
        variance = least**2 + settings.motion_spread**2 * length2 + late**2
        if noise is not None:
            periods = (duration_s / self._robot.period_s)[:, None]
            size2 = (path2 / noise.usual_mm**2 + twist[:, 2] ** 2 / noise.usual_rad**2)[:, None]
            motion = np.array(noise.at_rest) * np.minimum(periods, 4) + np.array(noise.with_motion) * size2
            camera = 2 * np.array(noise.camera)
            variance = variance + self._simulation.noise_factor**2 * motion + camera
            variance[:, :2] += noise.camera[2] * path2[:, None]
        return variance

    def _usual_variance(self) -> np.ndarray:
        """Return the variance of a usual residual twist, (3,)."""
        settings, noise = self._settings, self._simulation.motion_noise
        least = np.array([settings.least_spread_mm, settings.least_spread_mm, settings.least_spread_rad]) ** 2
        return least if noise is None else np.maximum(least, np.add(noise.at_rest, noise.with_motion))

    @property
    def _is_strange(self) -> np.ndarray:
        """Whether a vehicle differs from the one recorded as fabrication does not explain, (V,)."""
        estimated: np.ndarray = np.any(np.abs(self._hidden[:, : self._differences]) > self._strange_unit, axis=1)
        ratio = np.exp(self._log_ratio.clip(max=700)).mean(axis=1)
        return estimated | (ratio >= self._strange_ratio)

    def _pass_period(self, known: np.ndarray) -> None:
        kept = self._kept * self._covariance * self._kept[:, None] + self._drifts
        self._hidden = np.where(known[:, None], self._kept * self._hidden, self._hidden)
        since_start = self._kept[:, None] * self._since_start
        self._since_start = np.where(known[:, None, None], since_start, self._since_start)
        self._covariance = np.where(known[:, None, None], kept, self._covariance)

    def _learn_unit(self, known: np.ndarray, shows: np.ndarray, covariance: np.ndarray, innovation: np.ndarray) -> None:
        gain = np.linalg.solve(covariance, shows @ self._covariance).transpose(0, 2, 1)  # (V, D + 3, 3)
        learned = self._hidden + (gain @ innovation[..., None])[..., 0]
        certain = self._covariance - gain @ shows @ self._covariance
        left = self._since_start - gain @ (shows @ self._since_start)
        self._since_start = np.where(known[:, None, None], left, self._since_start)
        self._hidden = np.where(known[:, None], learned, self._hidden)
        self._covariance = np.where(known[:, None, None], certain, self._covariance)

    def _judge_severity(self, known: np.ndarray, residual: np.ndarray) -> None:
        far_mm = self._settings.severe_share * self._robot.largest_displacement.forward_mm
        far_rad = self._settings.severe_share * self._robot.largest_displacement.turn_rad
        far = (np.hypot(residual[:, 0], residual[:, 1]) > far_mm) | (np.abs(residual[:, 2]) > far_rad)
        self._far_for = np.where(known, np.where(far, self._far_for + 1, 0), self._far_for)
        self.is_severe = (self._far_for >= self._settings.severe_periods) & self._is_under


def _alternatives(differences: int, changes: Sequence[float]) -> np.ndarray:
    """Return what may have changed of a unit, (D, A), by some shares: all speeds, each alone, one wheel."""
    all_speeds = np.zeros(differences)
    all_speeds[:3] = 1.0
    directions = [all_speeds, *np.eye(differences)[[0, 2]]]
    if differences > 3:
        apart = np.eye(differences)[3]
        directions += [all_speeds / 2 + apart, all_speeds / 2 - apart]  # the left wheel, the right wheel
    return np.column_stack([change * direction for direction in directions for change in changes])


def _e_value(p: np.ndarray) -> np.ndarray:
    """Return e-values (V,) of p-values: at most 1 on average where these are uniform or larger."""
    p = np.clip(p, 1e-300, 1 - 1e-9)
    logarithm = np.log(p)
    value: np.ndarray = (1 - p + p * logarithm) / (p * logarithm**2)
    return value
