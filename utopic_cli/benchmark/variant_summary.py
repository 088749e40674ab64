"""Variants taken together: figures with standard errors, and what tells a variant from the full network."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from utopic_cli.benchmark.pair_metrics import RECALLS, PoseMeasures
from utopic_cli.benchmark.paired import (
    Difference,
    Figure,
    mean_figure,
    paired_difference,
    root_mean_square_figure,
)
from utopic_cli.benchmark.synthetic_summary import Share, wilson
from utopic_cli.benchmark.variant_pairs import PairResult

LEVEL = 0.05

PoseValue = Callable[[PoseMeasures], float]


@dataclass(frozen=True)
class PoseSummary:
    """One solve of one variant. Errors are over the pairs with an answer, shares over all of them.

    Attributes:
        rmse_r: root of the mean squared xyz Euler angle differences, degrees; None without an answer,
            as for all errors.
        mae_r: mean of their absolute values.
        rmse_t: likewise of the translation along the axes, radii of the object.
        mae_t: likewise.
        error_r: mean Error(R), degrees.
        error_r_median: its median.
        error_t: mean Error(t), radii.
        fine: share within 1 degree and 0.02.
        success: share within 5 degrees and 0.05.
        without_answer: for how many pairs no transformation was found.
    """

    rmse_r: Figure | None
    mae_r: Figure | None
    rmse_t: Figure | None
    mae_t: Figure | None
    error_r: Figure | None
    error_r_median: float | None
    error_t: Figure | None
    fine: Share
    success: Share
    without_answer: int


def summarise_poses(poses: Sequence[PoseMeasures | None]) -> PoseSummary:
    """Summarise one solve.

    Raises:
        ValueError: there is no pair.
    """

    def values(of: PoseValue) -> list[float | None]:
        return [None if pose is None else of(pose) for pose in poses]

    angles = [pose.rotation_deg for pose in poses if pose is not None]
    return PoseSummary(
        rmse_r=root_mean_square_figure(values(lambda pose: float(np.mean(np.square(pose.euler_deg))))),
        mae_r=mean_figure(values(lambda pose: float(np.mean(pose.euler_deg)))),
        rmse_t=root_mean_square_figure(values(lambda pose: float(np.mean(np.square(pose.axes))))),
        mae_t=mean_figure(values(lambda pose: float(np.mean(pose.axes)))),
        error_r=mean_figure(values(lambda pose: pose.rotation_deg)),
        error_r_median=float(np.median(angles)) if angles else None,
        error_t=mean_figure(values(lambda pose: pose.translation)),
        fine=_share_within(poses, RECALLS[0]),
        success=_share_within(poses, RECALLS[1]),
        without_answer=len(poses) - len(angles),
    )


@dataclass(frozen=True)
class Measure:
    """Something that two variants are compared by, pair by pair.

    Attributes:
        name: key in the JSON.
        heading: of the column.
        of: its value on one pair; None if there is none.
        form: how a figure is written.
        change: how a difference is written.
        more_is_better: whether a larger value is the better one.
    """

    name: str
    heading: str
    of: Callable[[PairResult], float | None]
    form: str = "{:.3f}"
    change: str = "{:+.3f}"
    more_is_better: bool = True

    def values(self, results: Sequence[PairResult]) -> list[float | None]:
        """Return its value on every pair."""
        return [self.of(result) for result in results]


def _share_within(poses: Sequence[PoseMeasures | None], bounds: tuple[float, float]) -> Share:
    return wilson(round(sum(_within(pose, bounds) for pose in poses)), len(poses))


def _within(pose: PoseMeasures | None, bounds: tuple[float, float]) -> float:
    return float(pose is not None and pose.within(bounds))


def _angle(result: PairResult, solver: str) -> float | None:
    pose = result.poses[solver]
    return None if pose is None else pose.rotation_deg


MEASURES = (
    Measure(
        "overlap_accuracy",
        "overlap\naccuracy",
        lambda result: None if result.overlap is None else result.overlap.accuracy,
    ),
    Measure("hit_rate", "hit rate", lambda result: result.matches.hit_rate),
    Measure("inlier_ratio", "inliers of\nsurest 250", lambda result: result.matches.inlier_ratio),
    Measure(
        "error_r_svd",
        "Error(R), deg\nthe paper's solve",
        lambda result: _angle(result, "svd"),
        "{:.2f}",
        "{:+.2f}",
        False,
    ),
    Measure(
        "error_r_auto",
        "Error(R), deg\nrobust solve",
        lambda result: _angle(result, "auto"),
        "{:.2f}",
        "{:+.2f}",
        False,
    ),
    Measure(
        "success_auto",
        "5 deg, .05\nrobust solve",
        lambda result: _within(result.poses["auto"], RECALLS[1]),
    ),
)
"""What variants are compared by."""


def compare(results: Sequence[PairResult], full: Sequence[PairResult]) -> dict[str, Difference | None]:
    """Compare a variant with the full network on the same pairs, by the names of ``MEASURES``.

    Raises:
        ValueError: the results are not of the same pairs.
    """
    if [result.pair for result in results] != [result.pair for result in full]:
        raise ValueError("the results are not of the same pairs")
    return {one.name: paired_difference(one.values(results), one.values(full)) for one in MEASURES}


def told_apart(difference: Difference | None, control: Difference | None, comparisons: int) -> bool:
    """Tell whether a difference is more than chance.

    Args:
        difference: of a variant from the full network.
        control: of the full network, trained with another seed, from itself.
        comparisons: made in all; of many, some look large by chance.

    Returns:
        Whether chance among the pairs would make so large a difference in fewer than 5 % of all such
        tables (Bonferroni), and it is larger than the one that another seed makes. Without a control
        nothing is told apart.
    """
    if difference is None or control is None:
        return False
    return comparisons * difference.p_value < LEVEL and abs(difference.value) > abs(control.value)
