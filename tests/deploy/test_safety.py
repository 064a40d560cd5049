"""The safety filter: what it lets through is safe in the simulation, what it holds back was not; it locks no one."""

import time

import numpy as np
import pytest
import torch
from playground import NOISE, exact_simulation

from exact_model import simulation_with
from swarmtwin.deploy.control.look_ahead import LookAhead
from swarmtwin.deploy.control.safety import SafetyFilter
from swarmtwin.deploy.control.settings import SafetySettings
from swarmtwin.geometry import wrap_angle
from tiny_policies import robot_named

FULL = np.array([120.0, 120.0])
STEP_MM = 42.0  # forward under FULL


@pytest.fixture(scope="module")
def simulation():
    return exact_simulation(robot_named("mgr"))


def safety_filter(simulation, vehicles, separation_mm=110.0, obstacles=None, **settings):
    settings = SafetySettings(**settings)
    ahead = LookAhead(simulation, settings.look_ahead_periods, settings.unknown_spread)
    ids = [str(index + 1) for index in range(vehicles)]
    robot = simulation.robot
    return SafetyFilter(robot, robot.arena_mm, ids, ahead, settings, separation_mm, obstacles=obstacles)


def decide(simulation, pose, command, **settings):
    pose = np.array(pose, float)
    return safety_filter(simulation, len(pose), **settings)(
        simulation.start(torch.as_tensor(pose)[None]), np.array(command, float)
    )


def test_a_safe_command_is_sent_as_it_is(simulation):
    decision = decide(simulation, [[500, 500, 0]], [FULL])
    assert (decision.command == FULL).all()
    assert decision.reasons == ("",)


def test_a_command_beyond_the_limits_is_bounded_and_said_to_be(simulation):
    decision = decide(simulation, [[500, 500, 0]], [[500, -500]])
    assert (decision.command == [[120, -120]]).all()
    assert decision.reasons == ("bounded",)


@pytest.mark.parametrize("heading", [0.0, np.pi / 2, np.pi, -np.pi / 2])
def test_one_vehicle_alone_is_kept_within_the_fence_on_every_side(simulation, heading):
    ahead = np.array([np.cos(heading), np.sin(heading)])
    start = 515 + (515 - 5 - 0.6 * STEP_MM) * ahead
    decision = decide(simulation, [[*start, heading]], [FULL])
    assert 0 < decision.scale[0] < 1
    assert decision.reasons == (f"weakened to {decision.scale[0]:.0%}: fence",)
    backwards = decide(simulation, [[*start, heading]], [-FULL])
    assert backwards.reasons == ("",)


def test_what_is_sent_rarely_leads_over_the_fence_when_motion_is_drawn(simulation):
    rng = np.random.default_rng(1)
    drawn = torch.Generator().manual_seed(1)
    worst = 0.0
    for _ in range(40):
        pose = np.column_stack([rng.uniform(20, 1010, (5, 2)), rng.uniform(-3, 3, 5)])
        command = rng.uniform(-120, 120, (5, 2))
        safe = safety_filter(simulation, 5)
        for _ in range(6):
            state = simulation.start(torch.as_tensor(pose)[None])
            command = np.clip(command + rng.normal(0, 10, (5, 2)), -120, 120)
            after = simulation.step(state, torch.as_tensor(safe(state, command).command)[None], rng=drawn)
            pose = after.pose[0].numpy()
            worst = max(worst, float(np.maximum(-pose[:, :2], pose[:, :2] - 1030).max()))
    assert worst < 2.0  # the fence's own margin is 5 mm


def test_no_command_leads_into_an_obstacle_and_one_past_it_is_sent_as_it_is(simulation):
    """From everywhere around it, straight at it and aside; the vehicle is taken as round, as the task does."""
    obstacle = np.array([[500.0, 500.0, 80.0]])
    contact_mm = 80.0 + max(simulation.robot.vehicle_size_mm) / 2
    rng, drawn = np.random.default_rng(2), torch.Generator().manual_seed(2)
    nearest = np.inf
    for _ in range(20):
        angle = rng.uniform(-np.pi, np.pi)
        place = 500 + 230 * np.array([np.cos(angle), np.sin(angle)])
        pose = torch.tensor([[[*place, angle + np.pi + rng.uniform(-0.4, 0.4)]]])
        safe = safety_filter(simulation, 1, obstacles=obstacle)
        for _ in range(10):
            state = simulation.start(pose)
            pose = simulation.step(state, torch.as_tensor(safe(state, FULL[None]).command)[None], rng=drawn).pose
            nearest = min(nearest, float((pose[0, 0, :2] - torch.tensor([500.0, 500.0])).norm()))
    assert nearest > contact_mm
    towards = decide(simulation, [[500 - contact_mm - 20, 500, 0]], [FULL], obstacles=obstacle)
    assert towards.reasons == (f"weakened to {towards.scale[0]:.0%}: obstacle",)
    assert decide(simulation, [[500 - contact_mm - 20, 500, np.pi / 2]], [FULL], obstacles=obstacle).reasons == ("",)
    assert decide(simulation, [[500 - contact_mm + 3, 500, 0]], [-FULL], obstacles=obstacle).reasons == ("",)


def test_two_that_drive_at_each_other_stay_apart(simulation):
    rng = torch.Generator().manual_seed(3)
    safe = safety_filter(simulation, 2)
    pose = torch.tensor([[[300.0, 500, 0], [700.0, 500, np.pi]]])
    nearest = 1e9
    for _ in range(20):
        state = simulation.start(pose)
        pose = simulation.step(state, torch.as_tensor(safe(state, np.array([FULL, FULL])).command)[None], rng=rng).pose
        nearest = min(nearest, float((pose[0, 0, :2] - pose[0, 1, :2]).norm()))
    assert 106 < nearest < 200
    assert safe.interventions > 10


def test_two_too_near_may_part_and_not_come_nearer(simulation):
    pose = [[500, 500, 0], [590, 500, 0]]
    apart = decide(simulation, pose, [-FULL, FULL])
    assert (apart.scale == 1).all()
    nearer = decide(simulation, pose, [FULL, -FULL])
    assert (nearer.scale == 0).all()
    assert nearer.reasons[0] == "withheld: vehicle 2"
    turning = decide(simulation, pose, [[40, -40], [-40, 40]])
    assert (turning.scale == 1).all()


def test_one_beyond_the_fence_may_come_back_and_go_no_further(simulation):
    outside = [[1035, 500, 0]]
    assert decide(simulation, outside, [-FULL]).scale[0] == 1
    assert decide(simulation, outside, [FULL]).scale[0] == 0


def test_nobody_is_locked_in_by_the_filter_alone(simulation):
    """A cluster that wants to spread does, from any start, however near."""
    rng = np.random.default_rng(5)
    for _ in range(10):
        centre = rng.uniform(300, 700, 2)
        angle = np.arange(5) * 2 * np.pi / 5 + rng.uniform(0, 1)
        position = centre + 60 * np.column_stack([np.cos(angle), np.sin(angle)])  # 70 mm apart
        pose = torch.as_tensor(np.column_stack([position, wrap_angle(angle)]))[None]
        safe = safety_filter(simulation, 5)
        for _ in range(6):
            state = simulation.start(pose)
            pose = simulation.step(state, torch.as_tensor(safe(state, np.tile(FULL, (5, 1))).command)[None]).pose
        away = np.hypot(*(pose[0, :, :2].numpy() - centre).T)
        assert away.min() > 150


def test_who_has_waited_longest_goes_first_and_deadlocks_are_counted(simulation):
    pose = torch.tensor([[[400.0, 500, 0], [520.0, 500, np.pi]]])
    safe = safety_filter(simulation, 2, deadlock_periods=3)
    state = simulation.start(pose)
    for _ in range(5):
        assert (safe(state, np.array([FULL, FULL])).scale == 0).all()
    assert safe.deadlocks == 2
    assert safe.interventions == 10


def test_a_lag_of_the_registered_simulation_is_looked_ahead(simulation):
    """What coasts is stopped earlier."""
    robot = simulation.robot
    lagging = simulation_with(robot, motion_noise=NOISE, actuator_lag={"time_constant_s": 0.4})
    driving = lagging.start(torch.tensor([[[920.0, 500, 0]]]))
    for _ in range(2):
        driving = lagging.step(driving, torch.as_tensor(FULL)[None, None])
    scale = safety_filter(lagging, 1)(driving, FULL[None]).scale[0]
    at_rest = lagging.start(driving.pose)
    assert scale < safety_filter(lagging, 1)(at_rest, FULL[None]).scale[0]


@pytest.mark.parametrize("name", ["mur", "create"])
def test_another_robots_command_at_rest_is_always_among_the_candidates(name):
    robot = robot_named(name)
    simulation = exact_simulation(robot)
    low, high = robot.arena_mm.low_mm, robot.arena_mm.high_mm
    edge = [high[0] - 6.0, (low[1] + high[1]) / 2, 0.0]
    decision = decide(simulation, [edge], [robot.command_high])
    assert decision.scale[0] < 1
    if decision.scale[0] == 0:
        assert (decision.command[0] == robot.command_at_rest).all()
    assert ((decision.command >= robot.command_low) & (decision.command <= robot.command_high)).all()


@pytest.mark.benchmark_figures
def test_time_of_a_decision_for_five(simulation, capsys):
    rng = np.random.default_rng(1)
    safe = safety_filter(simulation, 5)
    state = simulation.start(torch.as_tensor(np.column_stack([rng.uniform(100, 900, (5, 2)), np.zeros(5)]))[None])
    took = []
    for _ in range(50):
        started = time.perf_counter()
        safe(state, rng.uniform(-120, 120, (5, 2)))
        took.append(time.perf_counter() - started)
    with capsys.disabled():
        print(f"\nsafety filter, 5 vehicles: median {1e3 * np.median(took):.1f} ms")
