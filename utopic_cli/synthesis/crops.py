"""The two ways papers cut a full object down to a partial one."""

from __future__ import annotations

import numpy as np


def half_space_crop(points: np.ndarray, direction: np.ndarray, keep: float) -> np.ndarray:
    """Keep the part of a cloud that lies farthest along a direction (the paper's crop).

    Args:
        points: (N, 3).
        direction: (3,) normal of the cutting plane.
        keep: share of the points to keep, in (0, 1].

    Returns:
        (round(keep N),) int64 indices, in the points' order.
    """
    count = max(1, round(keep * len(points)))
    return np.sort(np.argsort(points @ direction, kind="stable")[len(points) - count :])


def nearest_crop(points: np.ndarray, point: np.ndarray, count: int) -> np.ndarray:
    """Keep the ``count`` points nearest to a point (PRNet's crop).

    Args:
        points: (N, 3).
        point: (3,) any point, often far outside.
        count: how many to keep, at most N.

    Returns:
        (count,) int64 indices, in the points' order.
    """
    distance = np.square(points - point).sum(axis=1)
    return np.sort(np.argsort(distance, kind="stable")[:count])
