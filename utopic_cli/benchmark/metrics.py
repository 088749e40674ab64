"""How far an estimate is from the known answer, and how often it is near enough."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from utopic_cli.geometry.rigid import relative_rotation_error_deg, relative_translation_error
from utopic_cli.point_cloud import PointCloud

MAX_RRE_DEG = 5.0
MAX_RTE_SHARE = 0.05

# Overlap of the smaller side: at least the first number, less than the second.
OVERLAP_BANDS = ((0.5, np.inf), (0.3, 0.5), (0.1, 0.3), (-np.inf, 0.1))


@dataclass(frozen=True)
class PoseError:
    """Distance of an estimated transformation from the known one.

    Attributes:
        rre_deg: angle between the two rotations, degrees in [0, 180].
        rte: how far apart the two put the source's centroid, in the points' units.
        rte_share: ``rte`` as a share of the pair's extent.
    """

    rre_deg: float
    rte: float
    rte_share: float

    @property
    def success(self) -> bool:
        """Under 5 degrees and under 5 % of the extent, both strictly."""
        return self.rre_deg < MAX_RRE_DEG and self.rte_share < MAX_RTE_SHARE


def pose_error(
    transformation: np.ndarray, gt_transformation: np.ndarray, source_centroid: np.ndarray, extent: float
) -> PoseError:
    """Compare a (4, 4) estimate with the known answer.

    Args:
        transformation: (4, 4) estimated T_target_source.
        gt_transformation: (4, 4) known T_target_source.
        source_centroid: (3,) mean of the source's points, in the frame both matrices start
            from. Translations compared anywhere else would count the rotation error again.
        extent: the pair's extent, same units.
    """
    rte = relative_translation_error(transformation, gt_transformation, source_centroid)
    return PoseError(relative_rotation_error_deg(transformation, gt_transformation), rte, rte / extent)


def pair_extent(source: PointCloud, target: PointCloud) -> float:
    """Return the diagonal of the bounding box of the larger of two clouds, as they lie in their files."""
    return max(float(np.linalg.norm(np.ptp(cloud.points, axis=0))) for cloud in (source, target))


def overlap_band(overlap: float) -> str:
    """Name the band a smaller-side overlap ratio falls in, e.g. ``0.3-0.5``."""
    for low, high in OVERLAP_BANDS:
        if low <= overlap < high:
            return band_name(low, high)
    raise ValueError(f"overlap {overlap} is not a number")


def band_name(low: float, high: float) -> str:
    """Name the band from ``low`` to less than ``high``."""
    if np.isinf(high):
        return f">= {low:g}"
    return f"< {high:g}" if np.isinf(low) else f"{low:g}-{high:g}"


@dataclass(frozen=True)
class Summary:
    """Attempts of one method taken together.

    Medians are over attempts; one that gave no transformation counts as infinitely wrong.

    Attributes:
        attempts: how many there were.
        successes: how many ended within both bounds.
        median_rre_deg_of_successes: degrees; None without a success.
        median_rre_deg: degrees, over all attempts; None if the median gave no transformation.
        median_rte_share_of_successes: share of the extent; None without a success.
        median_rte_share: share of the extent, over all attempts; None likewise.
        mean_seconds: wall time, over all attempts.
        mean_cpu_seconds: CPU time of all threads and processes, over all attempts.
    """

    attempts: int
    successes: int
    median_rre_deg_of_successes: float | None
    median_rre_deg: float | None
    median_rte_share_of_successes: float | None
    median_rte_share: float | None
    mean_seconds: float
    mean_cpu_seconds: float

    @property
    def success_rate(self) -> float:
        """Successes over attempts."""
        return self.successes / self.attempts


def summarise(
    errors: Sequence[PoseError | None], seconds: Sequence[float], cpu_seconds: Sequence[float]
) -> Summary:
    """Summarise at least one attempt.

    Args:
        errors: one an attempt; None where the method gave no transformation.
        seconds: wall time of each.
        cpu_seconds: CPU time of each.

    Raises:
        ValueError: there is no attempt.
    """
    if not errors:
        raise ValueError("nothing to summarise")
    right = [error for error in errors if error is not None and error.success]
    return Summary(
        attempts=len(errors),
        successes=len(right),
        median_rre_deg_of_successes=_median([error.rre_deg for error in right]),
        median_rre_deg=_median([np.inf if error is None else error.rre_deg for error in errors]),
        median_rte_share_of_successes=_median([error.rte_share for error in right]),
        median_rte_share=_median([np.inf if error is None else error.rte_share for error in errors]),
        mean_seconds=float(np.mean(seconds)),
        mean_cpu_seconds=float(np.mean(cpu_seconds)),
    )


def _median(values: list[float]) -> float | None:
    if not values:
        return None
    ordered = np.sort(values)
    # The mean of a finite and an infinite middle value is infinite, as it should be.
    middle = float((ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2.0)
    return middle if np.isfinite(middle) else None
