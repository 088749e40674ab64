"""Voxel grid: thin a cloud to one point a cell."""

from __future__ import annotations

import numpy as np

FEW = 8
"""Grids of no more cells a point than this are numbered cell by cell, which is faster than sorting."""


def voxel_index(points: np.ndarray, size: float) -> tuple[np.ndarray, int]:
    """Number the occupied cells of a grid and say which cell each point lies in.

    Args:
        points: (N, 3).
        size: edge length of a cell, same units.

    Returns:
        owner: (N,) int64 cell number of each point, cells numbered from 0 in grid order.
        count: number of occupied cells.
    """
    cell = np.floor((points - points.min(axis=0)) / size).astype(np.int64)
    extent = cell.max(axis=0) + 1
    key = (cell[:, 0] * extent[1] + cell[:, 1]) * extent[2] + cell[:, 2]
    cells = int(extent.prod(dtype=np.float64))
    if cells > FEW * len(points):
        occupied, owner = np.unique(key, return_inverse=True)
        return owner, len(occupied)
    filled = np.zeros(cells, dtype=bool)
    filled[key] = True
    number = np.cumsum(filled) - 1
    return number[key], int(number[-1]) + 1


def cell_means(values: np.ndarray, owner: np.ndarray, count: int) -> np.ndarray:
    """Average (N, C) values over the points of each of ``count`` cells -> (count, C)."""
    weight = np.bincount(owner, minlength=count)
    sums = np.stack([np.bincount(owner, column, minlength=count) for column in values.T], axis=1)
    return sums / weight[:, None]


def voxel_downsample(points: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Replace the points of each grid cell by their mean.

    Args:
        points: (N, 3) float64.
        size: edge length of a cell, same units.

    Returns:
        means: (K, 3) float64.
        owner: (N,) int64, the row of ``means`` each point went into.
    """
    owner, count = voxel_index(points, size)
    return cell_means(points, owner, count), owner
