"""Causes of the catalogue that act by another law than the mechanism that describes them: models are never exact.

A wall that is felt in a straight line and not exponentially, a patch with corners, a battery that was changed: whoever
has such a robot wants to be told of walls, of a patch, of the battery, though what is fitted to it is of another form.
"""

import math
from collections.abc import Callable
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from swarmtwin.geometry import wrap_angle
from swarmtwin.robot import Arena, Robot
from swarmtwin.standin.effect import Effect, Placement, Rng, change_thrust, wall_distance_mm
from swarmtwin.studies.hidden_effects.effect_sizes import PARAMETERS, Draw, Sizes

Share = Annotated[float, Field(gt=0, lt=1)]
Positive = Annotated[float, Field(gt=0)]


class OtherLaw(Effect):
    """An effect of another law.

    Attributes:
        cause: the name of what it is in the catalogue.
    """

    cause: ClassVar[str]


class LinearWallEffect(OtherLaw):
    """The loss near walls falls in a straight line, to nothing at `width_mm`: 1 − loss · (1 − distance / width)."""

    cause: ClassVar[str] = "wall_effect"

    loss: Share
    width_mm: Positive

    def traction(self, placement: Placement, arena: Arena) -> np.ndarray:
        """Weaken the drive near the walls."""
        nearness = np.maximum(1.0 - wall_distance_mm(placement, arena) / self.width_mm, 0.0)
        return 1.0 - self.loss * nearness


class WornRim(OtherLaw):
    """A strip of the same width along all walls has another surface: the loss in it is the same everywhere."""

    cause: ClassVar[str] = "wall_effect"

    loss: Share
    width_mm: Positive

    def traction(self, placement: Placement, arena: Arena) -> np.ndarray:
        """Weaken the drive in the strip."""
        distance_mm = wall_distance_mm(placement, arena)
        return 1.0 - self.loss * (distance_mm < self.width_mm).astype(distance_mm.dtype)


class SoftPatch(OtherLaw):
    """A patch without an edge: 1 − loss · exp(−distance² / 2 width²)."""

    cause: ClassVar[str] = "surface_patch"

    loss: Share
    x_mm: float
    y_mm: float
    width_mm: Positive

    def traction(self, placement: Placement, arena: Arena) -> np.ndarray:
        """Weaken the drive around the centre."""
        away_mm = np.hypot(placement.x_mm - self.x_mm, placement.y_mm - self.y_mm)
        return 1.0 - self.loss * np.exp(-0.5 * (away_mm / self.width_mm) ** 2)


class RectangularPatch(OtherLaw):
    """A mat: a rectangle with another surface, askew."""

    cause: ClassVar[str] = "surface_patch"

    loss: Share
    x_mm: float
    y_mm: float
    length_mm: Positive
    width_mm: Positive
    direction_rad: float

    def traction(self, placement: Placement, arena: Arena) -> np.ndarray:
        """Weaken the drive on the mat."""
        away_x, away_y = placement.x_mm - self.x_mm, placement.y_mm - self.y_mm
        cosine, sine = math.cos(self.direction_rad), math.sin(self.direction_rad)
        along, across = np.abs(away_x * cosine + away_y * sine), np.abs(away_y * cosine - away_x * sine)
        on_it = (along < self.length_mm / 2) & (across < self.width_mm / 2)
        return 1.0 - self.loss * on_it.astype(away_x.dtype)


class BatteryKnee(OtherLaw):
    """The voltage falls slowly, and fast when the cells are nearly empty: seven tenths of it in the last fifth."""

    cause: ClassVar[str] = "battery_sag"
    ages: ClassVar[bool] = True

    loss: Share

    def strength(self, placement: Placement) -> np.ndarray:
        """Weaken all actuators with the session's progress."""
        at_last = np.clip(5.0 * placement.progress - 4.0, 0.0, 1.0)
        return 1.0 - self.loss * (0.3 * placement.progress + 0.7 * at_last)


class ChangedBattery(OtherLaw):
    """The battery runs down steadily and is changed once, halfway through the session."""

    cause: ClassVar[str] = "battery_sag"
    ages: ClassVar[bool] = True

    loss: Share

    def strength(self, placement: Placement) -> np.ndarray:
        """Weaken all actuators with the progress of each half."""
        return 1.0 - self.loss * np.mod(2.0 * placement.progress, 1.0)


class FourthOrderLens(OtherLaw):
    """A lens that is straight but at its edge: r (1 + coefficient · r⁴), r = 1 at the arena's corners."""

    cause: ClassVar[str] = "lens_distortion"

    coefficient: float

    def magnification(self, radius: np.ndarray) -> np.ndarray:
        """Scale what is far from the centre more."""
        return 1.0 + self.coefficient * radius**4


class OblongPixels(OtherLaw):
    """The camera's scale is wrong, along x by half more than `error` and along y by half of it."""

    cause: ClassVar[str] = "camera_scale"

    error: float
    x_mm: float
    y_mm: float

    def picture(self, pose: np.ndarray, progress: Any) -> np.ndarray:
        """Stretch the picture around its middle, and markers with it."""
        along_x, along_y = 1.0 + 1.5 * self.error, 1.0 + 0.5 * self.error
        seen = pose.copy()
        seen[..., 0] = self.x_mm + along_x * (pose[..., 0] - self.x_mm)
        seen[..., 1] = self.y_mm + along_y * (pose[..., 1] - self.y_mm)
        turned = np.arctan2(along_y * np.sin(pose[..., 2]), along_x * np.cos(pose[..., 2]))
        seen[..., 2] = pose[..., 2] + wrap_angle(turned - pose[..., 2])
        return seen


class DriftingScale(OtherLaw):
    """The camera sinks slowly: its scale is right at first, and wrong by twice `error` at the session's end."""

    cause: ClassVar[str] = "camera_scale"
    ages: ClassVar[bool] = True

    error: float
    x_mm: float
    y_mm: float

    def picture(self, pose: np.ndarray, progress: Any) -> np.ndarray:
        """Stretch positions around the picture's middle."""
        factor = 1.0 + 2.0 * self.error * np.asarray(progress)
        seen = pose.copy()
        seen[..., 0] = self.x_mm + factor * (pose[..., 0] - self.x_mm)
        seen[..., 1] = self.y_mm + factor * (pose[..., 1] - self.y_mm)
        return seen


class InverseSquareInteraction(OtherLaw):
    """Each neighbour adds a velocity away from it: strength / (1 + distance / reach)²."""

    cause: ClassVar[str] = "neighbour_interaction"

    strength_mm_s: float
    reach_mm: Positive

    def drift_velocity_mm_s(self, placement: Placement) -> tuple[np.ndarray, np.ndarray]:
        """Add what all neighbours do."""
        away_x, away_y = placement.x_mm - placement.neighbour_x_mm, placement.y_mm - placement.neighbour_y_mm
        distance_mm = np.hypot(away_x, away_y) + 1e-3
        push = self.strength_mm_s / (1.0 + distance_mm / self.reach_mm) ** 2 / distance_mm
        return (push * away_x).sum(axis=0), (push * away_y).sum(axis=0)


class LeakySaturation(OtherLaw):
    """Commands beyond a limit do less, but not nothing: four tenths of what is beyond it."""

    cause: ClassVar[str] = "saturation"

    limit: Positive

    def transform_command(self, command: np.ndarray, robot: Robot) -> np.ndarray:
        """Weaken what of thrusts is beyond the limit."""

        def weakened(thrust: np.ndarray) -> np.ndarray:
            cut = np.clip(thrust, -self.limit, self.limit)
            less: np.ndarray = cut + 0.4 * (thrust - cut)
            return less

        return change_thrust(command, robot, weakened)


class GradualDeadBand(OtherLaw):
    """Small commands do little, and ever more of what they should: half of it at the width, c (c/w)² / (1 + (c/w)²)."""

    cause: ClassVar[str] = "dead_band"

    width: Positive

    def transform_command(self, command: np.ndarray, robot: Robot) -> np.ndarray:
        """Weaken small thrusts."""

        def weakened(thrust: np.ndarray) -> np.ndarray:
            squared = (thrust / self.width) ** 2
            less: np.ndarray = thrust * squared / (1.0 + squared)
            return less

        return change_thrust(command, robot, weakened)


class LimitedAcceleration(OtherLaw):
    """Motors speed up and brake at most so hard: far changes of speed take longer than an exponential's."""

    cause: ClassVar[str] = "actuator_lag"

    step_mm_s: Positive

    def aimed_speed(self, target: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Aim no farther than a step from the present speed; the motors' own time constant goes on from there."""
        aimed: np.ndarray = speed + np.clip(target - speed, -self.step_mm_s, self.step_mm_s)
        return aimed


class ChannelCurrent(OtherLaw):
    """A current that is strongest in the middle of the arena, as in a channel, and a fifth as strong at its sides."""

    cause: ClassVar[str] = "steady_drift"

    speed_mm_s: Positive
    direction_rad: float
    x_mm: float
    y_mm: float
    half_mm: Positive

    def drift_velocity_mm_s(self, placement: Placement) -> tuple[np.ndarray, np.ndarray]:
        """Add the current, by how far from the middle the vehicle is across it."""
        cosine, sine = math.cos(self.direction_rad), math.sin(self.direction_rad)
        across = (cosine * (placement.y_mm - self.y_mm) - sine * (placement.x_mm - self.x_mm)) / self.half_mm
        speed_mm_s = self.speed_mm_s * (1.0 - 0.8 * np.minimum(across**2, 1.0))
        return speed_mm_s * cosine, speed_mm_s * sine


class LateReadings(OtherLaw):
    """Most periods are a little too short and some much too long, as where another process now and then takes over."""

    cause: ClassVar[str] = "timing_jitter"

    spread: Share

    def durations(self, nominal: np.ndarray, rng: Rng) -> np.ndarray:
        """Draw the periods' lengths, whose deviations are exponential and end at three standard deviations."""
        return nominal * (1.0 + self.spread * np.minimum(rng.standard_exponential(nominal.shape) - 1.0, 3.0))


class LossInBursts(OtherLaw):
    """Commands are lost several in a row, four on average, as where the radio is blocked for a while."""

    cause: ClassVar[str] = "command_loss"

    probability: Share

    def loss_probability(self) -> float:
        """Lose commands."""
        return self.probability

    def lost_in_a_row(self) -> float:
        """Lose them together."""
        return 4.0


OTHER_LAWS: dict[str, type[OtherLaw]] = {
    "linear_wall_effect": LinearWallEffect,
    "worn_rim": WornRim,
    "soft_patch": SoftPatch,
    "rectangular_patch": RectangularPatch,
    "battery_knee": BatteryKnee,
    "changed_battery": ChangedBattery,
    "fourth_order_lens": FourthOrderLens,
    "oblong_pixels": OblongPixels,
    "drifting_scale": DriftingScale,
    "inverse_square_interaction": InverseSquareInteraction,
    "leaky_saturation": LeakySaturation,
    "gradual_dead_band": GradualDeadBand,
    "limited_acceleration": LimitedAcceleration,
    "channel_current": ChannelCurrent,
    "late_readings": LateReadings,
    "loss_in_bursts": LossInBursts,
}
"""By the names that the study draws them by."""

OTHER_LAW_SIZES: dict[str, Sizes] = {
    "linear_wall_effect": {"mgr": (0.03, 0.98), "mur": (0.03, 0.98)},
    "worn_rim": {"mgr": (0.02, 0.95), "mur": (0.02, 0.95)},
    "soft_patch": {"mgr": (0.02, 0.95), "mur": (0.02, 0.95)},
    "rectangular_patch": {"mgr": (0.02, 0.95), "mur": (0.02, 0.95)},
    "battery_knee": {"mgr": (0.01, 0.9), "mur": (0.01, 0.9)},
    "changed_battery": {"mgr": (0.01, 0.8), "mur": (0.01, 0.8)},
    "fourth_order_lens": {"mgr": (0.02, 0.6), "mur": (0.01, 0.6)},
    "oblong_pixels": {"mgr": (0.004, 0.3), "mur": (0.003, 0.3)},
    "drifting_scale": {"mgr": (0.004, 0.3), "mur": (0.003, 0.3)},
    "inverse_square_interaction": {"mgr": (1.0, 150.0), "mur": (2.0, 190.0)},
    "leaky_saturation": {"mgr": (0.02, 0.9), "mur": (0.04, 0.9)},
    "gradual_dead_band": {"mgr": (0.01, 0.6), "mur": (0.02, 0.8)},
    "limited_acceleration": {"mgr": (0.3, 0.97)},
    "channel_current": {"mgr": (0.3, 40.0), "mur": (0.6, 60.0)},
    "late_readings": {"mgr": (0.004, 0.13), "mur": (0.005, 0.14)},
    "loss_in_bursts": {"mgr": (0.0005, 0.4), "mur": (0.001, 0.5)},
}
"""For each robot that can have them the smallest size, which nobody can see, and the largest that makes sense."""


def _somewhere(drawn: Draw) -> dict[str, float]:
    low, high = drawn.robot.arena_mm.low_mm, drawn.robot.arena_mm.high_mm
    x_mm, y_mm = (low + (high - low) * drawn.rng.uniform(0.25, 0.75, 2)).tolist()
    return {"x_mm": x_mm, "y_mm": y_mm, "loss": drawn.size}


def _mat(drawn: Draw) -> dict[str, float]:
    length_mm, width_mm = (drawn.side_mm * drawn.uniform(*ends) for ends in ((0.45, 0.7), (0.25, 0.45)))
    return {**_somewhere(drawn), "length_mm": length_mm, "width_mm": width_mm, "direction_rad": drawn.direction_rad()}


def _in_the_middle(drawn: Draw) -> dict[str, float]:
    x_mm, y_mm = drawn.middle_mm
    return {"x_mm": x_mm, "y_mm": y_mm}


OTHER_LAW_PARAMETERS: dict[str, Callable[[Draw], dict[str, Any]]] = {
    "linear_wall_effect": lambda drawn: {"loss": drawn.size, "width_mm": drawn.side_mm * drawn.uniform(0.2, 0.45)},
    "worn_rim": lambda drawn: {"loss": drawn.size, "width_mm": drawn.side_mm * drawn.uniform(0.1, 0.22)},
    "soft_patch": lambda drawn: {**_somewhere(drawn), "width_mm": drawn.side_mm * drawn.uniform(0.12, 0.22)},
    "rectangular_patch": _mat,
    "battery_knee": lambda drawn: {"loss": drawn.size},
    "changed_battery": lambda drawn: {"loss": drawn.size},
    "fourth_order_lens": lambda drawn: {"coefficient": drawn.size * (drawn.sign() if drawn.size < 0.18 else 1.0)},
    "oblong_pixels": lambda drawn: {"error": drawn.size * drawn.sign(), **_in_the_middle(drawn)},
    "drifting_scale": lambda drawn: {"error": drawn.size * drawn.sign(), **_in_the_middle(drawn)},
    "inverse_square_interaction": PARAMETERS["neighbour_interaction"],
    "leaky_saturation": lambda drawn: {"limit": (1.0 - drawn.size) * drawn.full_thrust},
    "gradual_dead_band": lambda drawn: {"width": drawn.size * drawn.full_thrust},
    "limited_acceleration": lambda drawn: {"step_mm_s": (1.0 - drawn.size) * drawn.top_speed_mm_s},
    "channel_current": lambda drawn: {
        "speed_mm_s": drawn.size,
        "direction_rad": drawn.direction_rad(),
        "half_mm": drawn.side_mm / 2,
        **_in_the_middle(drawn),
    },
    "late_readings": lambda drawn: {"spread": drawn.size},
    "loss_in_bursts": lambda drawn: {"probability": drawn.size},
}
"""The parameters of an effect, from its size and what is left to chance."""
