"""Gaps that nobody thought of: smooth random functions of command, previous command, pose or time.

Each is a draw of a Gaussian process with squared-exponential covariance, by random Fourier features (Rahimi and Recht,
2007): f(u) = √(2/K) Σ cos(ω·u + φ), ω ~ N(0, 1/length²), u the inputs as shares of their ranges. It is then shifted and
scaled to mean 0 and the wanted standard deviation over inputs that are uniform over their ranges, so that it is no
gain in disguise and has the size it says.
"""

import math
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from pydantic import Field

from swarmtwin.robot import Arena, Seed
from swarmtwin.standin.effect import Effect, Placement

Positive = Annotated[float, Field(gt=0)]


class Features(NamedTuple):
    """A draw with O outputs of d inputs: frequencies (O, K, d), phases (O, K), mean (O,) and scale (O,)."""

    frequency: np.ndarray
    phase: np.ndarray
    mean: np.ndarray
    scale: np.ndarray

    @classmethod
    def drawn(cls, outputs: int, inputs: int, count: int, length: float, seed: int) -> "Features":
        """Draw the function as it comes, with standard deviation 1 over all draws."""
        rng = np.random.default_rng(seed)
        frequency = rng.standard_normal((outputs, count, inputs)) / length
        phase = rng.uniform(0.0, 2 * math.pi, (outputs, count))
        return cls(frequency, phase, np.zeros(outputs), np.full(outputs, math.sqrt(2.0 / count)))

    def standardised(self, samples: np.ndarray) -> "Features":
        """Return it with mean 0 and standard deviation 1 over samples (d, n)."""
        values = self(samples)
        mean, spread = values.mean(axis=1), values.std(axis=1)
        return self._replace(mean=(self.mean + mean) / spread, scale=self.scale / spread)

    def __call__(self, inputs: np.ndarray) -> np.ndarray:
        """Return the function's values (O, ...) at inputs (d, ...)."""
        lined_up = inputs.reshape(len(inputs), -1)
        waves = np.cos(self.frequency.astype(inputs.dtype) @ lined_up + self.phase[..., None].astype(inputs.dtype))
        values = waves.sum(axis=1) * self.scale[:, None] - self.mean[:, None]
        return values.reshape(len(values), *inputs.shape[1:]).astype(inputs.dtype)


class RandomField(Effect):
    """What the random functions share.

    Attributes:
        size: standard deviation, in the unit of what it acts on.
        length_scale: over which share of its inputs' ranges it changes; at that distance it correlates by exp(−1/2).
        low: the inputs' lower ends: of the command's columns, of x_mm and y_mm, of progress.
        high: their upper ends.
        draw: which of all such functions it is.
        features: waves that it is the sum of.
    """

    outputs: ClassVar[int] = 1

    size: Positive
    length_scale: Positive
    low: tuple[float, ...]
    high: tuple[float, ...]
    draw: Seed
    features: int = 48

    @cached_property
    def function(self) -> Features:
        """The function, with mean 0 and standard deviation 1 over its inputs' ranges."""
        inputs = len(self.low) + 2 * self.with_heading
        drawn = Features.drawn(self.outputs, inputs, self.features, self.length_scale, self.draw)
        rng = np.random.default_rng([self.draw, 1])
        samples = rng.random((inputs, 8192))
        if self.with_heading:
            samples[-2:] = _on_circle(rng.uniform(-math.pi, math.pi, 8192))
        return drawn.standardised(samples)

    @property
    def with_heading(self) -> bool:
        """Whether it depends on the heading as well."""
        return False

    def values(self, inputs: np.ndarray, heading_rad: np.ndarray | None = None) -> np.ndarray:
        """Return what it is (O, ...) at inputs (d, ...), in their own units."""
        column = (-1, *([1] * (inputs.ndim - 1)))
        low, high = (np.reshape(np.array(end, inputs.dtype), column) for end in (self.low, self.high))
        shares = (inputs - low) / (high - low)
        if heading_rad is not None:
            shares = np.concatenate([shares, _on_circle(heading_rad)])
        return self.function(shares) * np.asarray(self.size, inputs.dtype)


def _on_circle(heading_rad: np.ndarray) -> np.ndarray:
    """Return headings (...) as points (2, ...) on a circle of diameter 1."""
    return 0.5 + 0.5 * np.stack([np.cos(heading_rad), np.sin(heading_rad)])


class RandomStrength(RandomField):
    """Wheels, each by a function of its own, or the fin are stronger and weaker by what they are or were told."""

    outputs: ClassVar[int] = 2

    over: Literal["command", "previous_command"]
    actuators: Literal[1, 2]

    def strength(self, placement: Placement) -> np.ndarray:
        """Change the strength; never below a twentieth."""
        told = getattr(placement, self.over)
        change = self.values(told)
        factor = np.maximum(1.0 + change, 0.05)
        return factor if self.actuators == 2 else factor[0]


class RandomAgeing(RandomField):
    """The actuators' strength goes up and down as the session goes on."""

    ages: ClassVar[bool] = True

    def strength(self, placement: Placement) -> np.ndarray:
        """Change the strength; never below a twentieth."""
        return np.maximum(1.0 + self.values(np.asarray(placement.progress)[None])[0], 0.05)


class RandomGround(RandomField):
    """The ground grips more or less by place and heading."""

    @property
    def with_heading(self) -> bool:
        """Grip depends on the heading as well: a carpet's pile, waves."""
        return True

    def traction(self, placement: Placement, arena: Arena) -> np.ndarray:
        """Change the traction; never below a twentieth."""
        places = np.stack([placement.x_mm, placement.y_mm])
        return np.maximum(1.0 + self.values(places, placement.heading_rad)[0], 0.05)


class RandomCurrent(RandomField):
    """Water or air flows, or the ground slopes, to and fro by place."""

    outputs: ClassVar[int] = 2

    def drift_velocity_mm_s(self, placement: Placement) -> tuple[Any, Any]:
        """Carry along x and y."""
        x_mm_s, y_mm_s = self.values(np.stack([placement.x_mm, placement.y_mm]))
        return x_mm_s, y_mm_s


class RandomGusts(RandomField):
    """All vehicles are carried to and fro as the session goes on."""

    ages: ClassVar[bool] = True
    outputs: ClassVar[int] = 2

    def drift_velocity_mm_s(self, placement: Placement) -> tuple[Any, Any]:
        """Carry along x and y."""
        x_mm_s, y_mm_s = self.values(np.asarray(placement.progress, float)[None])
        return x_mm_s, y_mm_s


class RandomLens(RandomField):
    """The camera's glass is wavy: what it measures is shifted by place."""

    outputs: ClassVar[int] = 2

    def picture(self, pose: np.ndarray, progress: Any) -> np.ndarray:
        """Shift positions."""
        shift_mm = np.moveaxis(self.values(np.moveaxis(pose[..., :2], -1, 0)), 0, -1)
        return np.concatenate([pose[..., :2] + shift_mm, pose[..., 2:]], axis=-1)


FIELDS: dict[str, type[Effect]] = {
    "random_by_command": RandomStrength,
    "random_by_previous_command": RandomStrength,
    "random_ageing": RandomAgeing,
    "random_ground": RandomGround,
    "random_current": RandomCurrent,
    "random_gusts": RandomGusts,
    "random_lens": RandomLens,
}
"""By the names that the study draws them by."""
