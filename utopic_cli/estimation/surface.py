"""One scan as something to register against: nearest points, normals, and what it saw past."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter
from scipy.spatial import cKDTree

from utopic_cli.geometry.nearest import nearest
from utopic_cli.point_cloud import PointCloud

MOST_PIXELS = 2000
"""Most pixels of a depth map along a side."""


class DepthMap:
    """What a scan saw, as an orthographic image: the nearest surface along each line of sight.

    A scanner that saw a surface also saw that nothing stood before it. The line of sight is
    not in the file; the mean oriented normal points back at the scanner well enough, since a
    scanner sees only surfaces that face it.
    """

    def __init__(self, points: np.ndarray, normals: np.ndarray, pitch: float) -> None:
        """Render (N, 3) points with (N, 3) oriented normals at ``pitch`` units a pixel."""
        mean = normals.mean(axis=0)
        length = np.linalg.norm(mean)
        towards = mean / length if length > 0 else np.array([0.0, 0.0, 1.0])
        helper = np.eye(3)[np.abs(towards).argmin()]
        across = np.cross(towards, helper)
        across /= np.linalg.norm(across)
        self.axes = np.stack([across, np.cross(towards, across), towards])  # rows: x, y, towards the scanner
        seen = points @ self.axes.T
        # However few points are spread however far, the image stays small.
        self.pitch = pitch = max(pitch, float(np.ptp(seen[:, :2], axis=0).max()) / MOST_PIXELS)
        self.corner = seen[:, :2].min(axis=0) - 2.0 * pitch
        column, row = np.floor((seen[:, :2] - self.corner) / pitch).astype(np.int64).T
        front = np.full((column.max() + 3, row.max() + 3), -np.inf)
        np.maximum.at(front, (column, row), seen[:, 2])
        # The nearest surface around each pixel: closes gaps between samples and spares steep walls.
        widened = maximum_filter(front, size=3, mode="constant", cval=-np.inf)
        self.front = np.where(np.isneginf(widened), np.inf, widened)  # nothing seen: nothing known

    def in_front(self, points: np.ndarray, margin: float) -> np.ndarray:
        """Tell which (..., 3) points the scanner would have seen before its surface -> (...) bool."""
        seen = points @ self.axes.T
        pixel = np.floor((seen[..., :2] - self.corner) / self.pitch).astype(np.int64)
        inside = ((pixel >= 0) & (pixel < self.front.shape)).all(axis=-1)
        pixel = np.where(inside[..., None], pixel, 0)  # the corner pixel is always empty
        return seen[..., 2] > self.front[pixel[..., 0], pixel[..., 1]] + margin


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


@dataclass(frozen=True)
class Surface:
    """A dense scan made ready for registration.

    Attributes:
        points: (N, 3) float64.
        normals: (N, 3) oriented unit normals.
        voxel: v, the sampling distance that tolerances are multiples of.
        sample: indices of about ``SAMPLE`` points spread evenly over the scan.
        tree: nearest-neighbour search over ``points``.
        depth_map: what the scan saw past.
    """

    points: np.ndarray
    normals: np.ndarray
    voxel: float
    sample: np.ndarray
    tree: cKDTree
    depth_map: DepthMap


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
        depth_map=DepthMap(cloud.points, cloud.normals, 1.5 * voxel),
    )
