"""A lumpy closed surface seen from two sides: a pair of scans whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from utopic_cli.estimation.problem import Problem
from utopic_cli.geometry import rigid
from utopic_cli.geometry.voxel import voxel_downsample
from utopic_cli.point_cloud import PointCloud

VOXEL = 0.03


def lumpy_surface(count: int, shift: float) -> PointCloud:
    """Spread points over an asymmetric blob (no two views of it alike), with outward normals.

    Args:
        count: number of points.
        shift: in [0, 1), offsets the sampling so that two calls share no point.
    """
    number = np.arange(count) + shift
    z = 1.0 - 2.0 * (number + 0.5) / (count + 1)
    angle = number * np.pi * (3.0 - np.sqrt(5.0))
    flat = np.sqrt(1.0 - z**2)
    directions = np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1)

    def radius(d: np.ndarray) -> np.ndarray:
        x, y, z = d.T
        bumps = (
            0.16 * np.sin(3 * x + 1) * np.cos(4 * y)
            + 0.1 * np.sin(5 * z + 2 * x)
            + 0.06 * np.sin(9 * y - 4 * z)
        )
        return 0.5 * (1.0 + bumps + 0.25 * x + 0.05 * np.cos(11 * x + 7 * z))

    step = 1e-5
    points = directions * radius(directions)[:, None]
    reference = np.where(np.abs(directions[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
    first = np.cross(directions, reference)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(directions, first)
    tangents = []
    for side in (first, second):
        moved = directions + step * side
        moved /= np.linalg.norm(moved, axis=1, keepdims=True)
        tangents.append((moved * radius(moved)[:, None] - points) / step)
    normals = np.cross(*tangents)
    return PointCloud(points, normals / np.linalg.norm(normals, axis=1, keepdims=True))


def view(cloud: PointCloud, towards: tuple[float, float, float]) -> PointCloud:
    """Keep what faces a viewer in the given direction."""
    assert cloud.normals is not None
    seen = cloud.normals @ np.array(towards) > 0.15
    return PointCloud(cloud.points[seen], cloud.normals[seen])


def nodes_of(cloud: PointCloud) -> np.ndarray:
    """Thin to node spacing."""
    return voxel_downsample(cloud.points, 2.2 * VOXEL)[0]


def make_problem(source: PointCloud, target: PointCloud, gt: np.ndarray, wrong: float) -> Problem:
    """Pose a problem whose scores are right for a share of the source's nodes, wrong for the rest."""
    source_nodes, target_nodes = nodes_of(source), nodes_of(target)
    n, m = len(source_nodes), len(target_nodes)
    distance, partner = cKDTree(target_nodes).query(rigid.apply(gt, source_nodes))
    scores = np.zeros((n, m))
    rng = np.random.default_rng(5)
    right = np.flatnonzero(distance < 2.2 * VOXEL)
    right = right[rng.random(len(right)) >= wrong]
    scores[right, partner[right]] = 0.6
    others = np.setdiff1d(np.arange(n), right)
    scores[others, rng.integers(0, m, len(others))] = 0.6
    scores[np.arange(n), rng.integers(0, m, n)] += 0.2
    return Problem(
        source_nodes=source_nodes,
        target_nodes=target_nodes,
        matching_scores=scores,
        source_overlap=np.where(distance < 2.2 * VOXEL, 0.9, 0.2),
        target_overlap=np.full(m, 0.5),
        source_certainty=np.full(n, 0.7),
        target_certainty=np.full(m, 0.7),
        source_dense=source,
        target_dense=target,
        spacing=2.2 * VOXEL,
    )


@pytest.fixture(scope="session")
def gt_transformation() -> np.ndarray:
    return rigid.rigid(rigid.random_rotation(np.random.default_rng(11)), np.array([0.4, -0.7, 1.1]))


@pytest.fixture(scope="session")
def scans(gt_transformation: np.ndarray) -> tuple[PointCloud, PointCloud]:
    """Two views 70 degrees apart, independently sampled; the source in its own frame."""
    source = view(lumpy_surface(5000, 0.0), (1.0, 0.0, 0.0))
    target = view(lumpy_surface(5000, 0.43), (0.34, 0.94, 0.0))
    return source, target.transformed(gt_transformation)
