"""The exact means against brute force. Limits: a fair draw exceeds them in fewer than one of a thousand seeds."""

from dataclasses import replace

import numpy as np
import pytest

from swarmtwin.geometry import displacement_between
from swarmtwin.standin import exact_means
from swarmtwin.standin.driven_rows import DrivenRows
from swarmtwin.standin.effects import parse_effects
from swarmtwin.standin.exact_means import mean_given_situation, mean_given_state, means_given_commands
from swarmtwin.standin.physics import Physics, advance
from swarmtwin.standin.session import StandInSession, drive_session
from swarmtwin.standin.streams import Streams

REPEATS = 500
CASES = {
    "mgr": ("mgr", []),
    "mur": ("mur", []),
    "mgr with effects": (
        "mgr",
        [
            {"name": "command_loss", "probability": 0.2},
            {"name": "battery_sag", "loss": 0.5},
            {"name": "marker_offset", "left_mm": 12},
            {"name": "lens_distortion"},
            {"name": "timing_jitter"},
        ],
    ),
    "mur with effects": ("mur", [{"name": "command_delay", "delay_s": 0.3}, {"name": "surface_patch"}]),
}


@pytest.fixture(scope="module", params=CASES)
def driven(request, robots):
    name, entries = CASES[request.param]
    robot = robots[name]
    return drive_session(StandInSession(robot, ("1",), 60, 25, 9, parse_effects(entries, robot, 1)))


@pytest.fixture(scope="module")
def given_state(driven):
    """Means (R · T, 3) given the true state."""
    return mean_given_state(driven)[:, :, 0].reshape(-1, 3)


@pytest.fixture(scope="module")
def levels(driven, given_state):
    """Means (levels, R · T, 3) given the situation, one command before, two before, and the true state; what came."""
    means = [mean[:, :, 0].reshape(-1, 3) for mean in means_given_commands(driven, 2)]
    measured = displacement_between(driven.pose[:, :-1, 0], driven.pose[:, 1:, 0]).reshape(-1, 3)
    return np.stack([*means, given_state]), measured


def repeated_measurements(driven, rows, rng):
    """Return displacements (rows, REPEATS, 3) measured when rows are repeated from their true states."""
    session = driven.session
    physics = session.physics(session.vehicles)
    picked = DrivenRows(*(value[..., rows, :] for value in vars(DrivenRows.of(driven, 0)).values()))
    shape = (len(rows), REPEATS)
    state, command, before = (
        np.broadcast_to(value, (len(value), *shape)) for value in (picked.state, picked.command, picked.active_command)
    )
    arriving = np.where(rng.random(shape) < session.conditions.loss_probability, before, command)
    noise = rng.standard_normal((physics.substeps, physics.noises, *shape))
    after = advance(physics, state, picked.period(arriving, before), noise)
    size = np.array([physics.position_noise_mm, physics.position_noise_mm, physics.heading_noise_rad])

    def measured(state):
        true = session.conditions.seen(np.moveaxis(state[:3], 0, -1))
        return true + size * rng.standard_normal(true.shape)

    return displacement_between(measured(state), measured(after))


def test_the_mean_given_everything_is_that_of_repeated_measurements(driven, given_state):
    rng = np.random.default_rng(2)
    rows = np.arange(7, 1500, 25)
    measured = repeated_measurements(driven, rows, rng)
    expected = given_state[rows]
    standard_error = measured.std(axis=1) / np.sqrt(REPEATS)
    own_error = np.array([0.05, 0.05, 0.0005])
    off = (measured.mean(axis=1) - expected) / np.hypot(standard_error, own_error)
    assert np.abs(off).max() < 4.5
    assert (np.abs(off) < 3).mean() > 0.97
    assert (np.abs(off.mean(axis=0)) < 3.5 / np.sqrt(len(rows))).all()


def test_what_is_measured_scatters_evenly_about_the_mean_given_the_situation(driven, levels):
    """In every part of the command space, and in every part of the session, residuals average to nothing."""
    means, measured = levels
    residual = measured - means[0]
    parts = [driven.command[:, :, 0, column].ravel() for column in range(driven.command.shape[-1])]
    parts.append(driven.time_s[:, :-1].ravel())
    for values in parts:
        for part in np.array_split(np.argsort(values), 6):
            off = residual[part].mean(axis=0) / (residual[part].std(axis=0) / np.sqrt(len(part)))
            assert np.abs(off).max() < 4


def test_what_is_measured_scatters_evenly_about_the_means_given_commands(driven, levels):
    """In every part of the space of the commands that are given, residuals average to nothing."""
    means, measured = levels
    command = driven.command[:, :, 0]
    for before in (1, 2):
        has_history = np.zeros(command.shape[:2], bool)
        has_history[:, before:] = True
        residual = (measured - means[before]).reshape(*command.shape[:2], 3)[has_history]
        for back in range(before + 1):
            given = command[:, before - back : command.shape[1] - back].reshape(-1, command.shape[-1])
            for values in given.T:
                for part in np.array_split(np.argsort(values), 6):
                    off = residual[part].mean(axis=0) / (residual[part].std(axis=0) / np.sqrt(len(part)))
                    assert np.abs(off).max() < 4.5


def test_knowing_more_leaves_less_to_err(levels):
    """Squared errors fall from the situation to the command before, and never rise with what else is known.

    Each step is judged by its standard error over rows: the first must be worth something, the others cost nothing.
    """
    means, measured = levels
    gained = -np.diff((measured - means) ** 2, axis=0)
    deviations = gained.mean(axis=1) / (gained.std(axis=1) / np.sqrt(len(measured)))
    assert (deviations[0] > 3.1).all()
    assert (deviations[1:] > -3.1).all()


@pytest.mark.parametrize("name", ["mgr", "mur"])
def test_the_same_history_has_the_same_mean_whatever_the_state(robots, name, monkeypatch):
    """Rows alike in pose and commands, unlike in what nobody sees: one mean given the history, many given the state."""
    monkeypatch.setattr(Physics, "bank_rows", 16_384)
    robot = robots[name]
    driven = drive_session(StandInSession(robot, ("1",), 40, 6, 9))
    state, active, command = driven.state.copy(), driven.active_command.copy(), driven.command.copy()
    row, before = 5, slice(3, 5)
    state[:3, :, row], command[:, before], active[:, :, row] = (
        state[:3, :1, row],
        command[:1, before],
        command[0, row - 1].T[:, None],
    )
    command[:, row] = command[:1, row]
    alike = replace(driven, state=state, active_command=active, command=command)
    given_state, given_history = mean_given_state(alike), means_given_commands(alike, 2)
    for mean in given_history[1:]:
        same, own = mean[:, row, 0], given_state[:, row, 0]
        assert (same.std(axis=0) < 0.25 * own.std(axis=0)).all()
        assert np.abs((same.mean(axis=0) - same[0]) / own.std(axis=0)).max() < 1


def test_the_mgr_forgets_all_but_the_command_before(robots):
    """Its motors settle within a period: given the previous command there is nothing left that the state could add."""
    driven = drive_session(StandInSession(robots["mgr"], ("1",), 60, 20, 9))
    _, history = means_given_commands(driven, 1)
    off = np.sqrt(((history - mean_given_state(driven)) ** 2).mean(axis=(0, 1, 2)))
    assert (off < [0.06, 0.06, 0.002]).all()


def test_a_run_s_first_rows_are_known_to_come_from_rest(robots, monkeypatch):
    """Whatever states the bank holds: none is drawn for them."""
    monkeypatch.setattr(Physics, "bank_rows", 4096)
    driven = drive_session(StandInSession(robots["mgr"], ("1",), 60, 4, 9))
    for mean in means_given_commands(driven, 2)[1:]:
        off = np.sqrt(((mean - mean_given_state(driven))[:, 0] ** 2).mean(axis=(0, 1)))
        assert (off < [0.06, 0.06, 0.002]).all()


def test_the_mgrs_mean_is_exact_to_a_twentieth_of_a_millimetre(robots, monkeypatch):
    driven = drive_session(StandInSession(robots["mgr"], ("1",), 50, 20, 9))
    first = mean_given_situation(driven)
    monkeypatch.setattr(
        exact_means, "drive_session", lambda session, purpose: drive_session(session, purpose + "again")
    )
    monkeypatch.setattr(exact_means, "Streams", lambda seed, purpose: Streams(seed + 1, purpose))
    again = mean_given_situation(driven)
    error = (first - again).std(axis=(0, 1, 2)) / np.sqrt(2)
    assert (error < [0.06, 0.06, 0.002]).all()


def test_an_ageing_robots_mean_knows_the_time(robots):
    """At the end of the session the motion before was weak as well: the bank of hidden states knows."""
    robot = robots["mgr"]
    session = StandInSession(robot, ("1",), 60, 25, 9, parse_effects([{"name": "battery_sag", "loss": 0.6}], robot, 1))
    driven = drive_session(session)
    fresh = replace(driven, session=replace(session, effects=()))
    ratio = np.abs(mean_given_situation(driven)) / np.abs(mean_given_situation(fresh))
    strong = np.abs(driven.command).min(axis=-1) > 60
    forward = ratio[..., 0]
    strength = 1 - 0.6 * session.progress(driven.time_s[:, :-1, None])
    for third in np.array_split(np.arange(60), 3):
        assert abs(np.median((forward / strength)[third][strong[third]]) - 1) < 0.01
