"""A pair of scans with a known answer, or known to have none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from utopic_cli.benchmark.metrics import pair_extent, pose_error
from utopic_cli.point_cloud import PointCloud
from utopic_cli.synthesis.scan_pair import ScanPair


@dataclass(frozen=True)
class Trial:
    """Two raw scans, each in a random pose of its own, and what is known of them.

    Attributes:
        kind: the recipe, a name from ``trials.KINDS``.
        source: the scan that moves, float64.
        target: the scan that stays, float64.
        gt_T_target_source: (4, 4) float64; None where no transformation is right.
        extent: diagonal of the bounding box of the larger scan, in the points' unit.
        overlap: share of the smaller side that has a counterpart; 0 where nothing is right.
        shape: what was scanned.
    """

    kind: str
    source: PointCloud
    target: PointCloud
    gt_T_target_source: np.ndarray | None
    extent: float
    overlap: float
    shape: str

    def right(self, T_target_source: np.ndarray) -> bool:
        """Tell whether a (4, 4) answer is right: under 5 degrees and under 5 % of the extent.

        Translations are compared at the source's centroid, as on real scans. Where there is no
        right answer, none is right.
        """
        if self.gt_T_target_source is None:
            return False
        centroid = self.source.points.mean(axis=0)
        return pose_error(T_target_source, self.gt_T_target_source, centroid, self.extent).success


def with_answer(kind: str, pair: ScanPair, shape: str | None = None) -> Trial:
    """Return a pair with a known answer as a trial; its shape's name may be given anew."""
    return Trial(
        kind,
        pair.source,
        pair.target,
        pair.gt_T_target_source,
        pair_extent(pair.source, pair.target),
        pair.smaller_overlap,
        str(pair.shape) if shape is None else shape,
    )


def without_answer(kind: str, source: PointCloud, target: PointCloud, shape: str) -> Trial:
    """Return two scans that no transformation puts right as a trial."""
    return Trial(kind, source, target, None, pair_extent(source, target), 0.0, shape)
