"""How well two scans fit under a transformation: overlap, normals, and free space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from utopic_cli.estimation.surface import Surface, thinned
from utopic_cli.geometry import rigid
from utopic_cli.geometry.nearest import nearest
from utopic_cli.point_cloud import PointCloud
from utopic_cli.result import FitMeasures

REACH = 2.0  # voxels to the nearest point: in a sparse cloud it is rarely nearer than one
CLOSE = 0.3  # voxels beside that point's tangent plane: what tells surfaces apart, however sparse
AGREEING = 0.7  # cosine of the angle between normals
FREE_SPACE_MARGIN = 1.5  # voxels


@dataclass(frozen=True)
class Verdict:
    """What speaks for and against H transformations.

    Attributes:
        fit: (H,) share of points that lie on the other scan's surface (in the tangent plane of
            a near neighbour whose normal agrees), mean of both ways.
        violation: (H,) share of points that stand where the other scan saw empty space, mean
            of both ways.
        score: (H,) ``fit - violation``.
    """

    fit: np.ndarray
    violation: np.ndarray
    score: np.ndarray


def verify(
    source: Surface,
    target: Surface,
    transformations: np.ndarray,
    *,
    samples: int = 1000,
) -> Verdict:
    """Score H transformations by fit, both ways, minus free-space violation.

    Two samples of one surface share no points, so what is asked of a point is to lie in the
    tangent plane of its nearest neighbour, not on the neighbour itself. A wrong transformation
    can lay two surfaces on each other over a good part; it then nearly always puts some of one
    scan in front of what the other scan saw, which a right one never does.

    Args:
        source: the scan that moves.
        target: the scan that stays.
        transformations: (H, 4, 4) T_target_source.
        samples: points of each scan looked at.
    """
    inverse_rotations = transformations[:, :3, :3].transpose(0, 2, 1)
    inverse = np.zeros_like(transformations)
    inverse[:, :3, :3] = inverse_rotations
    inverse[:, :3, 3] = -np.einsum("hij,hj->hi", inverse_rotations, transformations[:, :3, 3])
    inverse[:, 3, 3] = 1.0
    forward_fit, forward_violation = _one_way(source, target, transformations, samples)
    backward_fit, backward_violation = _one_way(target, source, inverse, samples)
    fit = (forward_fit + backward_fit) / 2.0
    violation = (forward_violation + backward_violation) / 2.0
    return Verdict(fit, violation, fit - violation)


def _one_way(
    moving: Surface, fixed: Surface, transformations: np.ndarray, samples: int
) -> tuple[np.ndarray, np.ndarray]:
    """Fit and violation (H,) of the moving scan's points against the fixed scan."""
    chosen = moving.sample[:: max(1, len(moving.sample) // samples)]
    rotations = transformations[:, :3, :3].transpose(0, 2, 1)
    moved = moving.points[chosen] @ rotations + transformations[:, None, :3, 3]  # (H, S, 3)
    turned = moving.normals[chosen] @ rotations
    distance, index = nearest(fixed.tree, moved, within=REACH * fixed.voxel)
    found = np.isfinite(distance)
    index = np.where(found, index, 0)
    plane = fixed.normals[index]
    beside = np.abs(np.einsum("hsd,hsd->hs", fixed.points[index] - moved, plane))
    agreement = np.einsum("hsd,hsd->hs", turned, plane)
    fit = (found & (beside < CLOSE * fixed.voxel) & (agreement > AGREEING)).mean(axis=1)
    violation = fixed.sight.in_front(moved, FREE_SPACE_MARGIN * fixed.voxel).mean(axis=1)
    return fit, violation


def measure_fit(
    source: PointCloud,
    target: PointCloud,
    T: np.ndarray,
    threshold: float,
    inlier_ratio: float,
    *,
    limit: int = 200_000,
    trees: tuple[cKDTree, cKDTree] | None = None,
) -> FitMeasures:
    """Measure the fit at full resolution.

    Args:
        source: (N, 3) the scan that moves.
        target: (M, 3) the scan that stays.
        T: (4, 4) T_target_source.
        threshold: largest distance at which a point has a counterpart (points' units);
            a few times the larger spacing of the two scans.
        inlier_ratio: share of the correspondences that T explains, as the solver found it
            (``Estimate.support``); passed on.
        limit: most points of each scan that are looked up; larger scans are thinned evenly.
        trees: of source and target, if there are any already.

    Returns:
        Measures in the points' units. ``residual_percentiles`` are over the source's points
        with a counterpart; where none has one, they and ``inlier_rmse`` are NaN.

    Raises:
        ValueError: an empty cloud, or a threshold that is not positive.
    """
    if not (len(source) and len(target)):
        raise ValueError("an empty cloud has no fit")
    if not threshold > 0:
        raise ValueError(f"threshold {threshold} is not positive")
    source_tree, target_tree = trees or (cKDTree(source.points), cKDTree(target.points))
    # Thinned before it is moved: which points are left depends on their number alone.
    some_source, some_target = thinned(source.points, limit), thinned(target.points, limit)
    forward, _ = nearest(target_tree, rigid.apply(T, some_source), within=threshold)
    backward, _ = nearest(source_tree, rigid.apply(rigid.invert(T), some_target), within=threshold)
    found = forward[np.isfinite(forward)]
    source_ratio, target_ratio = float(np.isfinite(forward).mean()), float(np.isfinite(backward).mean())
    names = ("p50", "p75", "p90", "p95")
    values = np.percentile(found, [50, 75, 90, 95]) if len(found) else np.full(4, np.nan)
    return FitMeasures(
        overlap_ratio={"source": source_ratio, "target": target_ratio},
        inlier_ratio=inlier_ratio,
        inlier_rmse=float(np.sqrt(np.mean(found**2))) if len(found) else float("nan"),
        residual_percentiles={name: float(value) for name, value in zip(names, values, strict=True)},
        threshold=float(threshold),
    )
