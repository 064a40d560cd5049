"""The judgement of the campaign in `faults.py`, which is one command: that it sees what must not be."""

from types import SimpleNamespace

import numpy as np
import pytest
from fault_judgement import Brought, Fault, Seen, judged, until_rest
from fault_table import Drive, as_line, read_drives, table

from tiny_policies import robot_named

ROBOT = robot_named("mgr")
BEGAN_S, AWAY_S, SETTLED_S, LOOKS_S = 10.0, 11.0, 14.0, 0.01
MOVING, REST = {"1": np.array([50.0, 50.0])}, {"1": np.zeros(2)}


def seen(until_s, zeros_s=None, runs_out_mm=0.0, beyond_mm=-100.0, command=MOVING):
    """One vehicle that is told to move until a moment; zeros are sent at another; later it moves on by so much."""
    moments = np.arange(9.0, SETTLED_S, LOOKS_S)
    x_mm = np.full(len(moments), ROBOT.arena_mm.x[1] + beyond_mm)
    x_mm[moments > until_s + 1.0] -= runs_out_mm
    position = np.stack([x_mm, np.full(len(moments), 500.0)], axis=-1)[:, None]
    heard = [(when_s, command) for when_s in np.arange(9.1, until_s, 0.5)]
    return Seen(moments, position, moments <= until_s, [*heard, (until_s if zeros_s is None else zeros_s, REST)])


def judgement(name, what, firmware="published", went_on=False, status=3):
    brought = Brought(name, BEGAN_S, AWAY_S, SETTLED_S, went_on)
    return judged(brought, what, SimpleNamespace(robot=ROBOT, firmware=firmware), status)


def test_what_is_answered_within_a_period_holds():
    fault = judgement("camera silent", seen(BEGAN_S + 0.3))
    assert (fault.came_of_it, fault.wrong) == ("answered", "")
    assert fault.answer_s == pytest.approx(0.3, abs=2 * LOOKS_S)


@pytest.mark.parametrize(
    ("what", "said"),
    [
        (seen(BEGAN_S + 0.8), "told to move for 0.8"),
        (seen(BEGAN_S + 0.3, runs_out_mm=20.0), "moved by 20 mm later than that"),
        (seen(BEGAN_S + 0.3, beyond_mm=60.0), "60 mm beyond the fence"),
        (seen(BEGAN_S + 0.3, command={"1": np.array([150.0, 0.0])}), "vehicle 1 was sent [150.0, 0.0]"),
    ],
)
def test_what_must_not_be_is_said(what, said):
    assert said in judgement("camera silent", what).wrong


def test_what_only_firmware_answers_has_two_periods_and_without_a_time_out_no_end():
    late = seen(BEGAN_S + 0.9)
    assert judgement("broker killed", late, "time-out").wrong == ""
    assert judgement("broker killed", seen(BEGAN_S + 1.2), "time-out").wrong != ""
    assert judgement("broker killed", seen(BEGAN_S + 3.0, beyond_mm=90.0), "published").wrong == ""


def test_what_may_be_survived_is_judged_from_the_first_zeros_on():
    assert judgement("pictures late", seen(SETTLED_S), went_on=True).came_of_it == "survived"
    assert judgement("pictures late", seen(BEGAN_S + 2.0)).wrong == ""
    late = seen(BEGAN_S + 2.0, zeros_s=BEGAN_S + 1.8)
    assert judgement("pictures late", late).wrong == ""
    assert "told to move" in judgement("pictures late", seen(BEGAN_S + 2.9)._replace(heard=late.heard)).wrong
    assert judgement("camera silent", seen(SETTLED_S), went_on=True).wrong == "not answered"


def test_a_command_that_a_frozen_broker_had_kept_is_not_taken_for_driving_on():
    moments = np.arange(0.0, 2.0, LOOKS_S)
    moves = (moments < 0.5) | ((moments > 1.0) & (moments < 1.03))
    assert until_rest(moments, moves, 0.2) == pytest.approx(0.5, abs=2 * LOOKS_S)
    assert until_rest(moments, moments < 1.0, 0.2) == pytest.approx(1.0, abs=2 * LOOKS_S)


def test_the_state_is_read_again_and_the_table_counts(tmp_path):
    faults = [Fault("pictures late", "survived", None, -50.0, ""), Fault("red button", "answered", 0.1, -40.0, "late")]
    drive = Drive(0, "published", faults, -40.0, 130.0, 3, "stopped", 20.0, [])
    state = tmp_path / "state.jsonl"
    state.write_text(as_line(drive) + as_line(drive)[:50])
    assert read_drives(state) == [drive]
    rows = table([drive, drive._replace(number=1, wrong=["no recording"])]).splitlines()
    assert "| pictures late | 2 | 2 | 0 | – | – | 0 |" in rows
    assert "| red button | 2 | 0 | 2 | 0.10 s | 0.10 s | 2 |" in rows
    assert "4 faults in 2 drives, 1 minutes; 2 drives failed" in rows
    state.write_text('{"number": 1, "survived": []}\n')
    with pytest.raises(SystemExit, match="another version"):
        read_drives(state)
