"""Ranges of mechanisms' parameters: what is drawn lies in them, and what makes no sense is refused by name."""

import numpy as np
import pytest
import torch

from exact_model import ExactDynamics, conditions_of, simulation_with
from swarmtwin.dynamics.motion_noise import MotionNoise
from swarmtwin.errors import UserError
from swarmtwin.simulation.mechanism import mechanism_class, mechanism_names
from swarmtwin.simulation.randomisation import Randomisation, with_known_actuation
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.simulation.unlike_vehicles import UnlikeVehicles
from tiny_policies import robot_named

NOISE = MotionNoise(
    at_rest=(0.2, 0.1, 1e-3), with_motion=(0.5, 0.1, 1e-2), usual_mm=20.0, usual_rad=0.3, camera=(0.2, 0.2, 1e-3)
)
MGR, MUR = robot_named("mgr"), robot_named("mur")


def bare(robot=MGR, motion_noise=NOISE):
    return Simulation(ExactDynamics(robot, motion_noise))


def read(content, simulation=None, draws=16):
    return Randomisation.read(content, simulation or bare(), draws)


def middle_range(bounds):
    """A range in the middle of a parameter's bounds."""
    return [bounds.low + share * bounds.size for share in (0.4, 0.6)]


def drive(moved, periods=4, seed=3, vehicles=3):
    """Poses (W, K, 3) of five worlds after random commands, drawn."""
    rng, drawn = np.random.default_rng(0), torch.Generator().manual_seed(seed)
    state = moved.start(torch.as_tensor(rng.uniform(300, 700, (5, vehicles, 3))), rng=drawn)
    for _ in range(periods):
        state = moved.step(state, torch.as_tensor(rng.uniform(-120, 120, (5, vehicles, 2))), rng=drawn)
    return moved.observe(state, drawn)


@pytest.mark.parametrize("name", mechanism_names())
@pytest.mark.parametrize("robot", [MGR, MUR], ids=["mgr", "mur"])
def test_every_mechanism_is_drawn_within_its_ranges(robot, name):
    simulation = Simulation(ExactDynamics(robot, NOISE), [mechanism_class("noise_change").at({"factor": 1.0})])
    simulation = Simulation(
        simulation.dynamics, simulation.mechanisms, conditions_of(robot), motion_noise=simulation.motion_noise
    )
    kind = mechanism_class(name)
    if not kind.suits(robot, simulation.conditions):
        with pytest.raises(UserError, match=f"randomisation.{name}: it makes no sense for robot {robot.name!r}"):
            read({name: {}}, simulation)
        return
    bounds = kind.bounds_of(robot, simulation.conditions)
    ranges = {parameter: middle_range(one) for parameter, one in bounds.items()}
    randomisation = read({name: ranges}, simulation)
    drawn = np.array([randomisation.draw(np.random.default_rng(seed), 2) for seed in range(50)])
    low, high = np.array(list(ranges.values())).T
    assert (drawn >= low).all()
    assert (drawn <= high).all()
    assert drawn.std(axis=(0, 1)) == pytest.approx((high - low) / 12**0.5, rel=0.25)
    assert (drawn[:, 0] == drawn[:, 1]).all()
    group = randomisation.group(simulation, drawn[0])
    assert isinstance(group, Simulation)
    own = next(one for one in group.mechanisms if one.name == name)
    assert [getattr(own, parameter) for parameter in ranges] == drawn[0, 0].tolist()
    state = group.start(torch.full((1, 2, 3), 500.0), rng=torch.Generator().manual_seed(0))
    command = torch.as_tensor(np.tile(robot.command_high, (1, 2, 1)))
    assert group.step(state, command, rng=torch.Generator().manual_seed(0)).pose.isfinite().all()


def test_what_is_of_vehicles_differs_among_them_and_what_is_of_the_world_does_not():
    randomisation = read(
        {"command_delay": {"delay_s": [0.0, 0.4]}, "gain_change": {"gain": [0.8, 1.2], "of": "vehicle"}}
    )
    values = randomisation.draw(np.random.default_rng(0), 6)
    assert values.shape == (6, 2)
    assert len(set(values[:, 0])) == 1
    assert len(set(values[:, 1])) == 6
    group = randomisation.group(with_known_actuation(bare()), values)
    assert isinstance(group, UnlikeVehicles)
    gains = [one.mechanisms[1].gain for one in group.simulations]
    assert gains == values[:, 1].tolist()


def test_a_range_without_width_is_the_extended_simulation_with_that_value():
    randomisation = read({"command_delay": {"delay_s": [0.3, 0.3]}, "command_loss": {"probability": [0.2, 0.2]}})
    assert randomisation.is_fixed
    base = with_known_actuation(bare())
    group = randomisation.group(base, randomisation.draw(np.random.default_rng(0), 3))
    extended = simulation_with(
        MGR,
        base.dynamics,
        base.conditions,
        NOISE,
        command_delay={"delay_s": 0.3},
        command_loss={"probability": 0.2},
    )
    assert torch.equal(drive(group), drive(extended))


def test_a_drawn_mechanism_stands_in_the_place_of_the_simulations_own_and_keeps_its_form():
    own = {"gain_change": {"gain": 0.5, "acts_on": "effort"}, "dead_band": {"width": 10.0}}
    group = read({"gain_change": {"gain": [0.9, 0.9]}}, simulation_with(MGR, **own)).group(
        simulation_with(MGR, **own), np.array([[0.9]])
    )
    kept = {one.name: one for one in group.mechanisms}
    assert (kept["gain_change"].gain, kept["gain_change"].acts_on) == (0.9, "effort")
    assert kept["dead_band"].width == 10.0
    chosen = read({"gain_change": {"gain": [0.9, 1.1], "acts_on": "effort"}})
    assert chosen.mechanisms[0].fixed == {"acts_on": "effort"}


def test_a_bare_model_shows_the_track_that_unlike_wheels_need():
    group = read({"actuator_asymmetry": {"ratio": [1.2, 1.2]}}).group(with_known_actuation(bare()), np.array([[1.2]]))
    assert group.conditions.track_mm == pytest.approx(84.0, rel=1e-3)
    state = group.step(group.start(torch.zeros(1, 1, 3)), torch.full((1, 1, 2), 100.0))
    slower, faster = 35 * 1.2**-0.5, 35 * 1.2**0.5
    assert float(state.pose[0, 0, 2]) == pytest.approx((slower - faster) / 84.0, rel=1e-3)


def test_vehicles_with_equal_parameters_move_as_in_one_simulation():
    values = {"command_delay": {"delay_s": 0.2}, "neighbour_interaction": {"strength_mm_s": 20.0, "reach_mm": 100.0}}
    one = simulation_with(MGR, **values)
    rng = np.random.default_rng(0)
    pose, commands = rng.uniform(300, 700, (4, 3, 3)), rng.uniform(-120, 120, (5, 4, 3, 2))
    ends = []
    for moved in (one, UnlikeVehicles([one] * 3)):
        state = moved.start(torch.as_tensor(pose))
        for command in commands:
            state = moved.step(state, torch.as_tensor(command))
        ends.append(moved.observe(state))
    assert ends[1].numpy() == pytest.approx(ends[0].numpy(), abs=1e-9)


def test_unlike_vehicles_share_a_clock_and_the_age_of_their_session():
    values = {"timing_jitter": {"spread": 0.2}, "battery_sag": {"loss": 0.3, "shape": 1.0}}
    moved = UnlikeVehicles([simulation_with(MGR, **values) for _ in range(3)])
    rng = torch.Generator().manual_seed(0)
    state = moved.start(torch.zeros(50, 3, 3), rng)
    assert len(set(state.elapsed_s[:, 0].tolist())) == 50
    before = state.elapsed_s
    after = moved.step(state, torch.full((50, 3, 2), 60.0), rng).elapsed_s - before
    assert (after == after[:, :1]).all()
    assert float(after.std()) == pytest.approx(0.1, rel=0.3)


MISTAKES = {
    "randomisation.command_dely: no such mechanism: 'command_dely': did you mean 'command_delay'": {"command_dely": {}},
    "randomisation.command_delay: no such parameter: 'delay': did you mean 'delay_s'": {"command_delay": {"delay": 1}},
    "randomisation.command_delay.delay_s: give a range of two numbers, .*, got 0.1": {
        "command_delay": {"delay_s": 0.1}
    },
    r"randomisation.command_delay.delay_s: \[0, 0.7\] is not within 0 to 0.5 s": {
        "command_delay": {"delay_s": [0, 0.7]}
    },
    r"\[0.3, 0.1\] begins above its end: did you mean \[0.1, 0.3\]": {"command_delay": {"delay_s": [0.3, 0.1]}},
    "randomisation.wall_effect: no range for reach_mm: add one, such as": {"wall_effect": {"loss": [0, 0.2]}},
    "randomisation.gain_change: give ranges of its parameters, such as {gain: ": {"gain_change": 0.3},
    "randomisation.gain_change: no range at all: give one": {"gain_change": {}},
    "randomisation.gain_change.of: 'vehicles': did you mean 'vehicle'": {
        "gain_change": {"gain": [0.9, 1.1], "of": "vehicles"}
    },
    "randomisation.gain_change: .*'acts_on'": {"gain_change": {"gain": [0.9, 1.1], "acts_on": "wheels"}},
    "randomisation.timing_jitter.of: all vehicles of a world have the same clock": {
        "timing_jitter": {"spread": [0, 0.1], "of": "vehicle"}
    },
    "randomisation.battery_sag: a bare dynamics model does not say how long a session lasts": {
        "battery_sag": {"loss": [0, 0.3], "shape": [1, 1]}
    },
    "randomisation: give mechanisms with ranges": {},
}


@pytest.mark.parametrize("message", MISTAKES)
def test_each_mistake_is_named_with_its_remedy(message):
    with pytest.raises(UserError, match=message):
        read(MISTAKES[message])


def test_noise_is_not_changed_where_nobody_knows_it():
    with pytest.raises(UserError, match="does not know how much its motion varies"):
        read({"noise_change": {"factor": [1, 2]}}, bare(motion_noise=None))
