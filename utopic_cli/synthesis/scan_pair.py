"""Two clouds with a known answer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from utopic_cli.geometry import rigid
from utopic_cli.point_cloud import PointCloud
from utopic_cli.synthesis.surface import DegenerateShape

OVERLAP_RADIUS = 0.01  # in extents of the object; wider where the clouds are sparser than that
MEASURED_POINTS, COMPARED_POINTS = 1500, 6000
OBJECT_POINTS = 40_000  # at least half as many; dense enough to tell surfaces 1 % of the extent apart


class DegeneratePair(DegenerateShape):
    """A draw came out with too few points, too little overlap or no thickness."""


@dataclass(frozen=True)
class ScanPair:
    """A source and a target with the transformation between them.

    Attributes:
        source: the scan that moves, in its own frame.
        target: the scan that stays, in its own frame.
        gt_T_target_source: (4, 4) float64, ``p_target = T @ p_source``.
        overlap_ratio: share of the points with a counterpart in the other cloud, keys
            ``source`` and ``target``.
        source_viewpoint: (3,) unit direction towards a scanner far away, in the source's
            frame; None if the cloud was not seen from one side.
        target_viewpoint: (3,) the same of the target, in the target's frame.
        kind: range_scan, independent, shared, patch or room.
        extent: diagonal of the bounding box of the whole object, in the points' unit.
        object_points: (P, 3) sample of the whole object in the source's frame, where it was asked for.
        shared: (K, 2) int64, row (i, j) where source point i and target point j are one point of
            the object but for noise; None unless both clouds are crops of one sample.
        shape: name of the shape, where it is known.
    """

    source: PointCloud
    target: PointCloud
    gt_T_target_source: np.ndarray
    overlap_ratio: dict[str, float]
    source_viewpoint: np.ndarray | None
    target_viewpoint: np.ndarray | None
    kind: str
    extent: float
    object_points: np.ndarray | None = None
    shared: np.ndarray | None = None
    shape: str | None = None

    @property
    def smaller_overlap(self) -> float:
        """The overlap ratio of the side that has less of it."""
        return min(self.overlap_ratio.values())


def posed_pair(
    source: np.ndarray,
    target: np.ndarray,
    kind: str,
    extent: float,
    rng: np.random.Generator,
    *,
    translation: float,
    viewpoints: tuple[np.ndarray | None, np.ndarray | None] = (None, None),
    motions: tuple[np.ndarray, np.ndarray] | None = None,
    whole: np.ndarray | None = None,
) -> ScanPair:
    """Move two clouds of one object into frames of their own and measure their overlap.

    Args:
        source: (N, 3) in the object's frame.
        target: (M, 3) in the object's frame.
        kind: name of the recipe.
        extent: size of the whole object.
        rng: source of randomness.
        translation: largest translation along an axis, in extents.
        viewpoints: directions towards the scanners in the object's frame.
        motions: (4, 4) motions of source and target to use instead of random ones.
        whole: (P, 3) sample of the whole object to travel with the pair, thinned evenly.
    """
    if motions is None:
        first, second = (random_motion(rng, translation * extent) for _ in range(2))
    else:
        first, second = motions
    overlap_ratio = measure_overlap(source, target, extent, rng)
    seen_from = [
        None if direction is None else motion[:3, :3] @ direction
        for direction, motion in zip(viewpoints, (first, second))
    ]
    return ScanPair(
        PointCloud(rigid.apply(first, source)),
        PointCloud(rigid.apply(second, target)),
        second @ rigid.invert(first),
        overlap_ratio,
        seen_from[0],
        seen_from[1],
        kind,
        extent,
        None if whole is None else rigid.apply(first, _thinned(whole)),
    )


def random_motion(rng: np.random.Generator, translation: float) -> np.ndarray:
    """Draw a (4, 4) motion: uniform over SO(3), up to ``translation`` along each axis."""
    return rigid.rigid(rigid.random_rotation(rng), rng.uniform(-translation, translation, 3))


def measure_overlap(
    source: np.ndarray, target: np.ndarray, extent: float, rng: np.random.Generator
) -> dict[str, float]:
    """Measure how much two aligned clouds overlap.

    A point has a counterpart if the nearest point of the other cloud is within one hundredth
    of the extent, or within that cloud's spacing where it is sparser than that (twice the
    median distance of its nearest points: in a random sample they crowd).

    Args:
        source: (N, 3), in the target's frame.
        target: (M, 3).
        extent: size of the whole object.
        rng: draws the points that are measured (at most 1,500 a side).

    Returns:
        Shares in [0, 1], keys ``source`` and ``target``.
    """
    few = {"source": _few(source, COMPARED_POINTS, rng), "target": _few(target, COMPARED_POINTS, rng)}
    shares = {}
    for side, other in (("source", "target"), ("target", "source")):
        tree = cKDTree(few[other], balanced_tree=False, compact_nodes=False)
        spacing = 2.0 * float(np.median(tree.query(few[other][:300], k=2)[0][:, 1]))
        radius = max(OVERLAP_RADIUS * extent, spacing)
        distance, _ = tree.query(few[side][:MEASURED_POINTS], distance_upper_bound=radius)
        shares[side] = float(np.isfinite(distance).mean())
    return shares


def check_cloud(points: np.ndarray, least: int, extent: float) -> None:
    """Refuse clouds that no method can align.

    Raises:
        DegeneratePair: fewer than ``least`` points, or all of them near a line.
    """
    if len(points) < least:
        raise DegeneratePair(f"only {len(points)} points, {least} wanted")
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(points[:: max(1, len(points) // 2000)].T)), 0.0))
    if spread[1] < 0.01 * extent:
        raise DegeneratePair("the points lie along a line")


def _thinned(points: np.ndarray) -> np.ndarray:
    """Take every n-th point, so that no random draw is spent on it."""
    return points[:: -(-len(points) // OBJECT_POINTS)].astype(np.float64)


def _few(points: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    return points if len(points) <= count else points.take(rng.integers(0, len(points), count), axis=0)
