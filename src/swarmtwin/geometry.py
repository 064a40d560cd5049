"""The algebra of planar poses (SE(2)), batched over any leading dimensions, for numpy arrays and torch tensors alike.

A pose is `x, y, heading` (mm, mm, rad) in the arena's frame. A displacement is `forward, left, turn` (mm, mm, rad) in
the vehicle's frame at the start of the motion (REP 103: x forward, y left, counter-clockwise positive).
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
