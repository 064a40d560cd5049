"""Actuators that follow gradually, each axis with a lag of its own: against steps so fine that order is all there."""

import numpy as np
import pytest
import torch

from exact_model import ExactDynamics, LaggingDynamics, conditions_of, simulation_with, situation_of
from swarmtwin.geometry import compose, exp_map, log_map
from swarmtwin.simulation.actuation import with_actuation
from swarmtwin.simulation.conditions import SessionConditions
from swarmtwin.simulation.efforts import twist_of_wheels, wheel_travel
from swarmtwin.simulation.relaxation import left_over, relaxed_twist, stopped_by_friction


@pytest.mark.parametrize("lags", [(0.1, 0.1, 0.1), (0.4, 0.05, 0.2), (0.4, 0.0, 0.0), (0.0, 0.3, 0.6)])
@pytest.mark.parametrize("share", [1.0, 0.4])
def test_a_twist_that_relaxes_axis_by_axis_leads_where_fine_steps_do(lags, share):
    rng = torch.Generator().manual_seed(0)
    size = torch.tensor([40.0, 10.0, 0.5], dtype=torch.float64)
    start, target = (torch.randn(5, 3, generator=rng, dtype=torch.float64) * size for _ in range(2))
    mean, end = relaxed_twist(start, target, share, lags, 0.03)
    lag, pieces = torch.tensor(lags, dtype=torch.float64) + 0.03, 2000
    exact = torch.zeros(5, 3, dtype=torch.float64)
    for piece in range(pieces):
        left = torch.exp(-(piece + 0.5) / pieces * share / lag)
        exact = compose(exact, exp_map((target + (start - target) * left) * share / pieces))
    torch.testing.assert_close(end, target + (start - target) * torch.exp(-share / lag))
    plain = target + (start - target) * (lag / share * (1 - torch.exp(-share / lag)))
    error_mm, plain_mm = ((exp_map(one * share) - exact)[:, :2].abs().max() for one in (mean, plain))
    assert error_mm < 0.1
    assert error_mm < plain_mm / 10  # what comes first matters, and is what is left of it to second order


def test_what_is_compiled_relaxes_twists_as_the_formulas_do():
    rng = torch.Generator().manual_seed(1)
    start, target = (torch.randn(50, 3, generator=rng, dtype=torch.float64) for _ in range(2))
    by_formulas = relaxed_twist(start.clone().requires_grad_(), target, 0.6, (0.4, 0.05, 0.0), 0.1)
    for one, other in zip(relaxed_twist(start, target, 0.6, (0.4, 0.05, 0.0), 0.1), by_formulas, strict=True):
        torch.testing.assert_close(one, other.detach(), rtol=1e-12, atol=1e-12)
    strided = (one.T.contiguous().T for one in (start, target))
    torch.testing.assert_close(relaxed_twist(*strided, 0.6, (0.4, 0.05, 0.0), 0.1)[0], by_formulas[0].detach())


def rolled_by_newton(start, drive, friction, lag, share, steps=4000):
    """Way and last speed of wheels that a motor would turn at `drive` without friction, in small steps of time."""
    speed, way = start.clone(), torch.zeros_like(start)
    for _ in range(steps):
        turning = torch.where(speed != 0, speed.sign(), drive.sign())
        faster = (drive - friction * turning - speed) * (share / steps / lag)
        reached = torch.where((speed == 0) & (drive.abs() <= friction), speed, speed + faster)
        reached = torch.where(speed * reached < 0, torch.zeros_like(speed), reached)
        way, speed = way + (speed + reached) / 2 * share / steps, reached
    return way, speed


@pytest.mark.parametrize("share", [1.0, 0.25])
@pytest.mark.parametrize("friction", [2.0, 8.0])
def test_wheels_that_rub_stand_sooner_as_newton_says(share, friction):
    lag = 0.2
    start = torch.tensor([[30.0, -25.0], [12.0, 40.0], [-20.0, 0.0], [1.0, -6.0], [30.0, 20.0]], dtype=torch.float64)
    target = torch.tensor([[0.0, 0.0], [-30.0, 20.0], [15.0, 25.0], [-40.0, 9.0], [-4.5, 4.5]], dtype=torch.float64)
    way, speed = rolled_by_newton(start, target + target.sign() * friction, friction, lag, share, 20_000)
    on_average, at_last = stopped_by_friction(start, target, friction, lag, share)
    mean, left = left_over(share, lag)
    torch.testing.assert_close(target + (start - target) * mean + on_average, way / share, rtol=0, atol=0.01)
    torch.testing.assert_close(target + (start - target) * left + at_last, speed, rtol=0, atol=0.01)


def test_friction_changes_nothing_for_wheels_that_neither_stop_nor_turn_back():
    start = torch.tensor([[30.0, 0.0], [-12.0, -40.0]], dtype=torch.float64)
    target = torch.tensor([[10.0, 25.0], [-30.0, -4.0]], dtype=torch.float64)
    for change in stopped_by_friction(start, target, 5.0, 0.2, 1.0):
        assert not change.any()


def test_what_friction_changes_changes_gradually_with_the_speed_to_come():
    """A learned model lets wheels that stand roll a little either way, and rounding does."""
    target = torch.linspace(-8, 8, 3201, dtype=torch.float64)[:, None].expand(-1, 2)
    for change in stopped_by_friction(torch.full_like(target, 30.0), target, 6.0, 0.15, 0.5):
        assert change.isfinite().all()
        assert change.diff(dim=0).abs().max() < 0.02


class HullOfUnlikeAxes(ExactDynamics):
    """A fin whose hull turns at once, and gathers way slowly."""

    inputs = ("command", "previous_command")
    lags = (0.4, 0.2, 0.0)

    def predict(self, situation):
        new, old = (self.twist(one.double()) for one in (situation.command, situation.previous_command))
        left = torch.tensor([left_over(1.0, lag)[0] for lag in self.lags], dtype=torch.float64)
        return exp_map(new + left * (old - new))


def test_the_lag_of_each_axis_of_thrust_is_read_from_the_model(robots):
    robot = robots["mur"]
    conditions = with_actuation(conditions_of(robot), HullOfUnlikeAxes(robot), seed=1)
    assert conditions.own_lags == pytest.approx(HullOfUnlikeAxes.lags, abs=1e-6)


class WheelsThatErrAside(HullOfUnlikeAxes):
    """Wheels that follow soon, by a model that says they slip aside a little, and for long after."""

    lags = (0.1, 0.6, 0.1)

    def twist(self, command):
        way, _, turn = super().twist(command).unbind(dim=-1)
        return torch.stack([way, 0.02 * way, turn], dim=-1)


def test_the_lag_of_wheels_is_that_of_way_and_turn(robots):
    robot = robots["mgr"]
    conditions = with_actuation(conditions_of(robot), WheelsThatErrAside(robot), seed=1)
    assert conditions.own_lags == pytest.approx((0.1, 0.1, 0.1), abs=1e-6)


class RubbingWheels(ExactDynamics):
    """Wheels that follow with a lag, and friction in their gears: too small a command turns none."""

    inputs = ("command", "previous_command")
    lag, friction_mm = 0.08, 5.0

    def predict(self, situation):
        track_mm = conditions_of(self.robot).track_mm
        drives = [self.twist(one.double()) for one in (situation.command, situation.previous_command)]
        drive, before = (wheel_travel(twist, track_mm) for twist in drives)
        start = before - before.clamp(-self.friction_mm, self.friction_mm)
        way, _ = rolled_by_newton(start, drive, self.friction_mm, self.lag, 1.0)
        return exp_map(twist_of_wheels(way, torch.zeros_like(drives[0]), track_mm))


def test_friction_in_gears_is_read_from_how_wheels_stop(robots):
    """About a sixth less of it: a command that is too small to turn a wheel still drives it, which nobody sees."""
    robot = robots["mgr"]
    conditions = with_actuation(conditions_of(robot), RubbingWheels(robot), seed=1)
    assert conditions.gear_friction_mm_s == pytest.approx(RubbingWheels.friction_mm / robot.period_s, rel=0.2)
    assert conditions.own_lags == pytest.approx((RubbingWheels.lag,) * 3, rel=0.05)
    assert SessionConditions.model_validate(conditions.model_dump()) == conditions


class SlowlyRubbingWheels(RubbingWheels):
    """They take a whole period, and more than conditions can say."""

    lag = 1.2


@pytest.mark.parametrize("dynamics", [WheelsThatErrAside, LaggingDynamics])
def test_wheels_that_do_not_rub_show_no_friction(robots, dynamics):
    assert with_actuation(conditions_of(robots["mgr"]), dynamics(robots["mgr"]), seed=1).gear_friction_mm_s == 0


def test_the_longest_lag_is_a_period(robots):
    conditions = with_actuation(conditions_of(robots["mgr"]), SlowlyRubbingWheels(robots["mgr"]), seed=1)
    assert SessionConditions.model_validate(conditions.model_dump()) == conditions


class KickedHull(ExactDynamics):
    """A fin whose turn to another angle kicks the hull round at once, whatever it does afterwards."""

    inputs = ("command", "previous_command")
    kick = 0.3

    def predict(self, situation):
        new, old = (self.twist(one.double()) for one in (situation.command, situation.previous_command))
        return exp_map(new + self.kick * (new - old) * torch.tensor([0.0, 0.0, 1.0]))


def test_what_a_change_of_command_does_at_once_a_late_one_does_late(robots):
    """Half a period late: first the old motion, then the new one with all of the kick."""
    robot = robots["mur"]
    held = situation_of(robot, np.random.default_rng(7), count=40).previous_command
    changes = {"previous_command": held, "earlier_command": held}
    situation = situation_of(robot, np.random.default_rng(7), count=40, **changes)
    base = KickedHull(robot)
    simulation = simulation_with(robot, base, conditions_of(robot), command_delay={"delay_s": robot.period_s / 2})
    old, new = base.twist(situation.previous_command), base.twist(situation.command)
    kicked = new / 2 + base.kick * (new - old) * torch.tensor([0.0, 0.0, 1.0])
    torch.testing.assert_close(
        log_map(simulation.predict(situation)),
        log_map(compose(exp_map(old / 2), exp_map(kicked))),
        rtol=1e-5,
        atol=1e-6,
    )


def test_conditions_of_earlier_versions_had_one_lag(robots):
    arena = robots["mur"].arena_mm
    conditions = SessionConditions.parse({"arena_mm": arena, "session_s": 10.0, "own_lag": 0.2}, "model.yaml")
    assert conditions.own_lags == (0.2, 0.2, 0.2)
