"""How good a map is: what is left of its error when it is laid upon the true one."""

from __future__ import annotations

import numpy as np

from jaxfilt.types import Array


def laid_upon(points: Array, truth: Array, others: Array | None = None) -> np.ndarray:
    """Points (N, 2) m turned and shifted, not stretched, so that they come closest to others in the least squares.

    A map hangs on the pose that it was begun with: an error there turns and shifts all of it, and is no error of the
    map's own. It minimises ``sum_i |R a_i + t - b_i|^2``: with both sets about their means, R turns by
    ``atan2(sum_i cross(a_i, b_i), sum_i dot(a_i, b_i))``.

    Args:
        points: (N, 2) m, N >= 2.
        truth: (N, 2) m, in the same order.
        others: (K, 2) m, what is turned and shifted along with the points, such as the way that the robot went;
            default: the points.

    Returns:
        (K, 2) m, on the host.

    Raises:
        ValueError: shapes that are not (N, 2) and alike.

    Example: a quarter of a turn, and a metre.
        >>> import numpy as np
        >>> square = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0]])
        >>> turned = np.array([[1.0, 0.0], [1.0, 2.0], [0.0, 2.0]])
        >>> (laid_upon(turned, square).round(6) + 0.0).tolist()
        [[0.0, 0.0], [2.0, 0.0], [2.0, 1.0]]

    Source: B. K. P. Horn, Closed-form solution of absolute orientation using unit quaternions (1987), section 2, in the
    plane.
    """
    a, b = np.asarray(points, np.float64), np.asarray(truth, np.float64)
    if a.ndim != 2 or a.shape[1] != 2 or a.shape != b.shape or len(a) < 2:
        raise ValueError(f"points: expected two sets of shape (N, 2), N >= 2, got {a.shape} and {b.shape}")
    middle, onto = a.mean(0), b.mean(0)
    a, b = a - middle, b - onto
    angle = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    cos, sin = np.cos(angle), np.sin(angle)
    moved = a if others is None else np.asarray(others, np.float64) - middle
    return moved @ np.array([[cos, sin], [-sin, cos]]) + onto


def map_error(landmarks: Array, truth: Array) -> float:
    """Root mean square of the landmarks' distances (m) to the true ones, the map laid upon the true one.

    Args:
        landmarks: (N, 2) m, as estimated: those that were seen.
        truth: (N, 2) m, in the same order.

    Example: a map that is too large by a metre on either side.
        >>> import numpy as np
        >>> map_error(np.array([[0.0, 0.0], [6.0, 0.0]]), np.array([[1.0, 5.0], [5.0, 5.0]]))
        1.0
    """
    error = laid_upon(landmarks, truth) - np.asarray(truth, np.float64)
    return float(np.sqrt((error**2).sum(1).mean()))
