"""One scan as something to register against: nearest points, normals, and what it saw past."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from utopic_cli.estimation.depth_map import DepthMap
from utopic_cli.estimation.panorama import Panorama, find_standpoint
from utopic_cli.geometry.nearest import nearest
from utopic_cli.point_cloud import PointCloud


def thinned(points: np.ndarray, limit: int) -> np.ndarray:
    """Return about ``limit`` (never more) of (N, 3) points, spread evenly over the file.

    Points are picked by the fractional parts of i^2 times an irrational, which unlike every
    n-th point cannot fall in step with the rows of a range image.
    """
    count = len(points)
    if count <= limit:
        return points
    number = np.arange(count, dtype=np.float64)
    key = np.mod(np.mod(number * np.sqrt(2.0), 1.0) * number, 1.0)
    return points[np.sort(np.argpartition(key, limit - 1)[:limit])]


def point_spacing(points: np.ndarray, tree: cKDTree | None = None) -> float:
    """Median distance of a point to its nearest neighbour elsewhere, in the points' units.

    Args:
        points: (N, 3), at least two.
        tree: index of the points, if there is one already.

    Returns:
        The spacing; 0 only if all points coincide.
    """
    some = thinned(points, 5_000)
    distance, _ = nearest(cKDTree(points) if tree is None else tree, some, 2)
    spacing = float(np.median(distance[:, 1]))
    if spacing == 0.0:  # most points are there twice, as in merged files: the places count
        places = np.unique(points, axis=0)
        if 1 < len(places) < len(points):
            return point_spacing(places)
    return spacing


PITCH = 1.5
"""Voxels to a pixel, or a cell, of what a scan saw past."""

ONE_SIDED = 0.9
"""Share of points that face one direction from which on a scan counts as taken from there."""


@dataclass(frozen=True)
class Surface:
    """A dense scan made ready for registration.

    Attributes:
        points: (N, 3) float64.
        normals: (N, 3) oriented unit normals.
        voxel: v, the sampling distance that tolerances are multiples of.
        sample: indices of about ``SAMPLE`` points spread evenly over the scan.
        tree: nearest-neighbour search over ``points``.
    """

    points: np.ndarray
    normals: np.ndarray
    voxel: float
    sample: np.ndarray
    tree: cKDTree

    @cached_property
    def sight(self) -> DepthMap | Panorama:
        """What the scan saw past: as seen from one side, or else from a place within it, if there is one."""
        from_a_side = DepthMap(self.points, self.normals, PITCH * self.voxel)
        if from_a_side.facing >= ONE_SIDED:
            return from_a_side
        standpoint = find_standpoint(self.points, self.normals)
        return from_a_side if standpoint is None else Panorama(self.points, standpoint, PITCH * self.voxel)


SAMPLE = 1000


def make_surface(cloud: PointCloud, voxel: float) -> Surface:
    """Index a dense cloud with oriented normals.

    Args:
        cloud: (N, 3) points with normals, about one a voxel.
        voxel: v in the points' units.

    Raises:
        ValueError: fewer than three points, or no normals.
    """
    if len(cloud) < 3:
        raise ValueError("a surface needs at least three points")
    if cloud.normals is None:
        raise ValueError("a surface needs oriented normals")
    # Every n-th point in grid order is spread evenly and needs no random draw.
    order = np.lexsort(np.floor(cloud.points / (4.0 * voxel)).T)
    sample = order[np.linspace(0, len(order) - 1, min(SAMPLE, len(order))).astype(np.int64)]
    return Surface(
        points=cloud.points,
        normals=cloud.normals,
        voxel=voxel,
        sample=sample,
        tree=cKDTree(cloud.points),
    )
