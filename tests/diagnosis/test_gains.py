"""Gains: open loop is measured on the poses that one-step errors are, in the recording's own arena."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from diagnosis_factories import DELAY, made_result, made_session
from scipy import stats

from swarmtwin.diagnosis.diagnose import causes_off_clock
from swarmtwin.diagnosis.gains import (
    Errors,
    gain_by_loss,
    gains,
    likelihood_gain,
    not_confirmed,
    not_shown_in_open_loop,
    scored_tracks,
)
from swarmtwin.diagnosis.open_loop_pieces import pieces
from swarmtwin.diagnosis.reference import Reference
from swarmtwin.diagnosis.report import page
from swarmtwin.diagnosis.result import Gain, Gains
from swarmtwin.diagnosis.saved_diagnosis import save_findings
from swarmtwin.errors import UserError
from swarmtwin.recordings.recording import Recording
from swarmtwin.robot import Arena
from swarmtwin.simulation.mechanism import mechanism_class
from swarmtwin.simulation.mechanisms import command_loss
from swarmtwin.simulation.simulation import Simulation
from swarmtwin.standin.session import StandInSession
from swarmtwin.studies.stand_in_recording import record
from swarmtwin.transitions import from_recording

STEPS = 40


@pytest.fixture(scope="module")
def recordings(robots):
    """A reference and a later session of the same vehicle, in which nothing is wrong."""
    sessions = (StandInSession(robots["mgr"], ("1",), runs, STEPS, seed) for runs, seed in ((30, 11), (24, 12)))
    return [record(session)[1] for session in sessions]


@pytest.fixture(scope="module")
def reference(recordings):
    return Reference.learn(from_recording(recordings[0])[0], 1)


def misread(recording, run, row, off_mm=400.0):
    """The same recording with one pose of a run read elsewhere, as of a swapped marker."""
    tracks = list(recording.tracks)
    pose = tracks[run].pose.copy()
    pose[row, 0] += off_mm if pose[row, 0] < 515 else -off_mm
    tracks[run] = dataclasses.replace(tracks[run], pose=pose)
    return dataclasses.replace(recording, tracks=tuple(tracks))


def errors_of(reference, recording):
    session, believable, _ = reference.comparable(recording)
    simulation = Simulation(reference.base, (), session.conditions)
    scored = session.transitions
    return Errors.of(simulation, scored, scored_tracks(recording, believable, scored))


def test_a_pose_that_no_transition_is_made_of_is_no_open_loop_error(reference, recordings):
    damaged = misread(misread(recordings[1], 3, 0), 7, 17)
    before, after = (errors_of(reference, recording) for recording in (recordings[1], damaged))
    for loops in (lambda errors: errors.open_loop, lambda errors: errors.ten_periods):
        known, misread_mm = (np.mean([loop.rmse_mm for loop in loops(errors)]) for errors in (before, after))
        assert misread_mm == pytest.approx(known, rel=0.1)
    assert after.one_step[:, 0].mean() == pytest.approx(before.one_step[:, 0].mean(), rel=0.05)


def test_open_loop_is_compared_at_the_ends_of_the_scored_transitions_alone(recordings):
    recording = misread(recordings[1], 0, 9)
    believable = from_recording(recording)[0]
    is_scored = np.isfinite(believable.previous_command).all(axis=1) & (believable.command[:, 0] > -60)
    scored = believable.where(is_scored & (believable.run == 0))
    (track,) = scored_tracks(recording, believable, scored)
    known = np.flatnonzero(np.isfinite(track.pose).all(axis=1))
    begins = np.searchsorted(track.time_s, scored.time_s)
    assert known[0] == 0
    np.testing.assert_array_equal(known[1:], begins + 1)
    assert not {9, 10} & set(known[1:])


def test_pieces_of_a_track_begin_at_known_poses_and_know_the_command_before(recordings):
    track = recordings[1].tracks[0]
    pose = track.pose.copy()
    pose[10] = np.nan  # where the second piece would begin
    parts = list(pieces(dataclasses.replace(track, pose=pose)))
    first = [int(np.flatnonzero(np.isfinite(part.pose).all(axis=1))[0]) for part in parts]
    assert first == [0] + [1] * (len(parts) - 1)
    begins = [int(np.searchsorted(track.time_s, part.time_s[at])) for part, at in zip(parts, first, strict=True)]
    assert begins == [0, 11, 21, 31]
    for part, at, begin in zip(parts, first, begins, strict=True):
        np.testing.assert_array_equal(part.command[: at + 1], track.command[begin - at : begin + 1])
        assert len(part) <= at + 11
    assert len({part.run for part in parts}) == len(parts)


def in_larger_arena(recording):
    """The same recording, whose header states walls further away."""
    arena = Arena(x=(-200.0, 1230.0), y=(-200.0, 1230.0))
    return Recording(recording.robot, recording.header.model_copy(update={"arena_mm": arena}), recording.tracks), arena


def test_the_recordings_own_arena_counts_not_the_robots_usual_one(recordings):
    (known, arena), (measured, _) = (in_larger_arena(recording) for recording in recordings)
    reference = Reference.learn(from_recording(known)[0], 1)
    assert reference.session.conditions.arena_mm == arena
    assert reference.comparable(measured).session.conditions.arena_mm == arena


def test_another_arena_is_refused_where_the_simulation_looks_at_poses_and_nowhere_else(recordings):
    known, measured = recordings[0], in_larger_arena(recordings[1])[0]
    by_command = Reference.learn(from_recording(known)[0], 1, ("command",))
    assert by_command.comparable(measured).set_aside == 0
    by_pose = Reference.learn(from_recording(known)[0], 1, ("command", "pose"))
    assert by_pose.comparable(recordings[1]).set_aside == 0
    with pytest.raises(
        UserError, match=r"another arena \(x -200 to 1230, y -200 to 1230 mm\).*measure in the same arena"
    ):
        by_pose.comparable(measured)


def test_the_report_draws_the_recordings_own_walls(tmp_path, monkeypatch):
    session = made_session(made_result("no_gap"))
    arena = Arena(x=(-300.0, 1500.0), y=(0.0, 900.0))
    walls = []
    draw = page.field_figure
    monkeypatch.setattr(page, "field_figure", lambda *given: walls.append(given[3]) or draw(*given))
    transitions = dataclasses.replace(session.transitions, arena_mm=arena)
    save_findings(tmp_path, dataclasses.replace(session, transitions=transitions))
    page.draw_diagnosis(tmp_path, tmp_path)
    assert set(map(str, walls)) == {str(arena)}


def gained(after, low, high):
    return Gain(before=2.0, after=after, low=low, high=high)


BETTER, NEITHER, WORSE = gained(1.5, 0.4, 0.6), gained(1.9, -0.1, 0.3), gained(2.4, -0.5, -0.3)
UNCHANGED = gained(2.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("position", "orientation", "ten_periods", "likelihood", "objection"),
    [
        (BETTER, NEITHER, NEITHER, WORSE, None),
        (BETTER, UNCHANGED, NEITHER, WORSE, None),
        (NEITHER, BETTER, NEITHER, WORSE, None),
        (
            NEITHER,
            NEITHER,
            BETTER,
            BETTER,
            "neither position nor orientation is measurably better (2.00 → 1.90 mm, 95 %: ",
        ),
        (
            BETTER,
            WORSE,
            NEITHER,
            BETTER,
            "the orientation is measurably worse (2.00 → 2.40 °, 95 %: 0.30 to 0.50 more)",
        ),
        (WORSE, BETTER, NEITHER, BETTER, "the position is measurably worse (2.00 → 2.40 mm"),
        (BETTER, BETTER, WORSE, BETTER, "the position after ten periods is measurably worse (2.00 → 2.40 mm"),
        (BETTER, BETTER, gained(2.05, -0.3, 0.2), BETTER, None),
        (BETTER, gained(2.01, -0.015, -0.005), gained(2.01, -0.3, 0.2), BETTER, None),
        (
            WORSE,
            WORSE,
            WORSE,
            BETTER,
            "neither position nor orientation is measurably better (2.00 → 2.40 mm, 95 %: 0.30 to 0.50 more",
        ),
        (UNCHANGED, UNCHANGED, UNCHANGED, BETTER, None),
        (UNCHANGED, UNCHANGED, UNCHANGED, NEITHER, "they are not measurably more likely with it"),
    ],
)
def test_held_out_runs_confirm_what_is_measurably_better_and_nowhere_worse_by_what_matters(
    position, orientation, ten_periods, likelihood, objection
):
    whole_runs = UNCHANGED if ten_periods is UNCHANGED else WORSE  # they decide nothing
    gain = Gains(position_mm=position, orientation_deg=orientation, open_loop_mm=whole_runs, ten_periods_mm=ten_periods)
    said = not_confirmed(gain, likelihood, immaterial=0.01)
    assert said == objection if objection is None else said.startswith(objection)


def test_lost_commands_of_another_vehicle_are_confirmed_by_likelihood():
    """What that vehicle has of its own moves the errors a little; the cause moves none."""
    gain = Gains(position_mm=NEITHER, orientation_deg=NEITHER, open_loop_mm=NEITHER, ten_periods_mm=NEITHER)
    assert not_confirmed(gain, BETTER, immaterial=0.01, moves=False) is None
    assert not_confirmed(gain, NEITHER, immaterial=0.01, moves=False) == "they are not measurably more likely with it"
    assert "neither position nor orientation" in not_confirmed(gain, BETTER, immaterial=0.01)


@pytest.mark.parametrize(
    ("ten_periods", "moves", "said"),
    [
        (BETTER, True, None),
        (NEITHER, True, "in open loop over ten periods it is not measurably better"),
        (NEITHER, False, None),
        (Gain(before=0, after=0, low=0, high=0), True, "no held-out run is long enough"),
        (None, True, None),
    ],
)
def test_what_is_not_measurably_better_in_open_loop_is_not_registered(ten_periods, moves, said):
    gain = Gains(position_mm=BETTER, orientation_deg=BETTER, open_loop_mm=BETTER, ten_periods_mm=ten_periods)
    found = not_shown_in_open_loop(gain, moves)
    assert found == said if said is None else found.startswith(said)


def test_what_the_clock_shows_is_named_whatever_an_extension_by_it_is_worth():
    kinds = mechanism_class("timing_jitter"), mechanism_class("command_delay")
    on_the_clock = SimpleNamespace(read_off_clock=lambda kind: {"spread": 0.1} if kind is kinds[0] else {})
    explained = SimpleNamespace(mechanisms=(kinds[0](spread=0.1), kinds[1](delay_s=0.15)), model=on_the_clock)
    jitter = DELAY.model_copy(update={"name": "timing_jitter"})
    assert causes_off_clock(explained, [DELAY, jitter]) == (jitter,)
    assert causes_off_clock(explained, [DELAY]) == ()


def test_more_random_motion_is_judged_beside_what_the_reference_s_own_motion_shows():
    """Measured like a session's, that is 0.9 of what its noise says; the motion 1.25 times that."""

    def log_likelihood(mechanisms, factor):
        return np.full(40, -((factor - 1.125) ** 2))

    held_out = SimpleNamespace(
        log_likelihood_with_motion_noise=log_likelihood, session=SimpleNamespace(run=np.repeat(np.arange(8), 5))
    )
    extended = SimpleNamespace(mechanisms=(), noise_factor=1.25)
    gain = likelihood_gain(held_out, extended, 100, np.random.default_rng(1), usual=0.9)
    assert (gain.before, gain.after) == pytest.approx(((0.9 - 1.125) ** 2, 0.0))


def test_runs_without_a_lost_command_do_not_deny_that_some_are_lost():
    """The held-out runs hold none, and would deny it alone; each of the others holds one."""

    def held(runs, nats):
        def evaluate(mechanisms):
            told = np.zeros(40 * len(runs))
            if mechanisms:
                share = mechanisms[0].probability
                told += np.log1p(-share)
                told[::40] = nats + np.log(share / 0.025)
            return SimpleNamespace(log_likelihood=told)

        return SimpleNamespace(evaluate=evaluate, session=SimpleNamespace(run=np.repeat(runs, 40)))

    fitted, unfitted = held(np.arange(30), 20.0), held(np.arange(30, 40), 0.0)
    loss, rng = command_loss.Config(probability=0.025), np.random.default_rng(1)
    alone = likelihood_gain(unfitted, SimpleNamespace(mechanisms=(loss,), noise_factor=1.0), 1000, rng)
    assert alone.high < 0
    together = gain_by_loss(fitted, unfitted, loss, 3, 1000, rng)
    assert together.low > 0
    assert together.before - together.after == pytest.approx((30 * 20.0 + 39 * 40 * np.log1p(-0.025)) / 1600)
    assert not gain_by_loss(held(np.arange(30), -2.0), unfitted, loss, 3, 1000, rng).low > 0
    numbered_anew = held(np.arange(10), 0.0)  # as runs are in each part of a session
    drawn = [gain_by_loss(fitted, one, loss, 3, 1000, np.random.default_rng(1)) for one in (unfitted, numbered_anew)]
    assert drawn[0] == drawn[1]


@pytest.mark.parametrize("runs", [2, 4, 12])
def test_few_runs_confirm_nothing_by_chance(runs):
    """Of two runs or of many, one gain in forty seems above zero where there is none."""
    rng = np.random.default_rng(20)
    run = np.repeat(np.arange(runs), 20)
    trials, above = 400, 0
    for _ in range(trials):
        differences = rng.normal(size=(runs, 2))[run] + rng.normal(size=(len(run), 2))
        before, after = (Errors(one, (), (), (), ()) for one in (10 + differences, np.full_like(differences, 10.0)))
        found = gains(before, after, run, 200, rng)
        above += (found.position_mm.low > 0) + (found.orientation_deg.low > 0)
    assert above <= stats.binom.ppf(0.99, 2 * trials, 0.025)


def test_one_run_confirms_nothing():
    before, after = (Errors(np.full((20, 2), size), (), (), (), ()) for size in (3.0, 1.0))
    found = gains(before, after, np.zeros(20, int), 50, np.random.default_rng(0)).position_mm
    assert (found.before, found.after, found.low, found.high) == (3.0, 1.0, -1.0, 3.0)
