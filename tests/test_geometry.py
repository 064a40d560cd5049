import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from swarmtwin.geometry import (
    compose,
    displacement_between,
    exp_map,
    integrate_twist,
    log_map,
    orientation_error_rad,
    position_error_mm,
    rotate,
    wrap_angle,
)

poses = arrays(float, (5, 3), elements=st.floats(-2000, 2000, allow_nan=False, width=32))


def close(first, second):
    """Poses are equal: positions to a micrometre, headings on the circle."""
    assert np.all(position_error_mm(first, second) < 1e-6 * (1 + np.abs(first[..., :2]).max()))
    assert np.all(orientation_error_rad(first, second) < 1e-9)


def test_forward_is_where_the_vehicle_looks():
    ahead = np.array([10.0, 3.0, 0.0])
    np.testing.assert_allclose(compose(np.array([0, 0, 0.0]), ahead), [10, 3, 0], atol=1e-12)
    np.testing.assert_allclose(compose(np.array([0, 0, np.pi / 2]), ahead)[:2], [-3, 10], atol=1e-12)
    np.testing.assert_allclose(compose(np.array([5, 5, np.pi]), ahead)[:2], [-5, 2], atol=1e-12)


@given(poses, poses)
def test_displacement_between_undoes_compose(start, end):
    close(compose(start, displacement_between(start, end)), end * [1, 1, 0] + wrap_angle(end) * [0, 0, 1])


@given(poses, poses, poses)
def test_composition_is_associative(first, second, third):
    close(compose(compose(first, second), third), compose(first, compose(second, third)))


@given(poses, poses, poses)
def test_a_displacement_does_not_depend_on_the_frame_of_the_arena(start, end, moved_frame):
    close(
        displacement_between(start, end), displacement_between(compose(moved_frame, start), compose(moved_frame, end))
    )


@pytest.mark.parametrize(
    ("angle", "wrapped"),
    [(np.pi, np.pi), (-np.pi, np.pi), (3 * np.pi, np.pi), (0.5, 0.5), (-7, -7 + 2 * np.pi), (0, 0)],
)
def test_wrap_angle_gives_the_half_open_circle(angle, wrapped):
    assert wrap_angle(np.array(float(angle))) == pytest.approx(wrapped)


def test_rotation_keeps_lengths_and_turns_counter_clockwise():
    np.testing.assert_allclose(rotate(np.array([2.0, 0.0]), np.array(np.pi / 2)), [0, 2], atol=1e-12)


def test_errors_are_distance_and_wrapped_angle():
    predicted, measured = np.array([[3.0, 4.0, 3.1]]), np.array([[0.0, 0.0, -3.1]])
    assert position_error_mm(predicted, measured)[0] == 5
    assert orientation_error_rad(predicted, measured)[0] == pytest.approx(2 * np.pi - 6.2)


twists = arrays(float, (5, 3), elements=st.floats(-1, 1, allow_nan=False, width=32)).map(lambda t: t * [100, 100, 6])


@given(twists)
def test_the_logarithm_undoes_the_exponential(twist):
    np.testing.assert_allclose(log_map(exp_map(twist)), twist, atol=1e-6)


@given(twists, st.integers(1, 7))
def test_a_twist_is_the_same_motion_over_and_over(twist, parts):
    """The motion of a twist is its parts', one after the other: a constant velocity in the body's frame."""
    reached = np.zeros_like(twist)
    for _ in range(parts):
        reached = compose(reached, exp_map(twist / parts))
    close(reached, exp_map(twist) * [1, 1, 0] + wrap_angle(exp_map(twist)) * [0, 0, 1])


def test_a_quarter_of_a_circle_is_driven_in_the_time_it_takes():
    ahead = np.array([50.0 * np.pi, 0.0, np.pi / 2])
    np.testing.assert_allclose(integrate_twist(ahead, 1.0), [100, 100, np.pi / 2])
    np.testing.assert_allclose(integrate_twist(ahead / 4, 4.0), [100, 100, np.pi / 2])
    still = exp_map(np.array([3.0, -4.0, 0.0]))
    np.testing.assert_allclose(still, [3, -4, 0])


def test_twists_of_tensors_and_arrays_agree():
    twist = np.random.default_rng(0).normal(size=(4, 7, 3))
    for function in (exp_map, log_map, lambda values: integrate_twist(values, 0.7)):
        np.testing.assert_allclose(function(torch.tensor(twist)).numpy(), function(twist), atol=1e-12)


def test_tensors_and_arrays_agree_and_tensors_carry_gradients():
    start, moved = np.random.default_rng(0).normal(size=(2, 7, 3))
    start_tensor = torch.tensor(start, requires_grad=True)
    result = compose(start_tensor, torch.tensor(moved))
    np.testing.assert_allclose(result.detach().numpy(), compose(start, moved), atol=1e-12)
    result.sum().backward()
    assert start_tensor.grad.abs().sum() > 0


@pytest.mark.parametrize("kind", [np.asarray, torch.as_tensor])
def test_an_arc_is_as_exact_when_it_hardly_turns(kind):
    """Ahead by sin(a)/a and to the left by (1 − cos a)/a, by their series where the turn is small, or 0."""
    turn = np.array([0.0, 1e-300, -1e-12, 1e-5, -1e-3])
    moved = np.asarray(exp_map(kind(np.stack([np.ones(5), np.zeros(5), turn], axis=-1))))
    np.testing.assert_allclose(moved[:, 0], 1 - turn**2 / 6, rtol=1e-12)
    np.testing.assert_allclose(moved[:, 1], turn / 2 - turn**3 / 24, rtol=1e-12)


def test_the_slope_of_an_arc_is_known_where_it_is_straight():
    twist = torch.tensor([[10.0, 2.0, 0.0]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(exp_map, (twist,))
    assert torch.autograd.gradcheck(log_map, (twist,))
