"""What one answer to one pair is worth, against the known answer: pose, matches, overlap."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from utopic_cli.bridge import NetworkView
from utopic_cli.geometry import rigid
from utopic_cli.preprocess import PreparedPair

RECALLS = ((1.0, 0.02), (5.0, 0.05))
SUCCESS = RECALLS[1]
"""Rotation error in degrees and translation error in the protocol's unit; both must be less."""

SYMMETRY_TOLERANCE = 0.02
"""The object, moved, lies within this share of its extent of where it should be."""

PROBES = 4000
HIT_REACH = 2.2
"""A match is right if it lies within this many node spacings of the true place."""

SUREST = 250


@dataclass(frozen=True)
class PoseMeasures:
    """How far a transformation is from the known one.

    Attributes:
        rotation_deg: Error(R), the angle between the rotations, in [0, 180].
        translation: Error(t) in the protocol's unit.
        euler_deg: absolute differences of the xyz Euler angles, each in [0, 180].
        axes: absolute differences of the translation along each axis, in the protocol's unit.
        symmetric: within ``SUCCESS``, or the moved object can't be told from the rightly moved one:
            every part of it lies within ``SYMMETRY_TOLERANCE``.
        object_p95: 95 % of the moved object lie within this share of its extent of where the object
            should be; None without a sample of it.
        object_max: all of it.
    """

    rotation_deg: float
    translation: float
    euler_deg: tuple[float, float, float]
    axes: tuple[float, float, float]
    symmetric: bool
    object_p95: float | None = None
    object_max: float | None = None

    def within(self, bounds: tuple[float, float]) -> bool:
        """Tell whether both errors are less than (degrees, length)."""
        return self.rotation_deg < bounds[0] and self.translation < bounds[1]


def measure_pose(
    T: np.ndarray,
    gt_T: np.ndarray,
    unit: float,
    *,
    centre: np.ndarray | None = None,
    object_points: np.ndarray | None = None,
    extent: float = np.nan,
) -> PoseMeasures:
    """Compare a transformation with the known one.

    Args:
        T: (4, 4) estimated T_target_source.
        gt_T: (4, 4) the known one.
        unit: length that translations are divided by.
        centre: (3,) source point at which translations are compared; None: the origin of the
            source's frame, that is the usual difference of the translation vectors.
        object_points: (P, 3) dense sample of the whole object in the source's frame; without it,
            only ``SUCCESS`` counts.
        extent: diagonal of the whole object's bounding box.
    """
    point = np.zeros(3) if centre is None else centre
    axes = np.abs(rigid.apply(T, point) - rigid.apply(gt_T, point)) / unit
    angle = rigid.relative_rotation_error_deg(T, gt_T)
    length = float(np.linalg.norm(axes))
    same = angle < SUCCESS[0] and length < SUCCESS[1]
    p95 = largest = None
    if object_points is not None:
        tolerance = SYMMETRY_TOLERANCE * extent
        distances, gap = object_distances(object_points, T, gt_T, tolerance)
        p95, largest = float(np.quantile(distances, 0.95)) / extent, float(distances.max()) / extent
        same = same or in_one_place(distances, gap, tolerance)
    return PoseMeasures(
        angle,
        length,
        _triple(euler_differences_deg(T[:3, :3], gt_T[:3, :3])),
        _triple(axes),
        same,
        p95,
        largest,
    )


def euler_differences_deg(rotation: np.ndarray, gt_rotation: np.ndarray) -> np.ndarray:
    """Absolute differences of the xyz Euler angles (about fixed axes) -> (3,) degrees in [0, 180].

    Differences go round the circle: the paper's come from angles under 45 degrees, where that
    changes nothing but wild failures.
    """
    angles = Rotation.from_matrix(np.stack([rotation, gt_rotation])).as_euler("xyz", degrees=True)
    return np.abs((angles[0] - angles[1] + 180.0) % 360.0 - 180.0)


def in_one_place(distances: np.ndarray, gap: float, tolerance: float) -> bool:
    """Tell whether an object lies where it should, everywhere to within a tolerance.

    What was compared are samples: ``tolerance`` is meant across the surface, and along it the
    widest gap of the sample is allowed for.

    Args:
        distances: (K,) and ``gap`` from ``object_distances``.
        gap: see there.
        tolerance: in the points' unit.
    """
    return bool(distances.max() <= np.hypot(tolerance, gap))


def object_distances(
    object_points: np.ndarray, T: np.ndarray, gt_T: np.ndarray, stray: float
) -> tuple[np.ndarray, float]:
    """Measure how far an object moved by one transformation is from itself moved by another.

    Args:
        object_points: (P, 3) dense sample in the frame that both start from.
        T: (4, 4).
        gt_T: (4, 4).
        stray: samples farther than this from all others (of a dent hardly seen from outside)
            have no like elsewhere and are left out.

    Returns:
        distances: (K,) from moved samples to the nearest of the otherwise moved ones, first one way
            and then the other.
        gap: the widest gap that the sample itself has.

    Raises:
        ValueError: the sample is too sparse: no point has another within ``stray``.
    """
    probes = object_points[:: max(1, len(object_points) // PROBES)]
    tree = cKDTree(object_points)
    alone = tree.query(probes, k=2)[0][:, 1]
    probes, alone = probes[alone < stray], alone[alone < stray]
    if not len(probes):
        raise ValueError("the sample of the whole object is too sparse to compare")
    # Moving the probes by inv(gt) T is moving the object by T and looking at it in the right place.
    there = rigid.invert(gt_T) @ T
    ways = [tree.query(rigid.apply(motion, probes))[0] for motion in (there, rigid.invert(there))]
    return np.concatenate(ways), float(alone.max())


@dataclass(frozen=True)
class KnownNodes:
    """The known answer at the sampled points of a pair.

    Attributes:
        distance: (N, M) from where each source node belongs to each target node, normalised units.
        spacing: node spacing, normalised units.
        source_overlap: (N,) bool, the other cloud has a node within the protocol's radius.
        target_overlap: (M,) bool.
        mutual_source: (N,) bool, the paper's narrower label: it and a node of the other cloud are each
            other's nearest, and within that radius.
        mutual_target: (M,) bool.
    """

    distance: np.ndarray
    spacing: float
    source_overlap: np.ndarray
    target_overlap: np.ndarray
    mutual_source: np.ndarray
    mutual_target: np.ndarray


def known_nodes(prepared: PreparedPair, gt_T: np.ndarray, radius: float) -> KnownNodes:
    """Label the sampled points of a pair.

    Args:
        prepared: the pair.
        gt_T: (4, 4) known T_target_source in file units.
        radius: nodes nearer than this show the same piece of surface; normalised units.
    """
    moved = rigid.apply(prepared.normalise(gt_T), prepared.source.points)
    distance = cdist(moved, prepared.target.points)
    near = distance < radius
    mutual = (
        near
        & (distance == distance.min(axis=1, keepdims=True))
        & (distance == distance.min(axis=0, keepdims=True))
    )
    return KnownNodes(
        distance, prepared.spacing, near.any(axis=1), near.any(axis=0), mutual.any(axis=1), mutual.any(axis=0)
    )


@dataclass(frozen=True)
class MatchMeasures:
    """How good the matching scores are.

    Attributes:
        hit_rate: share of the overlapping source nodes whose best match lies within 2.2 node
            spacings of the true place; None if nothing overlaps.
        inlier_ratio: share of the 250 surest matches that lie within the protocol's radius.
    """

    hit_rate: float | None
    inlier_ratio: float


def measure_matches(scores: np.ndarray, known: KnownNodes, inlier_radius: float) -> MatchMeasures:
    """Judge (N, M) matching scores.

    Args:
        scores: without slack.
        known: the answer.
        inlier_radius: normalised units.
    """
    error = _match_error(scores, known.distance)
    surest = np.argsort(-scores.max(axis=1), kind="stable")[:SUREST]
    hits = error[known.source_overlap] < HIT_REACH * known.spacing
    return MatchMeasures(
        float(hits.mean()) if len(hits) else None, float((error[surest] < inlier_radius).mean())
    )


def hit(scores: np.ndarray, distance: np.ndarray, spacing: float) -> np.ndarray:
    """Tell whose best match lies within 2.2 node spacings of the true place -> (N,) bool.

    Args:
        scores: (N, M) without slack.
        distance: (N, M) from where each node belongs to each node of the other cloud.
        spacing: node spacing.
    """
    return _match_error(scores, distance) < HIT_REACH * spacing


def _match_error(scores: np.ndarray, distance: np.ndarray) -> np.ndarray:
    return np.take_along_axis(distance, scores.argmax(axis=1)[:, None], axis=1)[:, 0]


@dataclass(frozen=True)
class OverlapMeasures:
    """How well overlap is told at 0.5, over the sampled points of both clouds.

    Attributes:
        accuracy: share told right.
        precision: share of those called overlapping that are; None if none is called so.
        recall: share of the overlapping that are called so; None if there are none.
        accuracy_mutual: accuracy by the paper's narrower labels (mutual nearest neighbours).
    """

    accuracy: float
    precision: float | None
    recall: float | None
    accuracy_mutual: float


def measure_overlap(view: NetworkView, known: KnownNodes) -> OverlapMeasures:
    """Judge overlap probabilities."""
    told = np.concatenate([view.source_overlap, view.target_overlap]) > 0.5
    true = np.concatenate([known.source_overlap, known.target_overlap])
    mutual = np.concatenate([known.mutual_source, known.mutual_target])
    return OverlapMeasures(
        float((told == true).mean()),
        float(true[told].mean()) if told.any() else None,
        float(told[true].mean()) if true.any() else None,
        float((told == mutual).mean()),
    )


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
