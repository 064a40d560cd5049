"""Each effect does what it says, at its physical place, and nothing else."""

import pkgutil
import re
from pathlib import Path

import numpy as np
import pytest
from pairs import displacements, session

from swarmtwin.errors import UserError
from swarmtwin.geometry import wrap_angle
from swarmtwin.standin import effects as effects_package
from swarmtwin.standin.active_effects import ActiveEffects
from swarmtwin.standin.effect import Effect
from swarmtwin.standin.effects import catalogue, parse_effects
from swarmtwin.standin.exact_means import mean_given_situation, mean_given_state
from swarmtwin.standin.physics import Physics
from swarmtwin.standin.session import StandInSession, drive_session

CATALOGUE = {
    *("gain_change", "actuator_asymmetry", "dead_band", "saturation", "command_delay", "actuator_lag", "backlash"),
    *("battery_sag", "surface_patch", "steady_drift", "wall_effect", "neighbour_interaction", "camera_scale"),
    *("lens_distortion", "marker_offset", "marker_yaw", "command_loss", "timing_jitter", "noise_change"),
}
CAMERA = ("camera_scale", "lens_distortion", "marker_offset", "marker_yaw")

# Two strengths of each effect, the weaker first, by robot.
STRENGTHS = {
    "gain_change": ({"gain": 0.9}, {"gain": 0.7}),
    "actuator_asymmetry": {
        "mgr": ({"ratio": 1.1}, {"ratio": 1.4}),
        "mur": ({"angle_rad": 0.1}, {"angle_rad": 0.3}),
    },
    "dead_band": {"mgr": ({"width": 20}, {"width": 50}), "mur": ({"width": 8}, {"width": 25})},
    "saturation": {"mgr": ({"limit": 90}, {"limit": 50}), "mur": ({"limit": 45}, {"limit": 20})},
    "command_delay": ({"delay_s": 0.08}, {"delay_s": 0.3}),
    "actuator_lag": ({"time_constant_s": 0.05}, {"time_constant_s": 0.25}),
    "backlash": {
        "mgr": ({"travel_mm": 2}, {"travel_mm": 8}),
        "mur": ({"travel_rad": 0.05}, {"travel_rad": 0.3}),
    },
    "battery_sag": ({"loss": 0.15}, {"loss": 0.5}),
    "surface_patch": ({"loss": 0.2}, {"loss": 0.7}),
    "steady_drift": ({"speed_mm_s": 3}, {"speed_mm_s": 12}),
    "wall_effect": ({"loss": 0.3}, {"loss": 0.8}),
    "neighbour_interaction": ({"strength_mm_s": 15}, {"strength_mm_s": 60}),
    "camera_scale": ({"scale": 1.03}, {"scale": 1.12}),
    "lens_distortion": ({"coefficient": 0.05}, {"coefficient": 0.2}),
    "marker_offset": ({"forward_mm": 4}, {"forward_mm": 15}),
    "marker_yaw": ({"angle_rad": 0.05}, {"angle_rad": 0.2}),
    "command_loss": ({"probability": 0.05}, {"probability": 0.3}),
    "timing_jitter": ({"spread": 0.04}, {"spread": 0.15}),
    "noise_change": ({"factor": 1.3}, {"factor": 2.5}),
}


@pytest.fixture(scope="module")
def plain(robots):
    """Displacements of short sessions without an effect, by robot."""
    return {name: displacements(drive_session(session(robots[name], steps=3))) for name in ("mgr", "mur")}


@pytest.fixture(scope="module")
def unchanged(robots):
    """Sessions without an effect, by robot."""
    return {name: drive_session(session(robots[name], steps=8)) for name in ("mgr", "mur")}


@pytest.fixture(scope="module")
def unchanged_with_losses(robots):
    """A session without an effect in which the camera misses markers."""
    return drive_session(session(robots["mgr"], steps=8, lost_poses=0.1))


def strengths(name, robot):
    given = STRENGTHS[name]
    return given[robot] if isinstance(given, dict) else given


def test_the_catalogue_the_registry_and_the_disk_agree():
    on_disk = {path.stem for path in Path(effects_package.__file__).parent.glob("*.py")} - {"__init__"}
    assert set(catalogue()) == CATALOGUE == on_disk == set(STRENGTHS)
    assert {module.name for module in pkgutil.iter_modules(effects_package.__path__)} == CATALOGUE


@pytest.mark.parametrize("name", sorted(CATALOGUE))
def test_every_effect_has_defaults_that_do_something_to_both_robots(robots, unchanged, name):
    for robot, plain in unchanged.items():
        changed = drive_session(session(robots[robot], {"name": name}, steps=8))
        assert not np.array_equal(plain.pose, changed.pose)
        moved = changed.state - plain.state
        assert (name in CAMERA) == (not moved.any())


@pytest.mark.parametrize("name", sorted(CATALOGUE))
def test_a_stronger_effect_does_more(robots, plain, name):
    for robot, without in plain.items():

        def size(entry, without=without, robot=robot):
            change = displacements(drive_session(session(robots[robot], entry, steps=3))) - without
            change[..., 2] = wrap_angle(change[..., 2])
            scale = np.array([1.0, 1.0, 30.0])
            return np.sqrt(np.mean((change * scale) ** 2))

        weak, strong = (size({"name": name, **parameters}) for parameters in strengths(name, robot))
        assert 0 < weak < strong


@pytest.mark.parametrize("name", sorted(CATALOGUE))
def test_no_effect_shifts_the_other_sources_of_randomness(robots, unchanged_with_losses, name):
    plain = unchanged_with_losses
    changed = drive_session(session(robots["mgr"], {"name": name}, steps=8, lost_poses=0.1))
    np.testing.assert_array_equal(plain.state[:, :, 0], changed.state[:, :, 0])
    np.testing.assert_array_equal(plain.command[:, 0], changed.command[:, 0])
    np.testing.assert_array_equal(np.isnan(plain.pose), np.isnan(changed.pose))

    def camera_noise(driven):
        seen = driven.session.conditions.seen(np.moveaxis(driven.state[:3], 0, -1))
        noise = driven.pose - seen
        return np.concatenate([noise[..., :2], wrap_angle(noise[..., 2:])], axis=-1)

    np.testing.assert_allclose(camera_noise(plain), camera_noise(changed), atol=1e-9)


def test_effects_combine(robots):
    robot = robots["mgr"]
    both = ({"name": "gain_change", "gain": 0.8}, {"name": "camera_scale", "scale": 1.25})
    alone = drive_session(session(robot, both[0]))
    together = drive_session(session(robot, *both))
    np.testing.assert_array_equal(alone.state, together.state)
    np.testing.assert_allclose(mean_given_state(together)[..., :2], 1.25 * mean_given_state(alone)[..., :2], atol=2e-3)
    everything = [{"name": name} for name in sorted(CATALOGUE)]
    for other in (robot, robots["mur"]):
        driven = drive_session(session(other, *everything, runs=3, steps=5))
        assert np.isfinite(driven.pose).all()
        assert np.isfinite(mean_given_state(driven)).all()


def test_an_effect_from_outside_the_catalogue_needs_no_registering(robots, monkeypatch):
    class EastWind(Effect):
        """Vehicles that look east are held back."""

        def traction(self, placement, arena):
            return 1.0 - 0.5 * (np.cos(placement.heading_rad) > 0.7)

    monkeypatch.setattr(Physics, "bank_rows", 1024)
    driven = drive_session(StandInSession(robots["mgr"], ("1",), 40, 20, 11, (EastWind(),)))
    expected = mean_given_situation(driven)
    plain = drive_session(StandInSession(robots["mgr"], ("1",), 40, 20, 11))
    ratio = np.abs(expected / mean_given_situation(plain))[..., 0, 0][:, 0]
    east = np.cos(driven.state[2, :, 0, 0]) > 0.9
    strong = (np.abs(driven.command[:, 0, 0]) > 60).all(axis=-1)
    assert (ratio[east & strong] < 0.7).all()


REFUSED = [
    (
        "mgr",
        {"name": "batery_sag"},
        "effects: unknown effect 'batery_sag': did you mean 'battery_sag'? known: actuator_",
    ),
    ("mgr", {"name": "battery_sag", "los": 1}, "effect 'battery_sag': unknown field 'los': did you mean 'loss'?"),
    (
        "mgr",
        {"name": "battery_sag", "loss": 3},
        "effect 'battery_sag': field 'loss': Input should be less than 1, got 3",
    ),
    ("mgr", "battery_sag", "effects: 'battery_sag' is no effect: write {name: battery_sag, loss: 0.3}"),
    ("mgr", {"loss": 0.3}, "effects: {'loss': 0.3} is no effect: write {name: battery_sag, loss: 0.3}"),
    (
        "mgr",
        {"name": "actuator_asymmetry", "angle_rad": 0.1},
        "effect 'actuator_asymmetry': angle_rad means nothing to 'mgr', which has wheels: give ratio",
    ),
    (
        "mur",
        {"name": "backlash", "travel_mm": 3},
        "effect 'backlash': travel_mm means nothing to 'mur', which has a tail fin: give travel_rad",
    ),
    (
        "mgr",
        {"name": "dead_band", "width": 120},
        "effect 'dead_band': width 120 leaves 'mgr' no command that does anything: give less than 120",
    ),
    (
        "mur",
        {"name": "saturation", "limit": 80},
        "effect 'saturation': limit 80 cuts no command of 'mur': give less than 60",
    ),
    (
        "mgr",
        {"name": "command_delay", "delay_s": 0.6},
        "effect 'command_delay': delay_s 0.6 is longer than the period of 'mgr': give at most 0.5",
    ),
    (
        "mgr",
        {"name": "neighbour_interaction"},
        "effect 'neighbour_interaction' needs neighbours: give two vehicles or more, vehicle=[1,2]",
    ),
    (
        "mgr",
        {"name": "surface_patch", "x_mm": 3000, "radius_mm": 100},
        "effect 'surface_patch': the disc around x_mm 3000, y_mm 515 lies outside the arena: x [0.0, 1030.0], y [0.0",
    ),
]


@pytest.mark.parametrize(("robot", "entry", "message"), REFUSED)
def test_what_makes_no_sense_is_refused_with_a_reason(robots, robot, entry, message):
    with pytest.raises(UserError, match=f"^{re.escape(message)}"):
        parse_effects([entry], robots[robot], 1)


def test_delays_together_are_no_longer_than_a_period(robots):
    def delays(*delays_s):
        return parse_effects([{"name": "command_delay", "delay_s": delay_s} for delay_s in delays_s], robots["mgr"], 1)

    assert ActiveEffects(robots["mgr"], delays(0.1, 0.1, 0.3)).delay_s == pytest.approx(0.5)
    with pytest.raises(UserError) as refused:
        delays(0.3, 0.3)
    assert str(refused.value) == (
        "effect 'command_delay': delay_s 0.6 is longer than the period of 'mgr': give at most 0.5, all delays together"
    )
