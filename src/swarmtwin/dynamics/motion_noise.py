"""The random part of motion and camera, estimated from what a dynamics model errs by on transitions it has not seen."""

from typing import Annotated, Self

import numpy as np
import torch
from pydantic import Field
from scipy import optimize
from torch import Tensor

from swarmtwin.geometry import Array, exp_map, log_map, wrap_angle
from swarmtwin.robot import StrictModel
from swarmtwin.transitions import Transitions

Variance = Annotated[float, Field(ge=0)]
ByAxis = tuple[Variance, Variance, Variance]


class MotionNoise(StrictModel):
    """Normal noise of the motion, independent from period to period, and of the camera, independent from pose to pose.

    A pose that is measured wrong makes two neighbouring residuals wrong, the other way round: their covariance tells
    the camera's part from the motion's.

    Attributes:
        at_rest: variance of a twist over a period (forward, left, turn; mm², mm², rad²) of a vehicle that stands.
        with_motion: growth of that variance with the square of the motion, which is the twist's length over
            `usual_mm` and its turn over `usual_rad`, as the root of their sum of squares.
        usual_mm: root mean square length of the twists it was estimated from.
        usual_rad: root mean square turn of these.
        camera: variance of a measured pose (x, y in mm², heading in rad²).
    """

    at_rest: ByAxis
    with_motion: ByAxis
    usual_mm: Annotated[float, Field(gt=0)]
    usual_rad: Annotated[float, Field(gt=0)]
    camera: ByAxis

    @classmethod
    def estimate(cls, transitions: Transitions, predicted: np.ndarray) -> Self:
        """Estimate it from transitions that a model has not been fitted to, and its displacements (N, 3) for them.

        The largest hundredth of the residuals, outliers, is left out of each variance.
        """
        twist = log_map(torch.as_tensor(predicted, dtype=torch.float64)).numpy()
        measured = log_map(torch.as_tensor(transitions.displacement, dtype=torch.float64)).numpy()
        residual = measured - twist
        residual[:, 2] = wrap_angle(residual[:, 2])
        usual_mm = float(np.sqrt((twist[:, :2] ** 2).sum(axis=1).mean())) or 1.0
        usual_rad = float(np.sqrt((twist[:, 2] ** 2).mean())) or 1.0
        camera = _camera_variance(transitions, measured, residual)
        size2 = _squared_size(twist, usual_mm, usual_rad)
        at_rest, with_motion = [], []
        for axis in range(3):
            squared = residual[:, axis] ** 2
            kept = squared <= np.quantile(squared, 0.99)
            design = np.column_stack([np.ones(kept.sum()), size2[kept]])
            found, _ = optimize.nnls(design, squared[kept] - 2 * camera[axis])
            at_rest.append(float(found[0]))
            with_motion.append(float(found[1]))
        return cls(
            at_rest=tuple(at_rest),
            with_motion=tuple(with_motion),
            usual_mm=usual_mm,
            usual_rad=usual_rad,
            camera=tuple(float(value) for value in camera),
        )

    def sample(self, displacement: Tensor, rng: torch.Generator, factor: float = 1.0) -> Tensor:
        """Add the motion's random part, `factor` times as large, to expected displacements (N, 3), float64."""
        twist = log_map(displacement)
        size2 = _squared_size(twist, self.usual_mm, self.usual_rad)
        variance = twist.new_tensor(self.at_rest) + twist.new_tensor(self.with_motion) * size2[:, None]
        drawn = torch.randn(twist.shape, generator=rng, dtype=twist.dtype, device=twist.device)
        return exp_map(twist + factor * variance.sqrt() * drawn)

    def photograph(self, pose: Tensor, rng: torch.Generator) -> Tensor:
        """Add the camera's random part to poses (..., 3)."""
        drawn = torch.randn(pose.shape, generator=rng, dtype=pose.dtype, device=pose.device)
        measured = pose + pose.new_tensor(self.camera).sqrt() * drawn
        return torch.cat([measured[..., :2], wrap_angle(measured[..., 2:])], dim=-1)


def _squared_size(twist: Array, usual_mm: float, usual_rad: float) -> Array:
    """Return (N,) the squared motion of twists (N, 3), 2 for usual ones."""
    return (twist[:, 0] ** 2 + twist[:, 1] ** 2) / usual_mm**2 + twist[:, 2] ** 2 / usual_rad**2


def _camera_variance(transitions: Transitions, measured: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Return (3,) minus the covariance of residuals with those just before, in one frame; at most half of all."""
    before = transitions.just_before()
    follows = before >= 0
    variance = residual.var(axis=0)
    if follows.sum() < 100:  # too few pairs for a covariance: all is taken for motion
        return np.zeros(3)
    earlier = residual[before[follows]]
    turned_rad = (measured[before[follows], 2] + measured[follows, 2]) / 2
    cos, sin = np.cos(turned_rad), np.sin(turned_rad)
    here = residual[follows]
    there = np.column_stack(
        [cos * earlier[:, 0] + sin * earlier[:, 1], cos * earlier[:, 1] - sin * earlier[:, 0], earlier[:, 2]]
    )
    shared = -(here * there).mean(axis=0)
    shared[:2] = shared[:2].mean()  # a camera errs alike along both axes of its image
    return np.clip(shared, 0.0, 0.45 * variance)
