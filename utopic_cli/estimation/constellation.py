"""Constellations: what the points around a point look like, as points.

On clouds that share their points (see ``partners``) the chance that placed the neighbours of a point is the
same in both, and tells it from all others: on a plain wall, on a rod, and where a turn lays the surface on
itself. On clouds sampled each on its own this says nothing.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

SCALES = (1.0, 1.5, 2.0, 3.0, 4.0)
"""How far around a point is looked, in gaps."""

AROUND = 60
"""Nearest neighbours that are looked at; within the largest scale there are hardly more."""


def constellations(points: np.ndarray, gap: float) -> np.ndarray:
    """Describe the neighbours of each point, the same in any pose.

    Args:
        points: (N, 3), at least two.
        gap: typical distance of a point to the nearest other.

    Returns:
        (N, 5 * ``SCALES``): with weights that fall off as a Gaussian, how many there are, how far off their
        mean is, and how widely they spread along the three axes of their second moments.
    """
    near = range(2, min(AROUND, len(points) - 1) + 2)
    distance, index = cKDTree(points).query(points, k=near)
    offset = points[index] - points[:, None]
    found = []
    for scale in SCALES:
        reach = scale * gap
        weight = np.exp(-0.5 * (distance / reach) ** 2)
        count = weight.sum(axis=1)
        weight /= np.maximum(count, 1e-9)[:, None]
        mean = np.einsum("nk,nkd->nd", weight, offset)
        moments = np.einsum("nk,nkd,nke->nde", weight, offset, offset)
        spread = np.sqrt(np.maximum(np.linalg.eigvalsh(moments), 0.0))
        found += [np.log(count + 0.05), np.linalg.norm(mean, axis=1) / reach, *(spread.T / reach)]
    return np.stack(found, axis=1)


def alike(source: np.ndarray, target: np.ndarray, gap: float) -> np.ndarray:
    """Score how much the points of two clouds look alike by their constellations.

    Args:
        source: (N, 3).
        target: (M, 3).
        gap: as of ``constellations``, of both.

    Returns:
        (N, M) in (0, 1]: the share of a row's likeness times that of the column's.
    """
    ours, theirs = constellations(source, gap), constellations(target, gap)
    deviation = np.concatenate([ours, theirs]).std(axis=0) + 1e-6
    likeness = np.exp(-cdist(ours / deviation, theirs / deviation))
    shares: np.ndarray = likeness**2 / (
        likeness.sum(axis=1, keepdims=True) * likeness.sum(axis=0, keepdims=True)
    )
    return shares
