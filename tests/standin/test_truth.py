"""The answer book against brute force. Limits: a fair draw exceeds them in fewer than one of a thousand seeds."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from swarmtwin.errors import UserError
from swarmtwin.geometry import displacement_between
from swarmtwin.standin import truth
from swarmtwin.standin.effects import parse_effects
from swarmtwin.standin.physics import advance
from swarmtwin.standin.session import Session, film
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
def footage(request, robots):
    name, entries = CASES[request.param]
    robot = robots[name]
    return film(Session(robot, ("1",), 60, 25, 9, parse_effects(entries, robot, 1)))


def repeated_measurements(footage, rows, rng):
    """Return displacements (rows, REPEATS, 3) measured when rows are repeated from their true states."""
    session = footage.session
    physics = session.physics(session.vehicles)
    picked = truth.Rows(*(value[..., rows, :] for value in vars(truth.Rows.of(footage, 0)).values()))
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


def test_the_mean_given_everything_is_that_of_repeated_measurements(footage):
    rng = np.random.default_rng(2)
    rows = np.arange(7, 1500, 25)
    measured = repeated_measurements(footage, rows, rng)
    expected = truth.expected_given_everything(footage)[:, :, 0].reshape(-1, 3)[rows]
    standard_error = measured.std(axis=1) / np.sqrt(REPEATS)
    own_error = np.array([0.05, 0.05, 0.0005])
    off = (measured.mean(axis=1) - expected) / np.hypot(standard_error, own_error)
    assert np.abs(off).max() < 4.5
    assert (np.abs(off) < 3).mean() > 0.97
    assert (np.abs(off.mean(axis=0)) < 3.5 / np.sqrt(len(rows))).all()


def test_what_is_measured_scatters_evenly_about_the_mean_given_the_situation(footage):
    """In every part of the command space, and in every part of the session, residuals average to nothing."""
    expected = truth.expected_given_situation(footage)[:, :, 0].reshape(-1, 3)
    residual = displacement_between(footage.pose[:, :-1, 0], footage.pose[:, 1:, 0]).reshape(-1, 3) - expected
    parts = [footage.command[:, :, 0, column].ravel() for column in range(footage.command.shape[-1])]
    parts.append(footage.time_s[:, :-1].ravel())
    for values in parts:
        for part in np.array_split(np.argsort(values), 6):
            off = residual[part].mean(axis=0) / (residual[part].std(axis=0) / np.sqrt(len(part)))
            assert np.abs(off).max() < 4


def test_memory_is_worth_something(footage):
    measured = displacement_between(footage.pose[:, :-1], footage.pose[:, 1:])
    situation = measured - truth.expected_given_situation(footage)
    everything = measured - truth.expected_given_everything(footage)
    assert (everything.std(axis=(0, 1, 2)) < 0.95 * situation.std(axis=(0, 1, 2))).all()


def test_the_mgrs_mean_is_exact_to_a_twentieth_of_a_millimetre(robots, monkeypatch):
    footage = film(Session(robots["mgr"], ("1",), 50, 20, 9))
    first = truth.expected_given_situation(footage)
    monkeypatch.setattr(truth, "film", lambda session, purpose: film(session, purpose + "again"))
    monkeypatch.setattr(truth, "Streams", lambda seed, purpose: Streams(seed + 1, purpose))
    again = truth.expected_given_situation(footage)
    error = (first - again).std(axis=(0, 1, 2)) / np.sqrt(2)
    assert (error < [0.06, 0.06, 0.002]).all()


def test_an_ageing_robots_mean_knows_the_time(robots):
    """At the end of the session the motion before was weak as well: the bank of hidden states knows."""
    robot = robots["mgr"]
    session = Session(robot, ("1",), 60, 25, 9, parse_effects([{"name": "battery_sag", "loss": 0.6}], robot, 1))
    footage = film(session)
    fresh = replace(footage, session=replace(session, effects=()))
    ratio = np.abs(truth.expected_given_situation(footage)) / np.abs(truth.expected_given_situation(fresh))
    strong = np.abs(footage.command).min(axis=-1) > 60
    forward = ratio[..., 0]
    strength = 1 - 0.6 * session.progress(footage.time_s[:, :-1, None])
    for third in np.array_split(np.arange(60), 3):
        assert abs(np.median((forward / strength)[third][strong[third]]) - 1) < 0.01


def test_an_answer_book_is_read_as_it_was_written(robots, tmp_path):
    footage = film(Session(robots["mgr"], ("1", "2"), 3, 4, 9))
    table = truth.answer_book(footage, ["run_0001", "run_0002", "run_0003"])
    truth.write_truth(tmp_path, table)
    read = truth.read_truth(tmp_path)
    assert read.equals(table)
    assert list(read) == ["run", "vehicle", "time_s", *truth.TRUTH_COLUMNS]
    assert (read.dtypes[list(truth.TRUTH_COLUMNS)] == np.float32).all()
    row = read[(read["run"] == "run_0002") & (read["vehicle"] == "2")].iloc[3]
    assert row["time_s"] == footage.time_s[1, 3]
    everything = truth.expected_given_everything(footage)[1, 3, 1]
    np.testing.assert_array_equal(row[list(truth.TRUTH_COLUMNS[3:])].to_numpy(np.float32), everything)


def test_a_recording_without_an_answer_book_says_so(tmp_path):
    with pytest.raises(UserError, match="only recordings of stand-ins made by `swarmtwin record` have an answer book"):
        truth.read_truth(tmp_path)


def truncated(file):
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 2])


DAMAGES = {
    "empty": lambda file: file.write_bytes(b""),
    "truncated": truncated,
    "text": lambda file: file.write_text("run,vehicle,time_s"),
    "a column short": lambda file: pd.read_parquet(file).drop(columns="everything_turn_rad").to_parquet(file),
    "a folder": lambda file: (file.unlink(), file.mkdir()),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_a_damaged_answer_book_is_one_clear_error(tmp_path, damage):
    columns = {"run": ["run_0001"], "vehicle": ["1"], "time_s": [0.0], **{name: [1.0] for name in truth.TRUTH_COLUMNS}}
    truth.write_truth(tmp_path, pd.DataFrame(columns))
    assert len(truth.read_truth(tmp_path)) == 1
    damage(tmp_path / truth.TRUTH_FILE)
    with pytest.raises(UserError) as refused:
        truth.read_truth(tmp_path)
    message = str(refused.value)
    assert message.startswith(f"{tmp_path / truth.TRUTH_FILE} is damaged (")
    assert message.endswith("): copy it again, or record again with the same options and seed")
    assert "\n" not in message
