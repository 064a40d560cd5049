"""A car with momentum that is known exactly: integrated in small time steps, and seen by a camera with noise."""

import numpy as np
import torch

from swarmtwin.dynamics.models.kinematic import Config as Kinematic
from swarmtwin.dynamics.predictor import NetworkDynamics
from swarmtwin.geometry import compose, wrap_angle
from swarmtwin.recordings.recording import Header, Recording, Track
from swarmtwin.robot import Arena

PLANTED = {
    "wheelbase_mm": 260.0,
    "marker_ahead_mm": 110.0,
    "speed_gain_mm_s_per_unit": 2000.0,
    "dead_band": 0.08,
    "curvature": -0.15,
    "steering_gain": 1.1,
    "trim_deg": 2.0,
    "time_constant_s": 0.4,
}
ARENA = Arena(x=(-8000, 8000), y=(-8000, 8000))


def exact_dynamics(robot):
    """The bicycle with the values of the car, which looks at command, previous command and velocity."""
    dynamics = NetworkDynamics(robot, Kinematic(situation=None))
    for name, value in PLANTED.items():
        parameter = dynamics.network.parameters_by_name[name]
        free = value / parameter.size if parameter.signed else np.log(value / parameter.size)
        torch.nn.init.constant_(dynamics.network.free[name], free)
    return dynamics.eval()


def asked_mm_s(throttle, planted=PLANTED):
    """The speed that the throttle asks for."""
    effort = np.maximum(np.abs(throttle) - planted["dead_band"], 0.0)
    return planted["speed_gain_mm_s_per_unit"] * np.sign(throttle) * effort * (1 + planted["curvature"] * effort)


def driven(command, period_s=0.1, steps=100, late_s=0.0, planted=PLANTED):
    """Poses (T + 1, 3) of the marker while commands (T, 2) throttle, steering_deg are held, from rest at the origin.

    Heun's method, in so many small steps a period: the rear axle rolls along the heading, and the speed follows. With
    `late_s` each command acts so much later; before the first, nothing is asked for.
    """
    dt_s = period_s / steps
    rear, speed_mm_s = np.zeros(3), 0.0
    poses = [rear]
    late = round(late_s / dt_s)
    acting = np.concatenate([np.zeros((late, 2)), np.repeat(command, steps, axis=0)])[: len(command) * steps]
    turns_a_mm = np.tan(np.radians(planted["steering_gain"] * (acting[:, 1] + planted["trim_deg"])))
    turns_a_mm /= planted["wheelbase_mm"]
    for step, (asked, turn_a_mm) in enumerate(zip(asked_mm_s(acting[:, 0], planted), turns_a_mm, strict=True), 1):
        slope = (asked - speed_mm_s) / planted["time_constant_s"]
        middle_mm_s = speed_mm_s + slope * dt_s / 2
        heading = rear[2] + middle_mm_s * turn_a_mm * dt_s / 2
        rear = rear + dt_s * middle_mm_s * np.array([np.cos(heading), np.sin(heading), turn_a_mm])
        speed_mm_s += dt_s * (asked - middle_mm_s) / planted["time_constant_s"]
        if step % steps == 0:
            poses.append(rear)
    rear = np.array(poses)
    ahead = planted["marker_ahead_mm"] * np.column_stack([np.cos(rear[:, 2]), np.sin(rear[:, 2])])
    return np.column_stack([rear[:, :2] + ahead, wrap_angle(rear[:, 2])])


def commands(robot, steps, rng):
    """Commands (steps, 2), each held for some periods, about as a person drives: mostly ahead, now and then brakes."""
    rows = []
    while len(rows) < steps:
        throttle = rng.choice([rng.uniform(0.2, 1.0), rng.uniform(-0.6, 0.2)], p=[0.75, 0.25])
        steering = rng.uniform(robot.command_low[1], robot.command_high[1])
        rows += [np.round([throttle, steering], 3)] * int(rng.integers(1, 8))
    return np.array(rows[:steps])


def recording(
    robot, runs, steps=60, noise=(1.5, 1.5, 0.004), seed=0, name="car", late_s=0.0, scattered=False, **changed
):
    """Runs that begin at rest, at the origin or scattered; noise of the camera, a standard deviation in mm, mm, rad.

    With `changed` values the car is another one than the planted one.
    """
    planted = {**PLANTED, **changed}
    rng, tracks = np.random.default_rng(seed), []
    for run in range(runs):
        command = commands(robot, steps, rng)
        pose = driven(command, robot.period_s, late_s=late_s, planted=planted)
        if scattered:
            pose = compose(rng.uniform([-6000, -6000, -3], [6000, 6000, 3]), pose)
        pose = pose + rng.normal(0, 1, (steps + 1, 3)) * noise
        pose[:, 2] = wrap_angle(pose[:, 2])
        time_s = 20.0 * run + robot.period_s * np.arange(steps + 1)
        command = np.vstack([command, np.full((1, 2), np.nan)])
        tracks.append(Track(f"run-{run:03}", "1", time_s.round(3), command, pose))
    header = Header(robot=robot.name, period_s=robot.period_s, arena_mm=ARENA, source="a car that is known exactly")
    return Recording(robot, header, tuple(tracks), digest=name)
