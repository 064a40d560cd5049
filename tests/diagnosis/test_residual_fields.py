"""Residual fields: what is planted is seen where it is, and errors are those of whole runs."""

from dataclasses import replace

import numpy as np
import pytest
from diagnosis_factories import made_result, made_session, moved_late, parts_of, simulated

from swarmtwin.diagnosis.report.residual_fields import Axis, binned, blocks_of, components, field_choices


def test_constant_commands_have_no_field(tmp_path):
    session = made_session(made_result("no_gap"))
    still = replace(session.transitions, command=session.transitions.command * 0)
    choices = field_choices(still, parts_of(session))
    assert {"command", "duration", "vehicle", "neighbours"}.isdisjoint(choices)
    assert {"place", "heading", "time"} <= set(choices)


def test_a_place_where_vehicles_go_less_far_is_seen_there_and_nowhere_else():
    centre, radius_mm = np.array([300.0, 500.0]), 120.0

    def slow_there(moment):
        inside = np.linalg.norm(moment.pose[:2] - centre) < radius_mm
        return simulated(moment.command) * (0.5 if inside else 1.0)

    session = made_session(made_result(), slow_there, runs=150)
    parts = parts_of(session)
    choice = field_choices(session.transitions, parts)["place"]
    assert choice.component in ("way", "turning")
    field = binned(choice.axes, parts[choice.component], blocks_of(session.transitions))
    x, y = np.meshgrid(*[(axis.edges[1:] + axis.edges[:-1]) / 2 for axis in choice.axes], indexing="ij")
    half_bin_mm = np.hypot(*[np.ptp(axis.edges[:2]) / 2 for axis in choice.axes])
    distance_mm = np.hypot(x - centre[0], y - centre[1])
    inside = field.mean[(distance_mm < radius_mm - half_bin_mm) & np.isfinite(field.mean)]
    outside = field.mean[(distance_mm > radius_mm + half_bin_mm) & np.isfinite(field.mean)]
    assert len(inside) >= 1
    assert len(outside) >= 10
    assert inside.max() < -2
    assert np.abs(outside).max() < 1


def test_a_delay_is_seen_over_the_change_of_the_command_and_gone_after_the_extension():
    session = made_session(made_result(), moved_late)
    parts = parts_of(session)
    choice = field_choices(session.transitions, parts)["previous_command"]
    assert choice.component in ("forward", "turn")
    block = blocks_of(session.transitions)
    after = components(session.transitions, simulated(session.transitions.command), session.residual_after)
    before = binned(choice.axes, parts[choice.component], block)
    left_over = binned(choice.axes, after[choice.component], block)
    assert np.nanmax(np.abs(before.mean)) > 5
    assert before.strength > 10
    assert np.nanmax(np.abs(left_over.mean)) < 1
    assert abs(left_over.strength) < 0.05


def test_a_drift_points_where_it_carries():
    def drifting(moment):
        heading_rad = moment.pose[2]
        return simulated(moment.command) + 2.0 * np.array([np.cos(heading_rad), -np.sin(heading_rad), 0.0])

    session = made_session(made_result(), drifting)
    parts = parts_of(session)
    assert field_choices(session.transitions, parts)["place"].component == "x"
    assert parts["x"].mean() == pytest.approx(2.0, abs=0.15)
    assert parts["y"].mean() == pytest.approx(0.0, abs=0.15)


def test_means_and_their_errors_are_those_of_blocks():
    random = np.random.default_rng(1)
    runs, steps = 400, 25
    own = random.normal(0, 1, runs)
    block = np.repeat(np.arange(runs), steps)
    values = 0.3 + own[block] + random.normal(0, 1, runs * steps)
    place = np.tile(np.linspace(0, 1, steps), runs)
    axis = Axis("place", place, np.array([0.0, 0.5, 1.0]))
    field = binned([axis], values, block)
    first = place < 0.5
    assert field.mean[0] == pytest.approx(values[first].mean())
    np.testing.assert_array_equal(field.transitions, [first.sum(), (~first).sum()])
    means = values.reshape(runs, steps)[:, : steps // 2].mean(axis=1)
    assert field.standard_error[0] == pytest.approx(means.std(ddof=1) / np.sqrt(runs))
    assert field.standard_error[0] > 2 * values[first].std() / np.sqrt(first.sum())


def test_bins_with_too_little_say_nothing():
    place = np.repeat([0.5, 1.5, 2.5, 3.5], [7, 40, 40, 40])
    block = np.concatenate([np.arange(7), np.zeros(40), np.arange(40), np.arange(40)])
    values = np.concatenate([np.ones(87), np.full(40, np.nan)])
    field = binned([Axis("place", place, np.arange(5.0))], values, block)
    np.testing.assert_array_equal(np.isfinite(field.mean), [False, False, True, False])
    np.testing.assert_array_equal(field.transitions, [7, 40, 40, 0])
