"""How two surfaces lie on each other under a transformation: where they meet, and whether they agree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from utopic_cli.estimation.surface import Surface
from utopic_cli.estimation.verification import AGREEING, CLOSE, FREE_SPACE_MARGIN
from utopic_cli.geometry import rigid

MEETING = 3.0
"""Points within this many voxels of the other surface meet it, for better or worse."""

SAMPLES = 4000
MOST_ALIKE = 1.2
NEXT = 4
"""The neighbour a scan is compared with in itself: about as far as one of another scan."""


@dataclass(frozen=True)
class Meeting:
    """How two surfaces lie on each other, both ways.

    Attributes:
        source_share: share of the source's points within ``MEETING`` voxels of the target.
        target_share: likewise, of the target's points.
        agreement: of the points that meet the other surface, the share that lies in it (close to
            the tangent plane, normals alike): lower where the surfaces cross, and where they are rough.
        likeness: ``agreement`` over the share of neighbours within one scan that agree as much: near 1
            where the surfaces coincide, however rough they are; at most ``MOST_ALIKE``.
        tightness: median distance from the tangent plane of those that agree, in voxels.
        looseness: the same of all that meet: rises where surfaces cross or only run alongside.
        turning: median angle between the normals of the points that meet, as 1 - cosine.
        violation: share of points that stand where the other scan saw free space.
        conflict: ``violation`` in proportion to the points that meet the other surface.
        contradiction: likewise, of the way in which less of it is: where a scan was taken from is a guess,
            and a wrong one sees violations in one way only.
    """

    source_share: float
    target_share: float
    agreement: float
    likeness: float
    tightness: float
    looseness: float
    turning: float
    violation: float
    conflict: float
    contradiction: float


def meet(source: Surface, target: Surface, transformation: np.ndarray, alike: float | None = None) -> Meeting:
    """Measure how two surfaces lie on each other.

    Args:
        source: the scan that moves.
        target: the scan that stays.
        transformation: (4, 4) T_target_source.
        alike: ``self_agreement`` of the two, if it is known already.
    """
    if alike is None:
        alike = self_agreement(source, target)
    forward = _one_way(source, target, transformation)
    back = rigid.invert(transformation)
    backward = _one_way(target, source, back)
    beside = np.concatenate([forward.beside, backward.beside])
    agree = np.concatenate([forward.agree, backward.agree])
    turning = np.concatenate([forward.turning, backward.turning])
    seen_through = _violation(source, target, transformation), _violation(target, source, back)
    violation = (seen_through[0] + seen_through[1]) / 2.0
    share = max((forward.share + backward.share) / 2.0, 0.01)
    agreement = float(agree.mean()) if len(agree) else 0.0
    return Meeting(
        source_share=forward.share,
        target_share=backward.share,
        agreement=agreement,
        likeness=min(agreement / alike, MOST_ALIKE),
        tightness=float(np.median(beside[agree])) if agree.any() else CLOSE,
        looseness=float(np.median(beside)) if len(beside) else MEETING,
        turning=float(np.median(turning)) if len(turning) else 1.0,
        violation=violation,
        conflict=violation / share,
        contradiction=min(seen_through) / share,
    )


def agreeing(source: Surface, target: Surface, transformation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tell which points meet the other surface, and which of them lie in it; see ``Meeting``.

    Args:
        source: the scan that moves.
        target: the scan that stays.
        transformation: (4, 4) T_target_source.

    Returns:
        Twice (P,) bool, of points of the source and then of the target: the same for any transformation.
    """
    ways = (
        _one_way(source, target, transformation),
        _one_way(target, source, rigid.invert(transformation)),
    )
    met = np.concatenate([way.met for way in ways])
    agree = np.zeros(len(met), dtype=bool)
    agree[met] = np.concatenate([way.agree for way in ways])
    return met, agree


def self_agreement(source: Surface, target: Surface) -> float:
    """Share of neighbours within one scan that agree as ``meet`` asks of another's: of the rougher scan."""
    return max(min(_self_agreement(source), _self_agreement(target)), 0.05)


def _self_agreement(surface: Surface) -> float:
    beside, cosine = _beside_itself(surface)
    return float(((beside < CLOSE) & (cosine > AGREEING)).mean()) if len(beside) else 0.0


def self_tightness(source: Surface, target: Surface) -> float:
    """Mean over the scans of how closely a scan lies on itself: ``tightness`` between its own neighbours."""
    own = []
    for surface in (source, target):
        beside, cosine = _beside_itself(surface)
        agreed = beside[(beside < CLOSE) & (cosine > AGREEING)]
        own.append(float(np.median(agreed)) if len(agreed) else CLOSE)
    return float(np.mean(own))


def _beside_itself(surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    """Distance of points from their neighbours' tangent planes, in voxels, and cosine of the normals."""
    chosen = slice(None, None, max(1, len(surface.points) // SAMPLES))
    points, normals = surface.points[chosen], surface.normals[chosen]
    distance, index = surface.tree.query(points, k=[NEXT + 1], distance_upper_bound=MEETING * surface.voxel)
    near = np.isfinite(distance[:, 0])
    index, points, normals = index[near, 0], points[near], normals[near]
    beside = np.abs(np.einsum("nd,nd->n", surface.points[index] - points, surface.normals[index]))
    return beside / surface.voxel, np.einsum("nd,nd->n", normals, surface.normals[index])


@dataclass(frozen=True)
class _Way:
    """One scan's points on the other's surface; the last three arrays are of the points that meet it.

    Attributes:
        met: (P,) bool, of the points looked at, which meet it.
        beside: distance from the nearest point's tangent plane, in voxels.
        turning: 1 - cosine of the angle between the normals.
        agree: whether the point lies in the surface.
    """

    met: np.ndarray
    beside: np.ndarray
    turning: np.ndarray
    agree: np.ndarray

    @property
    def share(self) -> float:
        """Share of the points that meet the other surface."""
        return len(self.beside) / len(self.met)


def _one_way(moving: Surface, fixed: Surface, T: np.ndarray) -> _Way:
    moved = rigid.apply(T, _looked_at(moving.points))
    turned = _looked_at(moving.normals) @ T[:3, :3].T
    distance, index = fixed.tree.query(moved, distance_upper_bound=MEETING * fixed.voxel)
    met = np.isfinite(distance)
    index = index[met]
    plane = fixed.normals[index]
    beside = np.abs(np.einsum("nd,nd->n", fixed.points[index] - moved[met], plane)) / fixed.voxel
    cosine = np.einsum("nd,nd->n", turned[met], plane)
    return _Way(
        met=met,
        beside=beside,
        turning=1.0 - cosine,
        agree=(beside < CLOSE) & (cosine > AGREEING),
    )


def _violation(moving: Surface, fixed: Surface, T: np.ndarray) -> float:
    """Share of one scan's points that stand where the other scan saw free space."""
    moved = rigid.apply(T, _looked_at(moving.points))
    return float(fixed.sight.in_front(moved, FREE_SPACE_MARGIN * fixed.voxel).mean())


def _looked_at(rows: np.ndarray) -> np.ndarray:
    return rows[:: max(1, len(rows) // SAMPLES)]
