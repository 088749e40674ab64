"""Points that belong to no surface: scattered in the air by reflections, dust or mixed pixels."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from utopic_cli.geometry.nearest import nearest

NEIGHBOURS = 12
FAR = 3.0
"""Scattered points are at least this many times farther from their neighbours than the median point ..."""

THICK = 0.05
"""... and their neighbourhood is no surface: its smallest principal variance is at least this share of
all, or the point stands off it. That spares what is merely far from the scanner: sparse, but flat."""

OFF = 0.7
"""A point stands off its neighbours' plane by at least this share of their root mean square spread."""


ASTRAY = 10.0
"""Points beyond so many times the radius that holds most of a scan are no part of it."""


def astray(points: np.ndarray) -> np.ndarray:
    """Tell which points lie so far off that they would decide the scan's size, like a return at (0, 0, 0).

    Args:
        points: (N, 3) in any unit, not empty.

    Returns:
        (N,) bool.
    """
    radius = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    return radius > ASTRAY * np.quantile(radius, 0.95)


def scattered(points: np.ndarray, tree: cKDTree | None = None) -> np.ndarray:
    """Tell which points lie on no surface.

    Args:
        points: (N, 3) in any unit.
        tree: of the points, if there is one already.

    Returns:
        (N,) bool; nothing is told of fewer than a few dozen points.
    """
    if len(points) < 3 * NEIGHBOURS:
        return np.zeros(len(points), dtype=bool)
    tree = cKDTree(points) if tree is None else tree
    distance, index = nearest(tree, points, NEIGHBOURS + 1)
    mean = distance[:, 1:].mean(axis=1)
    if not np.median(mean) > 0:  # most places are there many times: distances say nothing
        return np.zeros(len(points), dtype=bool)
    far = np.flatnonzero(mean >= FAR * np.median(mean))
    around = points[index[far, 1:]]  # (F, k, 3)
    centre = around.mean(axis=1)
    offset = around - centre[:, None]
    variance, axes = np.linalg.eigh(np.einsum("fki,fkj->fij", offset, offset) / NEIGHBOURS)
    height = np.abs(np.einsum("fi,fi->f", points[far] - centre, axes[:, :, 0]))
    spread = variance.sum(axis=1)
    alone = np.zeros(len(points), dtype=bool)
    alone[far] = (variance[:, 0] >= THICK * spread) | (height >= OFF * np.sqrt(spread))
    return alone
