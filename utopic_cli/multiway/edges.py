"""A registered pair as an edge of the graph: where it puts the source, and how far to believe it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from utopic_cli.geometry.rigid import apply, rigid

LEAST_OVERLAP = 0.05
"""Where less of both scans overlaps, an answer without a verdict is not worth a look."""

SUREST, LEAST = 0.98, 0.02
"""No verdict counts for more, or a candidate for less, than this."""

UNCALIBRATED = (0.2, 0.65)
"""Without a calibrated confidence: the chance that a pair is right at no and at half overlap.

What loops add to it can suffice; by itself it never does.
"""


@dataclass(frozen=True)
class ScanShape:
    """Where a scan's points lie, in its own frame.

    Attributes:
        centroid: (3,) file units.
        moments: (3, 3) covariance of the points.
    """

    centroid: np.ndarray
    moments: np.ndarray

    @property
    def size(self) -> float:
        """The diagonal of a cube with the same spread: an extent that no rotation changes."""
        return float(np.sqrt(12.0 * np.trace(self.moments)))

    def displacement(self, motion: np.ndarray) -> float:
        """How far a motion of the scan about its centroid moves its points, as a share of its size.

        Args:
            motion: (4, 4), in coordinates whose origin is the centroid.

        Returns:
            Root mean square over the points.
        """
        return float(displacements(motion[None], self.moments[None])[0])


def displacements(motions: np.ndarray, moments: np.ndarray) -> np.ndarray:
    """Return ``ScanShape.displacement`` of many motions of many scans.

    Args:
        motions: (K, 4, 4), each in coordinates whose origin is its scan's centroid.
        moments: (K, 3, 3) covariances of the scans' points.

    Returns:
        (K,) root mean squares over the points, as shares of the scans' sizes.
    """
    change = motions[:, :3, :3] - np.eye(3)
    shift = motions[:, :3, 3]
    turned = ((change @ moments) * change).sum(axis=(1, 2))
    squares = np.maximum(turned, 0.0) + np.einsum("ki,ki->k", shift, shift)
    return np.sqrt(squares / (12.0 * np.trace(moments, axis1=1, axis2=2)))


@dataclass(frozen=True)
class Edge:
    """A pair that may hold. All coordinates are centred: a scan's origin is its centroid.

    Attributes:
        source: index of the scan that moves.
        target: index of the scan that stays.
        T_target_source: (4, 4) between the centred scans.
        prior: chance that it is right, from the pair alone, in (0, 1).
        trusted: whether the pair alone suffices.
        covariance: (6, 6) of the twist (omega, v) about ``centre``, in the target's centred frame.
        centre: (3,) middle of the overlap there.
        overlap: the smaller share of the two scans that overlaps.
        rivals: how many other answers fit nearly as well.
        alternatives: (4, 4) of each, between the centred scans.
    """

    source: int
    target: int
    T_target_source: np.ndarray
    prior: float
    trusted: bool
    covariance: np.ndarray
    centre: np.ndarray
    overlap: float
    rivals: int = 0
    alternatives: tuple[np.ndarray, ...] = ()


def make_edge(
    source: int, target: int, report: dict[str, Any], shapes: dict[int, ScanShape]
) -> tuple[Edge | None, str]:
    """Judge a pair by its report.

    Args:
        source: index of the scan that moves.
        target: index of the scan that stays.
        report: as ``build_report`` makes it.
        shapes: of the scans, by index.

    Returns:
        The edge, or None and why the pair can't be one, whatever loops say of it.
    """
    overlap = report["overlap_ratio"]
    confidence, trusted = report["confidence"], bool(report["trusted"])
    if report["covariance"] is None:
        return None, "too little overlaps"
    if max(overlap.values()) < LEAST_OVERLAP and not trusted:
        return None, f"only {max(overlap.values()):.0%} overlaps"
    if report["unobservable"]:
        kinds = " and ".join(sorted({motion["kind"] for motion in report["unobservable"]}))
        return None, f"the surfaces that overlap leave a {kinds} free"
    if confidence is None:
        low, high = UNCALIBRATED
        prior = low + (high - low) * min(1.0, 2.0 * min(overlap.values()))
        if report["ambiguous_with"]:
            prior /= 1 + len(report["ambiguous_with"])
    else:
        prior = confidence
    from_centred = rigid(np.eye(3), shapes[source].centroid)
    to_centred = rigid(np.eye(3), -shapes[target].centroid)
    return Edge(
        source,
        target,
        to_centred @ np.array(report["T_target_source"]) @ from_centred,
        float(np.clip(prior, LEAST, SUREST)),
        trusted,
        np.array(report["covariance"]),
        apply(to_centred, np.array(report["covariance_about"])),
        float(min(overlap.values())),
        len(report["ambiguous_with"]),
        tuple(to_centred @ np.array(rival) @ from_centred for rival in report["ambiguous_with"]),
    ), ""
