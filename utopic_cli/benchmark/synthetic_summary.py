"""Answers of one method taken together."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from utopic_cli.benchmark.answers import Answer
from utopic_cli.benchmark.pair_metrics import RECALLS, OverlapMeasures

CONFIDENCE = 1.959963984540054
"""Standard normal quantile of a 95 % interval."""


@dataclass(frozen=True)
class Share:
    """So many of so many, with the 95 % Wilson interval of the true share.

    Attributes:
        count: how many did.
        of: how many there were.
        share: ``count / of``.
        low: lower end of the interval.
        high: upper end.
    """

    count: int
    of: int
    share: float
    low: float
    high: float


def wilson(count: int, of: int) -> Share:
    """Return a share with its 95 % Wilson score interval.

    Raises:
        ValueError: of nothing.
    """
    if of < 1:
        raise ValueError("a share of nothing")
    share, z2 = count / of, CONFIDENCE**2 / of
    centre = (share + z2 / 2.0) / (1.0 + z2)
    half = np.sqrt(z2 * (share * (1.0 - share) + z2 / 4.0)) / (1.0 + z2)
    # At none and all of them the ends are exact; rounding must not put them a hair beyond.
    low = 0.0 if count == 0 else float(centre - half)
    high = 1.0 if count == of else float(centre + half)
    return Share(count, of, share, low, high)


@dataclass(frozen=True)
class OverlapSummary:
    """Means over the pairs; see ``pair_metrics.OverlapMeasures``."""

    accuracy: float
    precision: float | None
    recall: float | None
    accuracy_mutual: float


@dataclass(frozen=True)
class Summary:
    """One method at one stage on one group of pairs.

    Errors are over the pairs with an answer, shares over all of them.

    Attributes:
        pairs: how many.
        overlap: mean overlap ratio of their smaller side.
        without_answer: for how many of them no transformation was found.
        error_r: mean Error(R), degrees; None without an answer, as for all errors.
        error_r_median: its median.
        error_t: mean Error(t), the protocol's unit.
        error_t_median: its median.
        rmse_r: root of the mean squared xyz Euler angle differences, degrees.
        mae_r: mean of their absolute values.
        rmse_t: likewise of the translation along the axes.
        mae_t: likewise.
        fine: share within 1 degree and 0.02.
        success: share within 5 degrees and 0.05.
        symmetric_success: share within that, or in a place that the object's symmetry makes equal.
        floor_ratio_r: ``error_r`` over that of the statistical floor; None without one.
        floor_ratio_r_median: likewise of the medians, which single wild failures leave alone.
        floor_ratio_t: as ``floor_ratio_r``.
        hit_rate: mean share of overlapping source nodes with a right best match.
        inlier_ratio: mean share of right ones among the 250 surest matches.
        first_overlap: overlap as told without a transformation.
        final_overlap: overlap as told when shown the answer.
        cpu_seconds: mean CPU time by step.
    """

    pairs: int
    overlap: float
    without_answer: int
    error_r: float | None
    error_r_median: float | None
    error_t: float | None
    error_t_median: float | None
    rmse_r: float | None
    mae_r: float | None
    rmse_t: float | None
    mae_t: float | None
    fine: Share
    success: Share
    symmetric_success: Share
    floor_ratio_r: float | None
    floor_ratio_r_median: float | None
    floor_ratio_t: float | None
    hit_rate: float | None
    inlier_ratio: float | None
    first_overlap: OverlapSummary | None
    final_overlap: OverlapSummary | None
    cpu_seconds: dict[str, float]


def summarise(answers: Sequence[Answer], floor: Sequence[Answer] = ()) -> Summary:
    """Summarise the answers of one method at one stage.

    Args:
        answers: at least one.
        floor: the statistical floor's answers to the same pairs, if the protocol has one.

    Raises:
        ValueError: there is no answer to summarise.
    """
    poses = [answer.pose for answer in answers if answer.pose is not None]
    rotation = np.array([pose.rotation_deg for pose in poses])
    translation = np.array([pose.translation for pose in poses])
    euler = np.array([pose.euler_deg for pose in poses])
    axes = np.array([pose.axes for pose in poses])
    floor_poses = [answer.pose for answer in floor if answer.pose is not None]
    floor_rotation = np.array([pose.rotation_deg for pose in floor_poses])
    matches = [answer.matches for answer in answers if answer.matches is not None]
    steps = dict.fromkeys(step for answer in answers for step in answer.cpu_seconds)
    return Summary(
        pairs=len(answers),
        overlap=float(np.mean([answer.overlap for answer in answers])),
        without_answer=len(answers) - len(poses),
        error_r=_mean(rotation),
        error_r_median=_median(rotation),
        error_t=_mean(translation),
        error_t_median=_median(translation),
        rmse_r=_root_mean_square(euler),
        mae_r=_mean(euler),
        rmse_t=_root_mean_square(axes),
        mae_t=_mean(axes),
        fine=wilson(sum(pose.within(RECALLS[0]) for pose in poses), len(answers)),
        success=wilson(sum(pose.within(RECALLS[1]) for pose in poses), len(answers)),
        symmetric_success=wilson(sum(pose.symmetric for pose in poses), len(answers)),
        floor_ratio_r=_ratio(_mean(rotation), _mean(floor_rotation)),
        floor_ratio_r_median=_ratio(_median(rotation), _median(floor_rotation)),
        floor_ratio_t=_ratio(_mean(translation), _mean([pose.translation for pose in floor_poses])),
        hit_rate=_mean_of_known(one.hit_rate for one in matches),
        inlier_ratio=_mean_of_known(one.inlier_ratio for one in matches),
        first_overlap=_overlap([a.first_overlap for a in answers if a.first_overlap is not None]),
        final_overlap=_overlap([a.final_overlap for a in answers if a.final_overlap is not None]),
        cpu_seconds={
            step: float(np.mean([answer.cpu_seconds.get(step, 0.0) for answer in answers])) for step in steps
        },
    )


def _overlap(measures: list[OverlapMeasures]) -> OverlapSummary | None:
    if not measures:
        return None
    return OverlapSummary(
        float(np.mean([one.accuracy for one in measures])),
        _mean_of_known(one.precision for one in measures),
        _mean_of_known(one.recall for one in measures),
        float(np.mean([one.accuracy_mutual for one in measures])),
    )


def _mean(values: np.ndarray | list[float]) -> float | None:
    return float(np.mean(values)) if len(values) else None


def _median(values: np.ndarray) -> float | None:
    return float(np.median(values)) if len(values) else None


def _root_mean_square(values: np.ndarray) -> float | None:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else None


def _mean_of_known(values: Iterable[float | None]) -> float | None:
    return _mean([value for value in values if value is not None])


def _ratio(value: float | None, floor: float | None) -> float | None:
    return None if value is None or not floor else value / floor
