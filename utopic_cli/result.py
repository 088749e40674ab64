"""What a registration returns: plain data, no behaviour beyond convenience.

Convention, here and everywhere: ``p_target = T_target_source @ p_source``. Lengths are in
the files' own units, angles in degrees, overlap and uncertainty in [0, 1].
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from utopic_cli.result_display import as_html, one_line


@dataclass(frozen=True)
class Correspondences:
    """Point pairs between two clouds.

    Attributes:
        source_indices: (K,) int64 into the source's points.
        target_indices: (K,) int64 into the target's points.
        weights: (K,) float64, not negative.
    """

    source_indices: np.ndarray
    target_indices: np.ndarray
    weights: np.ndarray

    def __len__(self) -> int:
        return len(self.source_indices)


@dataclass(frozen=True)
class FitMeasures:
    """How well two clouds fit under a transformation, measured at full resolution.

    Attributes:
        overlap_ratio: share of points with a counterpart, keys ``source`` and ``target``.
        inlier_ratio: share of the correspondences the transformation explains.
        inlier_rmse: root mean square distance of the points with a counterpart (file units).
        residual_percentiles: distance to the nearest counterpart (file units), keys
            ``p50``, ``p75``, ``p90``, ``p95``.
        threshold: largest distance at which a point counts as having a counterpart.
    """

    overlap_ratio: dict[str, float]
    inlier_ratio: float
    inlier_rmse: float
    residual_percentiles: dict[str, float]
    threshold: float


@dataclass(frozen=True)
class FreeMotion:
    """A small motion of the source that the geometry does not fix.

    Attributes:
        kind: ``rotation`` about an axis, or ``translation`` along one.
        axis: (3,) unit vector in the target's frame.
        point: (3,) a point on the axis of a rotation, in the target's frame; None for a translation.
    """

    kind: str
    axis: np.ndarray
    point: np.ndarray | None = None


@dataclass(frozen=True)
class Observability:
    """How well the overlap fixes the six motions.

    Attributes:
        eigenvalues: (6,) of the normal matrix per point, ascending, dimensionless: rotations are
            counted about the middle of the overlap, times its radius.
        free: motions that are not fixed.
        covariance: (6, 6) of the twist (omega in radians, v in the points' unit) about ``centre``, in
            the target's frame; along a free motion it is as large as the floor allows, not infinite.
        centre: (3,) middle of the overlap, in the target's frame.
        points: number of points it rests on.
    """

    eigenvalues: np.ndarray
    free: tuple[FreeMotion, ...]
    covariance: np.ndarray
    centre: np.ndarray
    points: int


@dataclass(frozen=True)
class RegistrationResult:
    """The answer for one pair of clouds.

    Attributes:
        T_target_source: (4, 4) float64 rigid transformation, ``p_target = T @ p_source``.
        confidence: calibrated probability that the transformation is right, or None where
            the weights carry no calibration.
        trusted: whether to rely on it; never where there is no calibrated confidence.
        reasons: why (or why not), in plain words.
        ambiguous_with: rival (4, 4) transformations that fit nearly as well.
        source_overlap: (N,) float32 in [0, 1], one per source point; from ``align``, NaN for points
            of the file or array that are not finite.
        target_overlap: (M,) float32 in [0, 1], one per target point.
        source_uncertainty: (N,) float32 in [0, 1], min-max normalised over the pair.
        target_uncertainty: (M,) float32 in [0, 1], min-max normalised over the pair.
        raw_uncertainty: un-normalised variance per network point (``model.uncertainty``),
            summarised: keys ``source_mean``, ``target_mean``, ``p50``, ``p90``.
        correspondences: indices into the original points, with weights.
        fit: measures at full resolution.
        observability: which motions the overlap fixes and how well, in file units; None where too
            little overlaps to tell.
        signals: the numbers the verdict rests on, by name: see ``estimation.evidence``.
        timings_s: seconds per step.
        warnings: things a user should know.
        weights_name: name of the network weights used.
        weights_sha256: hash of the weights file.
        options: the resolved options of this run.
        _digests: of the points that ``align`` was given, source first, so that ``save`` can tell others.
    """

    T_target_source: np.ndarray
    confidence: float | None
    trusted: bool
    reasons: tuple[str, ...]
    ambiguous_with: tuple[np.ndarray, ...]
    source_overlap: np.ndarray
    target_overlap: np.ndarray
    source_uncertainty: np.ndarray
    target_uncertainty: np.ndarray
    raw_uncertainty: dict[str, float]
    correspondences: Correspondences
    fit: FitMeasures
    observability: Observability | None
    timings_s: dict[str, float]
    signals: dict[str, float] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    weights_name: str = ""
    weights_sha256: str = ""
    options: dict[str, Any] = field(default_factory=dict)
    _digests: tuple[str, ...] = field(default=(), repr=False)

    def __repr__(self) -> str:
        return one_line(self)

    def _repr_html_(self) -> str:
        """Show the verdict, its reasons, the matrix and the measures in a notebook."""
        return as_html(self)
