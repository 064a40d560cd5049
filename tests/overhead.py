"""An emulated overhead camera over vehicles that drive in circles, whose poses are known."""

import numpy as np

from swarmtwin.geometry import wrap_angle
from swarmtwin.standin.overhead_camera import CameraConditions, OverheadCamera

VEHICLES = ("1", "2", "3", "4", "5")
CENTRES_MM = np.array([[250, 250], [780, 250], [780, 780], [250, 780], [515, 515.0]])
RADII_MM = np.array([140, 140, 140, 140, 60.0])
RATES_RAD_S = np.array([0.4, -0.3, 0.35, 0.4, -0.5])


def poses_at(time_s):
    """Poses (V, 3) at a time, no two vehicles nearer than 150 mm."""
    angle = RATES_RAD_S * time_s + np.arange(5.0)
    place = CENTRES_MM + RADII_MM[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.column_stack([place, wrap_angle(angle + np.sign(RATES_RAD_S) * np.pi / 2)])


def velocities_at(time_s):
    """Velocities (V, 3) mm/s, mm/s, rad/s at a time."""
    return (poses_at(time_s + 1e-4) - poses_at(time_s - 1e-4)) / 2e-4


class Scene:
    """A camera, and pictures of it at any time."""

    def __init__(self, robot, vehicles=VEHICLES, layout=None, **conditions):
        self.camera = OverheadCamera(robot, vehicles, CameraConditions(**conditions), layout)
        self.rng = np.random.default_rng(5)

    def picture(self, time_s, **others):
        """The picture (H, W) at a time."""
        count = len(self.camera.vehicles)
        velocity = velocities_at(time_s)[:count]
        return self.camera.render(poses_at(time_s)[:count], self.rng, velocity=velocity, **others)

    def pictures(self, count=8, apart_s=1.0):
        """Several, so far apart."""
        return [self.picture(number * apart_s) for number in range(count)]

    def seen_at(self, points_mm, height_mm=0.0):
        """Where points (N, 2) at a height are truly seen, (N, 2) pixels."""
        pixels = self.camera.optics.project(np.column_stack([points_mm, np.full(len(points_mm), height_mm)]))
        mirrored = self.camera.conditions.mirrored
        return [self.camera.size[0] - 1, 0] + pixels * [-1, 1] if mirrored else pixels
