"""The swimmer: nothing says how fast it swims, so strokes, trim, weeds and currents are looked at from outside."""

import mujoco
import numpy as np
import pytest
from rigid_drives import CALM, drive, true_displacements

from swarmtwin.standin.active_effects import ActiveEffects
from swarmtwin.standin.effects import parse_effects
from swarmtwin.standin.rigid_body.driving import drive_rigid_session
from swarmtwin.standin.rigid_body.swimmer import Swimmer
from swarmtwin.standin.session import StandInSession
from swarmtwin.studies.stand_in_recording import record
from swarmtwin.transitions import from_recording


@pytest.fixture(scope="module")
def mur(robots):
    return robots["mur"]


def steady(robot, command, *effects, runs=6, steps=14, settled=4):
    """Return the mean displacement (3,) in the periods before which a command was held for `settled` ones."""
    driven = drive(robot, CALM, *effects, runs=runs, steps=steps, drive=np.array([command], float))
    as_told = np.cumprod((driven.command[:, :, 0] == command).all(axis=-1), axis=1)[:, settled:].astype(bool)
    assert as_told.sum() > 20
    return true_displacements(driven)[:, settled:, 0][as_told].mean(axis=0)


def test_the_same_seed_gives_the_same_bytes(mur):
    session = StandInSession(mur, ("1",), runs=4, steps=4, seed=5)
    first, again = drive_rigid_session(session), drive_rigid_session(session)
    assert first.pose.tobytes() == again.pose.tobytes()
    assert first.state.tobytes() == again.state.tobytes()


def test_clean_drives_make_a_recording_nearly_all_of_which_is_usable(mur):
    footage, recording = record(StandInSession(mur, ("1",), 20, 20, 7, lost_poses=0.001), drive=drive_rigid_session)
    _, counts = from_recording(recording)
    assert counts.kept > 0.98 * 20 * 20
    assert (footage.state[0] > 0).all()
    assert (footage.state[0] < 2000).all()


def test_a_time_step_four_times_shorter_gives_nearly_the_same_motion(mur, monkeypatch):
    commands = np.random.default_rng(2).uniform(mur.command_low, mur.command_high, (50, 3))
    plan = {"runs": 10, "steps": 5, "drive": commands}
    usual = true_displacements(drive(mur, CALM, **plan))
    monkeypatch.setattr(Swimmer, "steps", 640)
    away = (usual - true_displacements(drive(mur, CALM, **plan)))[:, 0]
    assert np.sqrt((away[..., :2] ** 2).mean()) < 0.5
    assert np.sqrt((away[..., 2] ** 2).mean()) < 0.005


def test_a_swimmer_that_is_put_down_lies_still_until_its_fin_beats(mur):
    """Whoever it is: neither the walls nor a servo that throws a fin to its trim give it a push."""
    units = tuple("123456789")
    driven = drive(mur, CALM, vehicles=units, runs=3, steps=2, drive=np.array([[0.0, 0.0, 6.0]]))
    clear = (driven.state[:2].min(axis=(0, 2)) > 150.0) & (driven.state[1].max(axis=1) < 850.0)
    assert clear.sum() > 10
    moved = true_displacements(driven)[:, 0][clear]
    assert np.abs(moved[:, :2]).max() < 0.2
    assert np.abs(moved[:, 2]).max() < 0.002


def test_larger_strokes_and_faster_ones_swim_faster(mur):
    slow, large, fast = (steady(mur, (0, amplitude, omega))[0] for amplitude, omega in ((20, 4), (50, 4), (50, 8)))
    assert slow < 5
    assert large > 10
    assert 1.5 * large < fast < 100


def test_the_fin_steers_to_its_side_and_the_mirrored_fin_to_the_other(mur):
    left, right = (steady(mur, (angle, 40, 6)) for angle in (40, -40))
    assert 0.1 < left[2] < 1
    assert right[2] == pytest.approx(-left[2], abs=0.1)


def test_a_trim_turns_the_straight_fin_and_an_opposite_command_undoes_it(mur):
    trim = {"name": "actuator_asymmetry", "angle_rad": np.deg2rad(25)}
    plain, askew, undone = steady(mur, (0, 50, 6)), steady(mur, (0, 50, 6), trim), steady(mur, (-25, 50, 6), trim)
    assert askew[2] - plain[2] > 0.05
    np.testing.assert_allclose(undone, plain, atol=0.3)


def test_gain_is_the_strokes_size_and_a_weak_supply_shortens_them(mur):
    as_told, shorter = steady(mur, (0, 35, 6)), steady(mur, (0, 50, 6), {"name": "gain_change", "gain": 0.7})
    np.testing.assert_allclose(shorter, as_told, atol=1e-6)
    sagging = drive(mur, CALM, {"name": "battery_sag", "loss": 0.6}, runs=30, steps=8, drive=np.array([(0.0, 50, 6)]))
    forward = true_displacements(sagging)[:, 4:, 0, 0].mean(axis=1)
    assert forward[-8:].mean() < 0.7 * forward[:8].mean()


def test_a_current_carries_it_along_as_fast_as_it_flows(mur):
    """What floats with the water meets no drag, so the current's velocity is added and nothing else changes."""
    plan = {"runs": 6, "steps": 6, "drive": np.array([(0.0, 45, 5)])}
    drift = {"name": "steady_drift", "speed_mm_s": 20, "direction_rad": 0.7}
    plain, carried = drive(mur, CALM, **plan), drive(mur, CALM, drift, **plan)
    as_told = (plain.command == carried.command).all(axis=(1, 2, 3))
    assert as_told.sum() >= 3
    added = (carried.state - plain.state)[:2, as_told, -1, 0].T / (6 * 0.8)
    np.testing.assert_allclose(added, [[20 * np.cos(0.7), 20 * np.sin(0.7)]] * as_told.sum(), atol=2)


@pytest.mark.parametrize("loss", [0.2, 0.5])
def test_weeds_take_their_share_of_its_speed(mur, loss):
    """Its fin's drag is not among what weeds add to, and strokes push in turns: a tenth of the speed is left open."""
    weeds = {"name": "surface_patch", "loss": loss, "radius_mm": 4000}
    commands = [(0, 30, 6), (0, 50, 6), (0, 50, 9), (30, 45, 6)]
    left = [steady(mur, one, weeds)[0] / steady(mur, one)[0] for one in commands]
    assert np.mean(left) == pytest.approx(1 - loss, abs=0.05)
    assert max(left) - min(left) < 0.15
    turning = (40, 40, 6)
    assert steady(mur, turning, weeds)[2] < (1 - 0.6 * loss) * steady(mur, turning)[2]


def test_delay_and_lag_bring_the_turn_later(mur):
    """Turns follow the fin's mean angle: the share of them that falls into the next period grows."""

    def later_share(*effects):
        driven = drive(mur, CALM, *effects, runs=10, steps=20)
        angle = driven.command[:, :, 0, 0]
        design = np.stack([angle[:, 2:], angle[:, 1:-1], angle[:, :-2]], axis=-1).reshape(-1, 3)
        weight = np.linalg.lstsq(design, true_displacements(driven)[:, 2:, 0, 2].ravel())[0]
        return weight[1:].sum() / weight.sum()

    plain = later_share()
    assert later_share({"name": "command_delay", "delay_s": 0.3}) > plain + 0.15
    assert later_share({"name": "actuator_lag", "time_constant_s": 0.3}) > plain + 0.1


def play(travel_rad):
    return {"name": "backlash", "travel_rad": travel_rad}


@pytest.mark.parametrize("travel_rad", [0.1, 0.95])
def test_the_fins_play_is_as_wide_as_it_says(mur, travel_rad):
    swimmer = Swimmer(("1",), ActiveEffects(mur, parse_effects((play(travel_rad),), mur, 1)), mur.period_s)
    model = mujoco.MjModel.from_xml_string(swimmer.describe(0))
    assert np.ptp(model.jnt_range[model.jnt_limited.astype(bool)]) == pytest.approx(travel_rad)


def test_play_of_the_fin_takes_from_its_strokes_the_more_the_wider_it_is(mur):
    """With next to none it swims as without, and with as much as the stroke is wide it goes nowhere."""
    speeds = [steady(mur, (0, 40, 6), play(travel))[0] for travel in (0.005, 0.1, 0.3, 0.6, 0.95)]
    shares = np.array(speeds) / steady(mur, (0, 40, 6))[0]
    assert shares[0] == pytest.approx(1.0, abs=0.01)
    assert (np.diff(shares) < -0.03).all()
    assert abs(shares[-1]) < 0.1


def test_what_play_takes_does_not_hang_on_the_time_step(mur, monkeypatch):
    usual = steady(mur, (0, 40, 6), play(0.3))[0]
    monkeypatch.setattr(Swimmer, "steps", 640)
    assert steady(mur, (0, 40, 6), play(0.3))[0] == pytest.approx(usual, rel=0.03)


def test_an_engine_that_loses_a_vehicle_is_no_recording(mur, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # MuJoCo leaves its log there
    monkeypatch.setattr(Swimmer, "steps", 16)
    with pytest.raises(ArithmeticError, match="unstable"):
        drive(mur, runs=4, steps=6)
