"""Mechanisms fitted to a session by maximum likelihood."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from scipy import optimize, stats
from torch import Tensor

from swarmtwin.dynamics.twist import displacement_of, twist_of
from swarmtwin.gap.mechanism import Drive, Mechanism, Places, Quantity
from swarmtwin.gap.motion import Alternative, Base, Remembered, alternatives
from swarmtwin.gap.noise import Noise, residual_of
from swarmtwin.gap.session import Session
from swarmtwin.gap.units import UnitDifferences
from swarmtwin.geometry import compose

Kind = type[Mechanism]
NORMAL = 100.0
FARTHEST_Z = 2.5
OUTLIER_Z = 4.0
EVALUATIONS = (12, 6)
SCALE_ROUNDS = 3
MOST_POLISHING = 40
GRIP_STEP = 0.02


@dataclass(frozen=True)
class Fit:
    """Mechanisms with their best values on a session of N transitions in R runs.

    Attributes:
        mechanisms: with their values, in the order in which they were found.
        likelihood: (N,) log-likelihood of each transition, nats.
        residual: (N, 3) standardised residuals, those of the likeliest alternative.
        scale: (3,) how much wider they spread than the reference's.
    """

    mechanisms: tuple[Mechanism, ...]
    likelihood: np.ndarray
    residual: np.ndarray
    scale: np.ndarray

    @property
    def total(self) -> float:
        """Log-likelihood of the whole session, nats."""
        return float(self.likelihood.sum())

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """The classes of its mechanisms."""
        return tuple(type(mechanism) for mechanism in self.mechanisms)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of its mechanisms."""
        return tuple(mechanism.name for mechanism in self.mechanisms)


class Problem:
    """A session, the simulation and its noise: says how likely what was measured is, given mechanisms."""

    def __init__(self, base: Base, noise: Noise, session: Session, known_vehicles: tuple[str, ...] = ()) -> None:
        self.session = session
        self.noise = noise
        self.robot = base.robot
        self.surroundings = session.drive.surroundings
        self.base = Remembered(base)
        drive = session.drive
        self.base.keep(drive.command, drive.previous_command, drive.earlier_command, drive.pose)
        self.simulated = self.base.way(drive.command, drive.previous_command, drive.pose)
        self.whitener = noise.whitener(self.simulated, session)
        vehicles = known_vehicles or session.transitions.vehicles
        self.units = UnitDifferences(self.base, self.whitener, session, self.simulated, vehicles)
        self.freedom = noise.degrees_of_freedom
        self._offset = -self.whitener.spread.log().sum(dim=-1).numpy()

    def residual(self, mechanisms: Sequence[Mechanism]) -> Tensor:
        """Return standardised residuals (N, 3): of the likeliest alternative where there are several."""
        found = alternatives(self.base, mechanisms, self.session.drive)
        raw = [residual_of(self.session, twist_of(one.displacement)) for one in found]
        residual = self._likeliest(found, raw)[1]
        return torch.as_tensor(self.units.free(residual.numpy())[0]) if self.units.count else residual

    def evaluate(self, mechanisms: Sequence[Mechanism]) -> Fit:
        """Return how likely the session is with mechanisms as they are."""
        found = alternatives(self.base, mechanisms, self.session.drive)
        raw = [residual_of(self.session, twist_of(one.displacement)) for one in found]
        earlier, whole = self._likeliest(found, raw)
        freed, price = self.units.free(whole.numpy())
        best = torch.as_tensor(freed)
        apart = (best - whole).numpy()
        scale = self._scale(best.numpy() if len(found) == 1 else np.clip(best.numpy(), -OUTLIER_Z, OUTLIER_Z))
        if len(found) == 1:
            density = self._density(best.numpy() / scale)
        else:
            whitened = [(self.whitener(one, earlier).numpy() + apart) / scale for one in raw]
            logs = [
                np.log(max(one.probability, 1e-12)) + self._density(values)
                for one, values in zip(found, whitened, strict=True)
            ]
            density = np.logaddexp.reduce(logs, axis=0)
        likelihood = density + self._offset - np.log(scale).sum() - price / len(density)
        return Fit(tuple(mechanisms), likelihood, best.numpy(), scale)

    def _likeliest(self, found: Sequence[Alternative], raw: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Return the raw and the standardised residuals (N, 3) of each transition's likeliest alternative."""
        if len(raw) == 1:
            return raw[0], self.whitener(raw[0])
        cost = torch.stack(
            [
                ((one / self.whitener.spread) ** 2).sum(dim=-1) - 2 * np.log(max(way.probability, 1e-12))
                for one, way in zip(raw, found, strict=True)
            ]
        )
        chosen = cost.argmin(dim=0)
        earlier = torch.stack(list(raw))[chosen, torch.arange(len(chosen))]
        return earlier, self.whitener(earlier)

    def _density(self, whitened: np.ndarray) -> np.ndarray:
        """Return the log density (N,) of residuals (N, 3) in units of their own spread."""
        if self.freedom >= NORMAL:
            logs = -0.5 * whitened**2 - 0.5 * np.log(2 * np.pi)
        else:
            logs = stats.t.logpdf(whitened, self.freedom)
        summed: np.ndarray = logs.sum(axis=-1)
        return summed

    def _scale(self, whitened: np.ndarray) -> np.ndarray:
        """Return (3,) the likeliest spread of standardised residuals."""
        squared = whitened**2
        scale2 = squared.mean(axis=0)
        if self.freedom < NORMAL:
            for _ in range(SCALE_ROUNDS * 3):
                weight = (self.freedom + 1) / (self.freedom + squared / scale2)
                scale2 = (weight * squared).mean(axis=0)
        return np.sqrt(np.maximum(scale2, 1e-6))

    def quantities(self, kinds: Sequence[Kind]) -> list[tuple[int, str, Quantity]]:
        """Return the parameters of several mechanisms: number of the mechanism, name, quantity."""
        return [
            (number, name, quantity)
            for number, kind in enumerate(kinds)
            for name, quantity in kind.quantities_of(self.robot).items()
        ]

    def assembled(self, kinds: Sequence[Kind], values: np.ndarray) -> list[Mechanism]:
        """Return mechanisms with values (P,) for all their parameters."""
        given: list[dict[str, float]] = [{} for _ in kinds]
        for (number, name, _), value in zip(self.quantities(kinds), values, strict=True):
            given[number][name] = float(value)
        return [kind.at({**self.observed(kind), **own}) for kind, own in zip(kinds, given, strict=True)]

    def observed(self, kind: Kind) -> dict[str, float]:
        """Return what a mechanism reads off the session's clock."""
        return kind.observed(self.session.transitions.duration_s, self.robot.period_s) or {}

    def offers(self, kind: Kind) -> bool:
        """Say whether the session can show a mechanism at all."""
        transitions = self.session.transitions
        if kind.observed(transitions.duration_s, self.robot.period_s) is None:
            return False
        return "neighbours" not in kind.needs or bool(np.isfinite(transitions.neighbours).any())

    def values(self, mechanisms: Sequence[Mechanism]) -> np.ndarray:
        """Return the values (P,) of all parameters of mechanisms."""
        kinds = [type(mechanism) for mechanism in mechanisms]
        return np.array([getattr(mechanisms[number], name) for number, name, _ in self.quantities(kinds)])

    def fit(self, mechanisms: Sequence[Mechanism]) -> Fit:
        """Return the likeliest values of all parameters, searched from those that `mechanisms` have."""
        kinds = [type(mechanism) for mechanism in mechanisms]
        quantities = self.quantities(kinds)
        if not quantities:
            return self.evaluate(mechanisms)
        start = self.values(mechanisms)
        several = any(kind.overrides("arriving") for kind in kinds)
        found = self._by_likelihood(kinds, start) if several else self._by_least_squares(kinds, start)
        best = self.evaluate(self.assembled(kinds, found))
        if not all(kind.is_smooth for kind in kinds):
            best = self._polished(kinds, best)
        return best

    def _bounds(self, kinds: Sequence[Kind]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        quantities = [quantity for _, _, quantity in self.quantities(kinds)]
        low, high = (np.array([getattr(one, end) for one in quantities]) for end in ("low", "high"))
        return low, high, np.array([one.response_step for one in quantities])

    def _by_least_squares(self, kinds: Sequence[Kind], start: np.ndarray) -> np.ndarray:
        low, high, _ = self._bounds(kinds)
        margin = 1e-6 * (high - low)
        found = np.clip(start, low + margin, high - margin)
        for evaluations in EVALUATIONS:
            found = self._one_search(kinds, np.clip(found, low + margin, high - margin), evaluations)
        return found

    def _one_search(self, kinds: Sequence[Kind], start: np.ndarray, evaluations: int) -> np.ndarray:
        """Search with the residuals' axes weighed by their spread at the start."""
        low, high, step = self._bounds(kinds)
        scale = self._scale(self.residual(self.assembled(kinds, start)).numpy())

        def residuals(values: np.ndarray) -> np.ndarray:
            return (self.residual(self.assembled(kinds, values)).numpy() / scale).ravel()

        def jacobian(values: np.ndarray) -> np.ndarray:
            return self.slopes(kinds, values).reshape(-1, len(values)) / np.tile(scale, len(self.session))[:, None]

        solution: np.ndarray = optimize.least_squares(
            residuals,
            start,
            jacobian,
            (low, high),
            x_scale=step,
            loss="huber",
            f_scale=FARTHEST_Z,
            max_nfev=evaluations,
            xtol=1e-4,
            ftol=1e-6,
        ).x
        return solution

    def _by_likelihood(self, kinds: Sequence[Kind], start: np.ndarray) -> np.ndarray:
        low, high, step = self._bounds(kinds)

        def loss(scaled: np.ndarray) -> float:
            return -self.evaluate(self.assembled(kinds, np.clip(scaled * step, low, high))).total

        found = optimize.minimize(
            loss,
            start / step,
            method="L-BFGS-B",
            bounds=list(zip(low / step, high / step, strict=True)),
            options={"eps": 0.1, "maxiter": 12, "ftol": 1e-9},
        )
        return np.clip(found.x * step, low, high)

    def _polished(self, kinds: Sequence[Kind], fit: Fit) -> Fit:
        """Search a little around values where the motion changes by jumps."""
        low, high, step = self._bounds(kinds)
        start = self.values(fit.mechanisms)

        def loss(scaled: np.ndarray) -> float:
            values = start + scaled * step
            if np.any(values < low) or np.any(values > high):
                return np.inf
            return -self.evaluate(self.assembled(kinds, values)).total

        simplex = np.concatenate([np.zeros((1, len(start))), np.eye(len(start)) * 1.5])
        found = optimize.minimize(
            loss,
            np.zeros(len(start)),
            method="Nelder-Mead",
            options={"initial_simplex": simplex, "maxfev": MOST_POLISHING, "xatol": 0.02, "fatol": 0.05},
        )
        polished = self.evaluate(self.assembled(kinds, np.clip(start + found.x * step, low, high)))
        return polished if polished.total > fit.total else fit

    def slopes(self, kinds: Sequence[Kind], values: np.ndarray) -> np.ndarray:
        """Return (N, 3, P) as `jacobian` does, by differences to one side: half the work, enough for a search."""
        _, high, step = self._bounds(kinds)
        here = self.residual(self.assembled(kinds, values)).numpy()
        columns = []
        for index in range(len(values)):
            moved = values.copy()
            moved[index] += step[index] if values[index] + step[index] <= high[index] else -step[index]
            there = self.residual(self.assembled(kinds, moved)).numpy()
            columns.append((there - here) / (moved[index] - values[index]))
        return np.stack(columns, axis=-1) if columns else np.empty((*here.shape, 0))

    def jacobian(self, kinds: Sequence[Kind], values: np.ndarray) -> np.ndarray:
        """Return (N, 3, P) how standardised residuals change with the parameters, by central differences."""
        low, high, step = self._bounds(kinds)
        columns = []
        for index in range(len(values)):
            ends = []
            for sign in (1.0, -1.0):
                moved = values.copy()
                moved[index] = np.clip(moved[index] + sign * step[index], low[index], high[index])
                ends.append((moved[index], self.residual(self.assembled(kinds, moved)).numpy()))
            (ahead, first), (back, second) = ends
            columns.append((first - second) / max(ahead - back, 1e-12))
        return np.stack(columns, axis=-1) if columns else np.empty((len(self.session), 3, 0))

    def places(self, fit: Fit) -> Places:
        """Return where the grip seems to be another one than a fit says."""
        lost = [*fit.mechanisms, _Grip.at({"loss": GRIP_STEP})]
        response = (self.residual(lost).numpy() - fit.residual) / GRIP_STEP / fit.scale
        held = np.clip(fit.residual / fit.scale, -FARTHEST_Z, FARTHEST_Z)
        drive = self.session.drive
        middle = compose(drive.pose, displacement_of(self.session.way / 2))[:, :2].numpy()
        return Places(middle, -(held * response).sum(axis=1), (response**2).sum(axis=1))

    def promise(self, fit: Fit, kind: Kind, places: Places) -> "Promise":
        """Estimate by one linear step what a mechanism beside a fit would gain, from the best place to begin."""
        quantities = kind.quantities_of(self.robot)
        held = np.clip(fit.residual / fit.scale, -FARTHEST_Z, FARTHEST_Z).ravel()
        best = Promise(-np.inf, fit.mechanisms, np.zeros_like(held))
        for start in kind.starts(self.robot, self.surroundings, places):
            begun = {**self.observed(kind), **start}
            moved = [
                {name: _moved(quantity, start[name])}
                for name, quantity in quantities.items()
                if quantity.neutral is not None
            ]
            gained, responses = 0.0, []
            for values in moved or [{}]:
                ahead = self.evaluate([*fit.mechanisms, kind.at({**begun, **values})])
                gained = max(gained, ahead.total - fit.total)
                responses.append(((ahead.residual - fit.residual) / fit.scale).ravel())
            stacked = np.stack(responses, axis=-1)
            solution, *_ = np.linalg.lstsq(stacked, -held, rcond=None)
            change = stacked @ solution
            gained = max(gained, float(-held @ change) / 2)
            if gained > best.nats:
                best = Promise(gained, (*fit.mechanisms, kind.at(begun)), change)
        return best


class Promise(NamedTuple):
    """What a mechanism beside a fit may gain.

    Attributes:
        nats: estimated gain of log-likelihood.
        start: the fit's mechanisms and the new one, where a search begins.
        change: (3 N,) what it would change of the standardised residuals.
    """

    nats: float
    start: tuple[Mechanism, ...]
    change: np.ndarray


def _moved(quantity: Quantity, value: float) -> float:
    """Return a value of a parameter away from where it does nothing."""
    if value != quantity.neutral:
        return value
    step = 3 * quantity.response_step
    return value + step if value + step <= quantity.high else value - step


class _Grip(Mechanism):
    """A loss of grip everywhere: what a patch would do if it covered the arena."""

    words: ClassVar = ""
    remedy: ClassVar = ""
    quantities: ClassVar = {}

    name: str = "grip"
    loss: float

    def strength(self, drive: Drive) -> Tensor:
        """Lose the same share everywhere."""
        return torch.full((1, 1), 1 - self.loss, dtype=torch.float64)
