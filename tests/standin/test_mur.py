import numpy as np
import pytest

from swarmtwin.geometry import displacement_between
from swarmtwin.standin.active_effects import ActiveEffects
from swarmtwin.standin.physics import Period, Surroundings, advance
from swarmtwin.standin.robots.mur import MurUnit, StandIn

COUNT = 60
LOW, HIGH = np.array([-79, 0, 3.0]), np.array([79, 60, 9.0])
COMMANDS = np.random.default_rng(4).uniform(LOW, HIGH, (COUNT, 3)).T[:, :, None]
STILL = np.array([0.0, 0.0, 3.0]).reshape(3, 1, 1) * np.ones((1, COUNT, 1))
MIDDLE = np.array([1000.0, 500.0, 0.4]).reshape(3, 1, 1) * np.ones((1, COUNT, 1))
MIRROR = np.array([-1.0, 1.0, 1.0]).reshape(3, 1, 1)
PHASE = StandIn.states.index("phase_rad")


def swim(physics, state, command, periods=1, noise=None):
    for _ in range(periods):
        state = advance(physics, state, Period(command, command, 0.8, 0.0), noise)
    return state


def between(start, end):
    return displacement_between(np.moveaxis(start[:3], 0, -1), np.moveaxis(end[:3], 0, -1))[:, 0]


@pytest.fixture
def drawn(robots):
    return StandIn(MurUnit.as_drawn(), ActiveEffects(robots["mur"]))


def test_a_mirrored_fin_mirrors_the_motion(drawn):
    along_the_pool = MIDDLE * np.array([1, 1, 0]).reshape(3, 1, 1)
    state, opposite = drawn.at_rest(along_the_pool), drawn.at_rest(along_the_pool)
    opposite[PHASE] = np.pi
    moved = between(state, swim(drawn, state, COMMANDS, 2))
    mirrored = between(opposite, swim(drawn, opposite, COMMANDS * MIRROR, 2))
    np.testing.assert_allclose(mirrored, moved * [1, -1, -1], atol=1e-6)


def test_a_still_fin_in_still_water_does_not_move_the_vehicle(drawn):
    state = drawn.at_rest(MIDDLE)
    np.testing.assert_allclose(between(state, swim(drawn, state, STILL, 3)), 0, atol=1e-9)


def test_speed_persists_and_fades_when_the_fin_stops(drawn):
    ahead = np.array([0.0, 40.0, 8.0]).reshape(3, 1, 1) * np.ones((1, COUNT, 1))
    moving = swim(drawn, drawn.at_rest(MIDDLE), ahead, 3)
    first = swim(drawn, moving, STILL)
    second = swim(drawn, first, STILL)
    coasted, further = between(moving, first)[:, 0], between(first, second)[:, 0]
    assert (coasted > 10).all()
    assert ((further > 1) & (further < 0.7 * coasted)).all()


def test_the_fins_phase_goes_on_from_command_to_command(drawn):
    state = swim(drawn, drawn.at_rest(MIDDLE), COMMANDS)
    after = swim(drawn, state, STILL)
    frequency = drawn.states.index("frequency_rad_s")
    assert (state[frequency] > 2.9).all()
    turned = np.mod(after[PHASE] - state[PHASE], 2 * np.pi)
    settling_s = drawn.setting_s * (state[frequency] - 3.0)
    np.testing.assert_allclose(turned, np.mod(3.0 * 0.8 + settling_s, 2 * np.pi), atol=0.08)


def test_near_a_wall_the_same_fin_brings_the_vehicle_less_far(drawn):
    ahead = np.array([0.0, 40.0, 8.0]).reshape(3, 1, 1) * np.ones((1, COUNT, 1))
    distance_mm = np.linspace(80, 500, COUNT)
    start = np.stack([np.full(COUNT, 600.0), distance_mm, np.zeros(COUNT)])[:, :, None]
    state = drawn.at_rest(start)
    forward_mm = between(state, swim(drawn, state, ahead, 2))[:, 0]
    assert (np.diff(forward_mm) > 0).all()
    assert forward_mm[0] < 0.9 * forward_mm[-1]


def test_no_vehicle_leaves_the_pool_or_goes_through_a_wall_however_hard_it_swims(drawn):
    rng = np.random.default_rng(0)
    edge = rng.uniform((80, 80, -np.pi), (1920, 920, np.pi), (COUNT, 3)).T[:, :, None]
    ahead = np.array([0.0, 60.0, 9.0]).reshape(3, 1, 1) * np.ones((1, COUNT, 1))
    state = drawn.at_rest(edge)
    for _ in range(25):
        state = swim(drawn, state, ahead, noise=3 * rng.standard_normal((drawn.substeps, 3, COUNT, 1)))
        assert (state[0] >= 80 - 1e-9).all()
        assert (state[0] <= 1920 + 1e-9).all()
        assert (state[1] >= 80 - 1e-9).all()
        assert (state[1] <= 920 + 1e-9).all()


def test_what_touches_a_wall_keeps_its_speed_along_it_and_loses_it_across(drawn):
    state = drawn.at_rest(np.array([1000.0, 919.9, np.pi / 4]).reshape(3, 1, 1))
    state[3] = 50.0
    after = drawn.step(state, drawn.target(STILL[:, :1], 1.0), 0.02, surroundings=Surroundings(), noise=None)
    heading = after[2, 0, 0]
    along = np.cos(heading) * after[3, 0, 0] - np.sin(heading) * after[4, 0, 0]
    across = np.sin(heading) * after[3, 0, 0] + np.cos(heading) * after[4, 0, 0]
    assert along > 25
    assert abs(across) < 1e-9


def test_the_time_step_converges_with_first_order(drawn, monkeypatch):
    def end(substeps):
        monkeypatch.setattr(StandIn, "substeps", substeps)
        state = drawn.at_rest(MIDDLE)
        return between(state, swim(drawn, state, COMMANDS))

    exact = end(5120)
    steps = np.array([40, 80, 160, 320])
    error = [np.sqrt(np.mean((end(count) - exact)[:, :2] ** 2)) for count in steps]
    order = -np.polyfit(np.log(steps), np.log(error), 1)[0]
    assert 0.8 < order < 1.25
    assert error[0] < 2.0
