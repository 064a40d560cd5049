"""Where a square of known size lies that was seen with small errors."""

import numpy as np


def fitted_poses(corners_mm: np.ndarray, square_mm: np.ndarray) -> np.ndarray:
    """Return the poses that bring a square's corners nearest to seen ones (least squares; Umeyama, 1991).

    Args:
        corners_mm: (S, 4, 2) seen, in the arena's frame.
        square_mm: (4, 2) in the square's own frame, whose origin is in the middle.

    Returns:
        (S, 3) x_mm, y_mm, heading_rad in (−π, π].
    """
    centre = corners_mm.mean(axis=1)
    spread = corners_mm - centre[:, None]
    along = np.einsum("snk,nk->s", spread, square_mm)
    across = np.einsum("sn,n->s", spread[..., 1], square_mm[:, 0]) - np.einsum(
        "sn,n->s", spread[..., 0], square_mm[:, 1]
    )
    return np.column_stack([centre, np.arctan2(across, along)])


def fitted_square(corners_mm: np.ndarray, square_mm: np.ndarray) -> np.ndarray:
    """Return the corners (S, 4, 2) of the square where it fits best: see `fitted_poses`."""
    pose = fitted_poses(corners_mm, square_mm)
    cos, sin = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    turn = np.stack([np.stack([cos, -sin], axis=-1), np.stack([sin, cos], axis=-1)], axis=-2)
    return pose[:, None, :2] + np.einsum("sij,nj->sni", turn, square_mm)
