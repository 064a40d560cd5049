"""Roll-outs of an extended simulation have the mean and the spread of what each mechanism models.

What really happens is written down here once more, in steps of a hundredth of a period and without any of the
package's chain: a world of wheels (or a fin) whose speeds follow from the command, with one effect in it. Thousands of
vehicles drive the same commands in it and in the simulation; the measured poses after each period are compared.
"""

import functools
import math
from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from scipy import optimize

from exact_model import MM_PER_PWM, SESSION_S, TRACK_MM, ExactDynamics, conditions_of, simulation_with
from swarmtwin.dynamics.motion_noise import MotionNoise
from swarmtwin.geometry import compose, exp_map, log_map, wrap_angle
from swarmtwin.simulation.mechanism import mechanism_names

VEHICLES, FINE = 4000, 100
NOISE_SD, CAMERA_SD = np.array([0.8, 0.4, 0.02]), np.array([0.3, 0.3, 0.01])
NOISE = MotionNoise(
    at_rest=tuple(NOISE_SD**2), with_motion=(0, 0, 0), usual_mm=1, usual_rad=1, camera=tuple(CAMERA_SD**2)
)


@dataclass
class FineWorld:
    """N vehicles of one robot; an effect overrides one method."""

    robot: object
    rng: np.random.Generator
    start: np.ndarray
    elapsed_s: float = 0.0
    values: dict = field(default_factory=dict)

    def __post_init__(self):
        self.pose = np.tile(self.start, (VEHICLES, 1))
        self.in_force = np.zeros((VEHICLES, len(self.robot.command)))
        self.in_force = np.clip(self.in_force, self.robot.command_low, self.robot.command_high)
        self.prepare()

    def prepare(self):
        """Set up what the effect remembers."""

    def arrives(self):
        return np.ones(VEHICLES, dtype=bool)

    def acting(self, before, now, time_s):
        return now

    def received(self, command):
        return command

    def speed(self, command, dt_s):
        """Twists per period (N, 3) of vehicles under commands (N, m)."""
        return ExactDynamics(self.robot).twist(torch.as_tensor(self.received(command))).numpy()

    def drift_mm_s(self):
        return np.zeros(2)

    def durations_s(self):
        return np.full(VEHICLES, self.robot.period_s)

    def noise_factor(self):
        return 1.0

    def camera(self, pose):
        return pose

    def drive(self, sent):
        before = self.in_force
        self.in_force = np.where(self.arrives()[:, None], np.broadcast_to(sent, before.shape), before)
        dt_s = self.durations_s() / FINE
        start = self.pose.copy()
        for step in range(FINE):
            command = self.acting(before, self.in_force, step * self.robot.period_s / FINE)
            twist = self.speed(command, dt_s) * (dt_s / self.robot.period_s)[:, None]
            ahead, left, turn = twist.T
            heading = self.pose[:, 2] + turn / 2
            self.pose[:, 0] += np.cos(heading) * ahead - np.sin(heading) * left
            self.pose[:, 1] += np.sin(heading) * ahead + np.cos(heading) * left
            self.pose[:, 2] += turn
            self.pose[:, :2] += self.drift_mm_s() * dt_s[:, None]
            self.elapsed_s = self.elapsed_s + dt_s.mean()
        moved = log_map(torch.as_tensor(_displacement(start, self.pose))).numpy()
        moved += self.noise_factor() * NOISE_SD * self.rng.normal(size=moved.shape)
        self.pose = compose(start, exp_map(torch.as_tensor(moved)).numpy())
        measured = self.camera(self.pose)
        return measured + CAMERA_SD * self.rng.normal(size=measured.shape)


def _displacement(start, end):
    away, heading = end[:, :2] - start[:, :2], start[:, 2]
    cos, sin = np.cos(heading), np.sin(heading)
    return np.column_stack(
        [cos * away[:, 0] + sin * away[:, 1], cos * away[:, 1] - sin * away[:, 0], end[:, 2] - start[:, 2]]
    )


class Loss(FineWorld):
    def arrives(self):
        return self.rng.random(VEHICLES) >= self.values["probability"]


class Delay(FineWorld):
    def acting(self, before, now, time_s):
        return before if time_s < self.values["delay_s"] - 1e-9 else now


class DeadBand(FineWorld):
    def received(self, command):
        return np.where(np.abs(command) < self.values["width"], 0.0, command)


class Saturation(FineWorld):
    def received(self, command):
        return np.clip(command, -self.values["limit"], self.values["limit"])


class FrictionBand(FineWorld):
    def received(self, command):
        return np.sign(command) * np.maximum(np.abs(command) - self.values["width"], 0.0)


class GradualSaturation(FineWorld):
    def prepare(self):
        largest = float(self.robot.command_high[0])
        self.bend = optimize.brentq(lambda bend: math.tanh(bend * largest) / bend - self.values["limit"], 1e-6, 1.0)

    def received(self, command):
        return np.tanh(self.bend * command) / self.bend


class Gain(FineWorld):
    def speed(self, command, dt_s):
        return self.values["gain"] * super().speed(command, dt_s)


class Sag(FineWorld):
    def speed(self, command, dt_s):
        return (1 - self.values["loss"] * (self.elapsed_s / SESSION_S) ** self.values["shape"]) * super().speed(
            command, dt_s
        )


class WeakServo(FineWorld):
    """The fin strokes less far."""

    def received(self, command):
        return command * np.array([1.0, self.values["gain"], 1.0])


class SaggingServo(FineWorld):
    def received(self, command):
        left = 1 - self.values["loss"] * (self.elapsed_s / SESSION_S) ** self.values["shape"]
        return command * np.array([1.0, left, 1.0])


class Asymmetry(FineWorld):
    def speed(self, command, dt_s):
        share = self.values["ratio"] ** 0.5
        return super().speed(command * np.array([share, 1 / share]), dt_s)


class Trim(FineWorld):
    def received(self, command):
        return command + np.array([math.degrees(self.values["angle_rad"]), 0.0, 0.0])


class Lag(FineWorld):
    def prepare(self):
        self.now = None

    def speed(self, command, dt_s):
        target = super().speed(command, dt_s)
        if self.now is None:
            self.now = np.zeros_like(target)
        before = self.now
        self.now = target + (before - target) * np.exp(-dt_s / self.values["time_constant_s"])[:, None]
        return (before + self.now) / 2


class EvenLag(FineWorld):
    """Each wheel changes its speed by no more than the largest one in two time constants."""

    def prepare(self):
        self.now = np.zeros((VEHICLES, 2))
        largest_mm_s = self.robot.largest_displacement.forward_mm / self.robot.period_s
        self.mm_s2 = largest_mm_s / (2 * self.values["time_constant_s"])

    def speed(self, command, dt_s):
        change_mm = self.mm_s2 * self.robot.period_s * dt_s[:, None]
        before, target = self.now, MM_PER_PWM * np.broadcast_to(command, self.now.shape)
        self.now = before + np.clip(target - before, -change_mm, change_mm)
        left, right = ((before + self.now) / 2).T
        return np.column_stack([(left + right) / 2, 0 * left, (right - left) / TRACK_MM])


class SettingLag(FineWorld):
    def prepare(self):
        self.setting = self.in_force.copy()

    def speed(self, command, dt_s):
        left = np.exp(-dt_s / self.values["time_constant_s"])[:, None]
        before = self.setting
        self.setting = command + (before - command) * left
        return super().speed((before + self.setting) / 2, dt_s)


class Backlash(FineWorld):
    def prepare(self):
        self.taken_up = np.full((VEHICLES, 2), self.values["travel_mm"] / 2)

    def speed(self, command, dt_s):
        turned = MM_PER_PWM * command / FINE
        after = np.clip(self.taken_up + turned, 0, self.values["travel_mm"])
        left, right = ((turned - (after - self.taken_up)) * FINE).T
        self.taken_up = after
        return np.column_stack([(left + right) / 2, 0 * left, (right - left) / TRACK_MM])


def speed_squared_behind_play(lost, steps=4000):
    """Return the mean square of a fin's speed over that of its servo, which takes up the play in each stroke."""
    servo = np.cos(np.linspace(0, 4 * np.pi, steps + 1))
    slack, moved = 0.0, []
    for travel in np.diff(servo):
        taken = min(max(slack + travel, 0.0), lost)
        moved.append(travel - (taken - slack))
        slack = taken
    return np.square(moved[steps // 2 :]).mean() / np.square(np.diff(servo)[steps // 2 :]).mean()


class FinBacklash(FineWorld):
    def received(self, command):
        play_deg, by_width = math.degrees(self.values["travel_rad"]), self.values["by_width"]
        lost = np.minimum(play_deg / np.maximum(command[:, 1], 1e-6), 2.0)
        grid = np.linspace(0, 2, 201)
        speed2 = np.interp(lost, grid, [speed_squared_behind_play(one) for one in grid])
        left = np.sqrt(by_width * (1 - lost / 2) ** 2 + (1 - by_width) * speed2)
        return np.column_stack([command[:, 0], left * command[:, 1], command[:, 2]])


class Patch(FineWorld):
    def speed(self, command, dt_s):
        away = np.hypot(self.pose[:, 0] - self.values["x_mm"], self.pose[:, 1] - self.values["y_mm"])
        return super().speed(command, dt_s) * (1 - self.values["loss"] * (away < self.values["radius_mm"]))[:, None]


class Wall(FineWorld):
    def speed(self, command, dt_s):
        arena = self.robot.arena_mm
        away = np.minimum(self.pose[:, :2] - arena.low_mm, arena.high_mm - self.pose[:, :2]).min(axis=1)
        loss = self.values["loss"] * np.exp(-np.maximum(away, 0) / self.values["reach_mm"])
        return super().speed(command, dt_s) * (1 - loss)[:, None]


class Drift(FineWorld):
    def drift_mm_s(self):
        return np.array([self.values["x_mm_s"], self.values["y_mm_s"]])


class Noise(FineWorld):
    def noise_factor(self):
        return self.values["factor"]


class Jitter(FineWorld):
    def durations_s(self):
        return self.robot.period_s * np.maximum(1 + self.values["spread"] * self.rng.normal(size=VEHICLES), 0.1)


class Scale(FineWorld):
    def camera(self, pose):
        centre = (self.robot.arena_mm.low_mm + self.robot.arena_mm.high_mm) / 2
        return np.column_stack([centre + self.values["scale"] * (pose[:, :2] - centre), pose[:, 2]])


class Lens(FineWorld):
    def camera(self, pose):
        low, high = self.robot.arena_mm.low_mm, self.robot.arena_mm.high_mm
        away, corner = pose[:, :2] - (low + high) / 2, np.hypot(*(high - low)) / 2
        factor = 1 + self.values["coefficient"] * (away**2).sum(axis=1, keepdims=True) / corner**2
        return np.column_stack([(low + high) / 2 + factor * away, pose[:, 2]])


class Offset(FineWorld):
    def camera(self, pose):
        cos, sin = np.cos(pose[:, 2]), np.sin(pose[:, 2])
        ahead, left = self.values["forward_mm"], self.values["left_mm"]
        return np.column_stack(
            [pose[:, 0] + cos * ahead - sin * left, pose[:, 1] + sin * ahead + cos * left, pose[:, 2]]
        )


class Yaw(FineWorld):
    def camera(self, pose):
        return pose + np.array([0.0, 0.0, self.values["angle_rad"]])


EFFECTS = {
    "command_loss": (Loss, {"probability": 0.3}),
    "command_delay": (Delay, {"delay_s": 0.17}),
    "dead_band": (DeadBand, {"width": 40.0}),
    "saturation": (Saturation, {"limit": 60.0}),
    "gain_change": (Gain, {"gain": 0.8}),
    "battery_sag": (Sag, {"loss": 0.5, "shape": 1.5}),
    "actuator_asymmetry": (Asymmetry, {"ratio": 1.3}),
    "actuator_lag": (Lag, {"time_constant_s": 0.2}),
    "backlash": (Backlash, {"travel_mm": 6.0}),
    "surface_patch": (Patch, {"x_mm": 505.0, "y_mm": 500.0, "radius_mm": 80.0, "loss": 0.5}),
    "wall_effect": (Wall, {"loss": 0.6, "reach_mm": 90.0}),
    "steady_drift": (Drift, {"x_mm_s": 8.0, "y_mm_s": -5.0}),
    "noise_change": (Noise, {"factor": 2.5}),
    "timing_jitter": (Jitter, {"spread": 0.2}),
    "camera_scale": (Scale, {"scale": 1.15}),
    "lens_distortion": (Lens, {"coefficient": 0.2}),
    "marker_offset": (Offset, {"forward_mm": 12.0, "left_mm": -7.0}),
    "marker_yaw": (Yaw, {"angle_rad": 0.2}),
}
OF_A_FIN = {
    "actuator_asymmetry": (Trim, {"angle_rad": 0.15}),
    "actuator_lag": (SettingLag, {"time_constant_s": 0.25}),
    "backlash": (FinBacklash, {"travel_rad": 0.2, "by_width": 0.6}),
    "command_delay": (Delay, {"delay_s": 0.2}),
}
IN_OTHER_FORMS = [
    ("mgr", "dead_band", FrictionBand, {"width": 25.0, "larger": "less"}),
    ("mgr", "saturation", GradualSaturation, {"limit": 60.0, "sets_in": "gradually"}),
    ("mgr", "actuator_lag", EvenLag, {"time_constant_s": 0.3, "follows": "evenly"}),
    ("mur", "gain_change", WeakServo, {"gain": 0.8, "acts_on": "effort"}),
    ("mur", "battery_sag", SaggingServo, {"loss": 0.5, "shape": 1.5, "acts_on": "effort"}),
]
COMMANDS = {
    "mgr": [(80, 60), (-50, 90), (30, -100), (110, 20), (-70, -90), (35, 95)],
    "mur": [(30, 50, 8), (-60, 30, 6), (70, 55, 9), (-20, 20, 4), (10, 60, 7), (-75, 45, 5)],
}
START = {"mgr": np.array([495.0, 480.0, 0.6]), "mur": np.array([900.0, 500.0, 0.6])}


def test_every_mechanism_is_here():
    assert {*EFFECTS, "neighbour_interaction"} <= set(mechanism_names())
    assert len(EFFECTS) == 18


def rolled_out(simulation, robot, start, elapsed_s):
    """Measured poses (T, N, 3) of vehicles alone in their worlds."""
    drawn = torch.Generator().manual_seed(5)
    state = simulation.start(torch.as_tensor(np.tile(start, (VEHICLES, 1, 1))), elapsed_s=elapsed_s, rng=drawn)
    poses = []
    for command in COMMANDS[robot.name]:
        sent = torch.tensor(command, dtype=torch.float64).expand(VEHICLES, 1, len(command))
        state = simulation.step(state, sent, rng=drawn)
        poses.append(simulation.observe(state, drawn)[:, 0].numpy())
    return np.stack(poses)


def compare(ours, truth, discretisation_mm=0.05):
    """Compare means and spreads, (T, N, 3), to four standard errors and what steps of an eighth of a period lose."""
    about = truth.mean(axis=1, keepdims=True)
    about[..., 2] = np.angle(np.exp(1j * truth[..., 2]).mean(axis=1, keepdims=True))
    deviations = [one - about for one in (ours, truth)]
    for deviation in deviations:
        deviation[..., 2] = wrap_angle(deviation[..., 2])
    mean, true_mean = (one.mean(axis=1) for one in deviations)
    spread, true_spread = (one.std(axis=1) for one in deviations)
    allowed = 4 * true_spread * math.sqrt(2 / VEHICLES) + np.array([1, 1, 0.01]) * discretisation_mm
    assert (np.abs(mean - true_mean) < allowed).all(), (mean - true_mean, allowed)
    assert (np.abs(np.log(spread / true_spread)) < 0.06).all(), spread / true_spread
    return true_mean + about[:, 0], true_spread


@pytest.fixture(scope="module")
def rolled_out_plain(robots):
    """Where a simulation without an effect leads from a start, worked out once for each."""

    @functools.cache
    def plain(name, *start):
        return rolled_out(simulation_with(robots[name], motion_noise=NOISE), robots[name], np.array(start), 0.0)

    return plain


CASES = [(robot, name, *rest) for robot, of in (("mgr", EFFECTS), ("mur", OF_A_FIN)) for name, rest in of.items()]
CASES += IN_OTHER_FORMS
IDS = ["-".join([case[0], case[1], *(value for value in case[3].values() if isinstance(value, str))]) for case in CASES]


@pytest.mark.parametrize(("robot", "name", "world", "values"), CASES, ids=IDS)
def test_mean_and_spread_are_those_of_the_effect(robots, rolled_out_plain, robot, name, world, values):
    robot = robots[robot]
    elapsed_s = 0.7 * SESSION_S if name == "battery_sag" else 0.0
    near_a_corner = np.array([60.0, 120.0, 0.6])
    start = near_a_corner if name in ("wall_effect", "lens_distortion") else START[robot.name]
    fine = world(robot, np.random.default_rng(3), start, elapsed_s, values)
    truth = np.stack([fine.drive(np.array(command, dtype=float)) for command in COMMANDS[robot.name]])
    simulation = simulation_with(robot, motion_noise=NOISE, **{name: values})
    edge_mm = 0.5 if name == "surface_patch" else 0.05  # the mechanism's edge is soft, the effect's is sharp
    mean, spread = compare(rolled_out(simulation, robot, start, elapsed_s), truth, edge_mm)
    plain = rolled_out_plain(robot.name, *start)
    changed = np.abs(plain.mean(axis=1) - mean)[..., :2].max() > 1.0 or (spread / plain.std(axis=1))[-1].max() > 1.3
    assert changed or name == "marker_yaw"


class SluggishWheels(ExactDynamics):
    """Wheels whose speeds follow each command with a lag of their own, integrated in small steps."""

    inputs = ("command", "previous_command")
    own_lag = 0.11

    def predict(self, situation):
        new, old = (self.twist(one.double()) for one in (situation.command, situation.previous_command))
        moved = torch.zeros_like(new)
        for step in range(FINE):
            left = math.exp(-(step + 0.5) / FINE / self.own_lag)
            moved = compose(moved, exp_map((new + (old - new) * left) / FINE))
        return moved


def sluggish_poses(robot, delay_s=0.0, time_constant_s=0.0):
    """Poses (T, 3) of one vehicle with sluggish wheels whose commands come late, or which follow later still."""
    lag = SluggishWheels.own_lag + time_constant_s / robot.period_s
    twists = [SluggishWheels(robot).twist(torch.tensor([one], dtype=torch.float64)) for one in COMMANDS["mgr"]]
    pose, now, before, poses = torch.as_tensor(START["mgr"][None]), 0 * twists[0], 0 * twists[0], []
    for new in twists:
        for step in range(FINE):
            target = before if (step + 0.5) / FINE < delay_s / robot.period_s else new
            after = target + (now - target) * math.exp(-1 / FINE / lag)
            pose = compose(pose, exp_map((now + after) / 2 / FINE))
            now = after
        before = new
        poses.append(pose[0].numpy())
    return np.stack(poses)


@pytest.mark.parametrize("delay_s", [0.05, 0.2])
def test_a_delay_and_a_further_lag_of_wheels_that_lag_anyway_are_told_apart(robots, delay_s):
    """Both shift the wheels' speeds by the same time: the order of old and new motion within a period parts them."""
    robot, truth, simulated = robots["mgr"], {}, {}
    values = {"command_delay": {"delay_s": delay_s}, "actuator_lag": {"time_constant_s": delay_s}}
    for name, own in values.items():
        conditions = conditions_of(robot, own_lags=(SluggishWheels.own_lag,) * 3)
        simulation = simulation_with(robot, SluggishWheels(robot), conditions, **{name: own})
        state, poses = simulation.start(torch.as_tensor(START["mgr"][None, None])), []
        for command in COMMANDS["mgr"]:
            state = simulation.step(state, torch.tensor([[command]], dtype=torch.float64))
            poses.append(state.pose[0, 0].numpy())
        truth[name], simulated[name] = sluggish_poses(robot, **own), np.stack(poses)
        np.testing.assert_allclose(simulated[name][:, 2], truth[name][:, 2], atol=0.005)
    apart = np.hypot(*(truth["command_delay"] - truth["actuator_lag"])[:, :2].T).max()
    for name, poses in simulated.items():
        assert np.hypot(*(poses - truth[name])[:, :2].T).max() < apart / 10, (name, apart)


def test_neighbours_push_each_other_apart_all_the_way(robots):
    """Two vehicles side by side, each pushed by the other, integrated in small steps."""
    robot, strength, reach_mm = robots["mgr"], 25.0, 90.0
    simulation = simulation_with(robot, neighbour_interaction={"strength_mm_s": strength, "reach_mm": reach_mm})
    start = np.array([[[450.0, 500.0, 0.3], [520.0, 470.0, 2.0]]])
    state, pose = simulation.start(torch.as_tensor(start)), start[0].copy()
    for _ in range(4):
        state = simulation.step(state, torch.zeros(1, 2, 2))
        for _ in range(FINE):
            away = pose[:, :2] - pose[::-1, :2]
            distance_mm = np.hypot(*away.T)[:, None]
            pose[:, :2] += strength * np.exp(-distance_mm / reach_mm) * away / distance_mm * robot.period_s / FINE
        np.testing.assert_allclose(state.pose[0].numpy(), pose, atol=0.8)
    assert np.abs(pose - start[0]).max() > 10


def test_a_world_begins_at_any_age_of_the_battery(robots):
    simulation = simulation_with(robots["mgr"], battery_sag={"loss": 0.5, "shape": 1.0})
    state = simulation.start(torch.zeros(4000, 2, 3), rng=torch.Generator().manual_seed(0))
    age = state.elapsed_s / SESSION_S
    assert torch.equal(age[:, 0], age[:, 1])
    assert float(age.mean()) == pytest.approx(0.5, abs=0.02)
    assert float(age.std()) == pytest.approx(1 / math.sqrt(12), abs=0.02)
    moved = simulation.step(state, torch.full((4000, 2, 2), 60.0)).pose[:, 0, 0]
    torch.testing.assert_close(moved, MM_PER_PWM * 60 * (1 - 0.5 * age[:, 0]))
    assert not simulation.start(torch.zeros(3, 1, 3)).elapsed_s.any()


def test_all_mechanisms_at_once_are_finite_and_in_the_order_of_the_signal(robots):
    robot = robots["mgr"]
    everything = {name: values for name, (_, values) in EFFECTS.items()}
    simulation = simulation_with(robot, motion_noise=NOISE, **everything)
    stages = [one.stage for one in simulation.mechanisms]
    order = ["link", "controller", "supply", "actuators", "ground", "body", "marker", "camera", "clock"]
    assert stages == sorted(stages, key=order.index)
    backwards = simulation_with(robot, motion_noise=NOISE, **dict(reversed(everything.items())))
    poses = [rolled_out(one, robot, START["mgr"], 0.0) for one in (simulation, backwards)]
    assert np.isfinite(poses[0]).all()
    np.testing.assert_array_equal(*poses)
