"""Transformations that many correspondences agree on, found among mostly wrong ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist

from utopic_cli.estimation.prior import ANYWHERE, Prior
from utopic_cli.estimation.procrustes import procrustes_batch, procrustes_shared

MERGE_ANGLE_DEG = 10.0
NORMAL_TOLERANCE = 0.4
SEEDS = 1000
NEIGHBOURS = 20
BLOCK = 128  # rows of a large matrix made at a time: what they take stays in the cache


@dataclass(frozen=True)
class Hypothesis:
    """A transformation that may be the answer.

    Attributes:
        T_target_source: (4, 4) float64.
        score: how much speaks for it; comparable only among hypotheses of one kind.
        origin: where it came from: ``consensus``, ``assignment`` or ``initial``.
    """

    T_target_source: np.ndarray
    score: float
    origin: str = "consensus"


def consensus_hypotheses(
    source_points: np.ndarray,
    target_points: np.ndarray,
    weights: np.ndarray,
    tolerance: float,
    limit: int = 40,
    source_normals: np.ndarray | None = None,
    target_normals: np.ndarray | None = None,
    prior: Prior = ANYWHERE,
) -> list[Hypothesis]:
    """Find distinct transformations supported by mutually consistent correspondences.

    Two correspondences are consistent if they keep a length: the distance of their source
    points equals that of their target points within ``tolerance`` (and, with normals, the
    angle between their normals), and it is turned no farther than the prior admits.
    Second-order consistency counts the correspondences consistent with *both*, which wrong
    pairs rarely share by chance. Each seed with the neighbours it shares most with gives one
    transformation; its support over all correspondences is its score.

    Args:
        source_points: (K, 3) float64, one row a correspondence.
        target_points: (K, 3) their partners.
        weights: (K,) not negative, how far each correspondence is believed.
        tolerance: largest distance of a moved source point to its partner; transformations
            count as the same within 10 degrees and 3.2 tolerances (8 voxels of 1/2.5).
        limit: most hypotheses returned.
        source_normals: (K, 3) oriented unit normals, or None.
        target_normals: (K, 3) oriented unit normals, or None.
        prior: how far the source may be turned.

    Returns:
        Hypotheses, best first, distinct, at most ``limit``; empty if no three
        correspondences are consistent, or what follows is not admitted. The same input gives the same output.

    Raises:
        ValueError: fewer than three correspondences, or a tolerance that is not positive.
    """
    count = len(source_points)
    if count < 3:
        raise ValueError("consensus needs at least three correspondences")
    if not tolerance > 0:
        raise ValueError(f"tolerance {tolerance} is not positive")
    first_order = _consistency(source_points, target_points, tolerance, source_normals, target_normals, prior)
    seeds = _seeds(first_order, weights)
    shared = first_order[seeds] * (first_order[seeds] @ first_order)  # (S, K)
    neighbours = min(NEIGHBOURS, count - 1)
    nearest = np.argpartition(-shared, neighbours - 1, axis=1)[:, :neighbours]
    strength = np.take_along_axis(shared, nearest, axis=1).astype(np.float64)
    usable = np.count_nonzero(strength, axis=1) >= 2
    seeds, nearest, strength = seeds[usable], nearest[usable], strength[usable]
    if not len(seeds):
        return []
    group = np.concatenate([seeds[:, None], nearest], axis=1)  # (S, neighbours + 1)
    belief = np.concatenate([strength.max(axis=1, keepdims=True), strength], axis=1)
    transformations, spread = procrustes_batch(source_points[group], target_points[group], belief)
    transformations = transformations[spread > 1e-6]
    transformations = transformations[prior.admits(transformations)]
    if not len(transformations):
        return []

    support = _Support(source_points, target_points, tolerance, source_normals, target_normals)
    inlier = support(transformations)  # (S, K)
    order = np.argsort(-(inlier @ weights), kind="stable")
    transformations = transformations[order]
    kept = distinct(transformations, source_points.mean(axis=0), 3.2 * tolerance)[: 2 * limit]
    transformations = transformations[kept]
    for _ in range(2):  # refit to everything that agrees
        inlier = support(transformations) * weights
        enough = np.flatnonzero(np.count_nonzero(inlier, axis=1) >= 3)
        if len(enough):
            refitted, spread = procrustes_shared(source_points, target_points, inlier[enough])
            transformations[enough[spread > 1e-6]] = refitted[spread > 1e-6]
    scores = support(transformations) @ weights
    order = np.argsort(-scores, kind="stable")
    transformations, scores = transformations[order], scores[order]
    kept = distinct(transformations, source_points.mean(axis=0), 3.2 * tolerance)[:limit]
    return [Hypothesis(transformations[i], float(scores[i])) for i in kept]


def distinct(
    transformations: np.ndarray, centre: np.ndarray, distance: float, angle_deg: float = MERGE_ANGLE_DEG
) -> np.ndarray:
    """Keep each transformation that differs from every better one.

    Args:
        transformations: (H, 4, 4), best first.
        centre: (3,) source point at which translations are compared.
        distance: largest displacement of ``centre`` between two that count as the same.
        angle_deg: largest rotation between two that count as the same.

    Returns:
        (D,) int64 rows kept, in order.
    """
    rotations = transformations[:, :3, :3].reshape(-1, 9)
    places = transformations[:, :3, :3] @ centre + transformations[:, :3, 3]
    near = cdist(places, places) < distance  # (H, H)
    near &= rotations @ rotations.T > 1.0 + 2.0 * np.cos(np.radians(angle_deg))  # the trace of R_i^T R_j
    covered = np.zeros(len(transformations), dtype=bool)
    kept: list[int] = []
    for i in range(len(transformations)):
        if not covered[i]:
            kept.append(i)
            covered |= near[i]
    return np.array(kept, dtype=np.int64)


def _consistency(
    source_points: np.ndarray,
    target_points: np.ndarray,
    tolerance: float,
    source_normals: np.ndarray | None,
    target_normals: np.ndarray | None,
    prior: Prior,
) -> np.ndarray:
    """(K, K) float32: 1 where a pair keeps its length (and its angle between normals), else 0.

    It is 0 as well where the pair's direction would be turned farther than the prior admits, and of pairs
    too short to say anything. Row by row in blocks that fit into the cache.
    """
    points = [_centred(source_points), _centred(target_points)]
    square = [np.einsum("kd,kd->k", each, each) for each in points]
    normals = None
    if source_normals is not None and target_normals is not None:
        normals = source_normals.astype(np.float32), target_normals.astype(np.float32)
    count = len(source_points)
    result = np.empty((count, count), dtype=np.float32)
    for start in range(0, count, BLOCK):
        rows = slice(start, start + BLOCK)
        source_distance, target_distance = (
            _distances(each[rows], each, own[rows], own) for each, own in zip(points, square, strict=True)
        )
        consistent = np.abs(source_distance - target_distance) <= tolerance
        consistent &= source_distance > tolerance
        consistent &= target_distance > tolerance
        if normals is not None:
            difference = normals[0][rows] @ normals[0].T
            difference -= normals[1][rows] @ normals[1].T
            consistent &= np.abs(difference, out=difference) <= NORMAL_TOLERANCE
        if prior.bounded:
            along = _products(points[0], points[1], rows, prior)
            along += tolerance * target_distance  # that much of it may be the points' inaccuracy
            consistent &= along >= prior.least_cosine * source_distance * target_distance
        result[rows] = consistent
    return result


def _products(source: np.ndarray, target: np.ndarray, rows: slice, prior: Prior) -> np.ndarray:
    """Inner products (R, K) of source_i - source_j, turned as known beforehand, with target_i - target_j."""
    turned = source @ prior.rotation.T.astype(source.dtype)
    own = np.einsum("kd,kd->k", turned, target)
    products = own[rows, None] + own
    products -= turned[rows] @ target.T
    products -= target[rows] @ turned.T
    return products


def _centred(points: np.ndarray) -> np.ndarray:
    return (points - points.mean(axis=0)).astype(np.float32)


def _distances(
    some: np.ndarray, points: np.ndarray, some_square: np.ndarray, square: np.ndarray
) -> np.ndarray:
    """Distances (R, K) of (R, 3) points to (K, 3), given their squared lengths, by one matrix product."""
    squared = some @ points.T
    squared *= -2.0
    squared += some_square[:, None] + square
    return np.sqrt(np.maximum(squared, 0.0, out=squared), out=squared)


def _seeds(first_order: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """The correspondences most consistent with the rest, by the leading eigenvector."""
    vector = np.sqrt(weights / max(weights.max(), 1e-300)).astype(np.float32)
    for _ in range(10):
        vector = first_order @ vector
        vector /= max(float(np.linalg.norm(vector)), 1e-30)
    return np.argsort(-vector, kind="stable")[:SEEDS]


class _Support:
    """How well transformations explain the correspondences, for many at once.

    Expanding |R s + t - q|^2 makes it linear in 13 numbers of the transformation, so that all
    residuals are one matrix product instead of an (H, K, 3) array.
    """

    def __init__(
        self,
        source_points: np.ndarray,
        target_points: np.ndarray,
        tolerance: float,
        source_normals: np.ndarray | None,
        target_normals: np.ndarray | None,
    ) -> None:
        self.tolerance = tolerance
        # Centring keeps the expansion's cancellation harmless.
        self.source_centre, self.target_centre = source_points.mean(axis=0), target_points.mean(axis=0)
        source, target = source_points - self.source_centre, target_points - self.target_centre
        outer = np.einsum("ki,kj->ijk", target, source).reshape(9, -1)
        constant = np.einsum("kd,kd->k", source, source) + np.einsum("kd,kd->k", target, target)
        ones = np.ones((1, len(source)))
        self.terms = np.concatenate([-2.0 * outer, 2.0 * source.T, -2.0 * target.T, ones])  # (16, K)
        self.constant = constant
        self.normal_terms = None
        if source_normals is not None and target_normals is not None:
            self.normal_terms = np.einsum("ki,kj->ijk", target_normals, source_normals).reshape(9, -1)

    def __call__(self, transformations: np.ndarray) -> np.ndarray:
        """Return (H, K) in [0, 1]: 1 at no residual, 0 beyond the tolerance or against the normals."""
        support = np.empty((len(transformations), len(self.constant)))
        for start in range(0, len(transformations), BLOCK):
            rows = slice(start, start + BLOCK)
            self._block(transformations[rows], support[rows])
        return support

    def _block(self, transformations: np.ndarray, support: np.ndarray) -> None:
        rotations = transformations[:, :3, :3]
        shift = transformations[:, :3, 3] + rotations @ self.source_centre - self.target_centre
        back = np.einsum("hij,hi->hj", rotations, shift)
        square = np.einsum("hd,hd->h", shift, shift)[:, None]
        flat = rotations.reshape(-1, 9)
        np.matmul(np.concatenate([flat, back, shift, square], axis=1), self.terms, out=support)  # residuals
        support += self.constant
        support *= -1.0 / self.tolerance**2
        support += 1.0
        np.clip(support, 0.0, 1.0, out=support)
        if self.normal_terms is not None:
            support *= flat @ self.normal_terms > 1.0 - NORMAL_TOLERANCE
