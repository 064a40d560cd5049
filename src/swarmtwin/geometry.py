"""The algebra of planar poses and twists (SE(2)), batched over any leading dimensions, for numpy and torch alike.

A pose is `x, y, heading` (mm, mm, rad) in the arena's frame. A displacement is `forward, left, turn` (mm, mm, rad) in
the vehicle's frame at the start of the motion (REP 103: x forward, y left, counter-clockwise positive). A twist is the
constant velocity, in the frame that moves along, that leads there.
"""

from typing import Any, TypeVar

from array_api_compat import array_namespace

Array = TypeVar("Array", bound=Any)


def wrap_angle(angle_rad: Array) -> Array:
    """Wrap angles of any shape to (−π, π]."""
    xp = array_namespace(angle_rad)
    return -((-angle_rad + xp.pi) % (2 * xp.pi) - xp.pi)


def rotate(vector: Array, angle_rad: Array) -> Array:
    """Turn vectors (..., 2) counter-clockwise by angles (...)."""
    xp = array_namespace(vector, angle_rad)
    cos, sin = xp.cos(angle_rad), xp.sin(angle_rad)
    x, y = vector[..., 0], vector[..., 1]
    return xp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def compose(pose: Array, displacement: Array) -> Array:
    """Return the poses (..., 3) reached from `pose` (..., 3) by `displacement` (..., 3) in its frame."""
    xp = array_namespace(pose, displacement)
    position = pose[..., :2] + rotate(displacement[..., :2], pose[..., 2])
    heading = wrap_angle(pose[..., 2] + displacement[..., 2])
    return xp.concat([position, heading[..., None]], axis=-1)


def displacement_between(start: Array, end: Array) -> Array:
    """Return the displacements (..., 3) that lead from poses `start` to poses `end`: the inverse of `compose`."""
    xp = array_namespace(start, end)
    moved = rotate(end[..., :2] - start[..., :2], -start[..., 2])
    turn = wrap_angle(end[..., 2] - start[..., 2])
    return xp.concat([moved, turn[..., None]], axis=-1)


def position_error_mm(predicted: Array, measured: Array) -> Array:
    """Return the Euclidean distance (...) in mm between displacements or poses (..., 3)."""
    xp = array_namespace(predicted, measured)
    return xp.sqrt(xp.sum((predicted[..., :2] - measured[..., :2]) ** 2, axis=-1))


def orientation_error_rad(predicted: Array, measured: Array) -> Array:
    """Return the absolute wrapped angle (...) in rad between displacements or poses (..., 3)."""
    xp = array_namespace(predicted, measured)
    return xp.abs(wrap_angle(predicted[..., 2] - measured[..., 2]))


def residual_between(predicted: Array, measured: Array) -> Array:
    """Return measured minus predicted displacements or poses (..., 3), turns wrapped."""
    xp = array_namespace(predicted, measured)
    turn = wrap_angle(measured[..., 2] - predicted[..., 2])
    return xp.concat([measured[..., :2] - predicted[..., :2], turn[..., None]], axis=-1)


def integrate_twist(twist: Array, duration_s: float) -> Array:
    """Return the displacements (..., 3) after `duration_s` at constant body velocities: arcs of circles.

    Args:
        twist: (..., 3) forward_mm_s, left_mm_s, turn_rad_s in the moving vehicle's own frame.
        duration_s: how long they last.
    """
    xp = array_namespace(twist)
    turn_rad = twist[..., 2] * duration_s
    along, across = _arc(turn_rad)
    forward_mm = (along * twist[..., 0] - across * twist[..., 1]) * duration_s
    left_mm = (across * twist[..., 0] + along * twist[..., 1]) * duration_s
    return xp.stack([forward_mm, left_mm, turn_rad], axis=-1)


def exp_map(twist: Array) -> Array:
    """Return the displacements (..., 3) of twists (..., 3) mm, mm, rad per period: the exponential map of SE(2).

    See Lynch and Park, Modern Robotics, section 3.3.
    """
    return integrate_twist(twist, 1.0)


def log_map(displacement: Array) -> Array:
    """Return the twists (..., 3) mm, mm, rad per period that lead to displacements (..., 3): the logarithm of SE(2).

    The turn must be less than a full one.
    """
    xp = array_namespace(displacement)
    along, across = _arc(displacement[..., 2])
    size = along**2 + across**2
    forward_mm = (along * displacement[..., 0] + across * displacement[..., 1]) / size
    left_mm = (along * displacement[..., 1] - across * displacement[..., 0]) / size
    return xp.stack([forward_mm, left_mm, displacement[..., 2]], axis=-1)


def _arc(turn_rad: Array) -> tuple[Array, Array]:
    """Return how far an arc of length 1 that turns by `turn_rad` leads ahead and to the left."""
    xp = array_namespace(turn_rad)
    half_rad = turn_rad / 2
    is_straight = half_rad == 0
    sine = xp.sin(half_rad)
    chord = xp.where(is_straight, 1.0, sine / (half_rad + is_straight))
    return chord * xp.cos(half_rad), chord * sine
