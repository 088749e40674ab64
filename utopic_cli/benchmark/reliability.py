"""What a confidence is worth: does it rank, does it mean what it says, what does a threshold let through.

All on arrays: ``confidence`` (N,) in [0, 1], and ``right`` (N,) bool, whether the answer was right.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from utopic_cli.benchmark.synthetic_summary import Share, wilson
from utopic_cli.benchmark.uncertainty import area_under_curve

BINS = 10


def auroc(confidence: np.ndarray, right: np.ndarray) -> float | None:
    """Probability that a right answer is given more confidence than a wrong one, ties counting half.

    Returns:
        In [0, 1]; None unless there are right and wrong answers.

    Raises:
        ValueError: the arrays don't fit (as for all functions here).
    """
    confidence, right = _checked(confidence, right)
    return area_under_curve(confidence[right], confidence[~right])


def brier(confidence: np.ndarray, right: np.ndarray) -> float:
    """Mean squared difference between confidence and truth (1 right, 0 wrong): 0 is perfect."""
    confidence, right = _checked(confidence, right)
    return float(np.mean(np.square(confidence - right)))


@dataclass(frozen=True)
class Bin:
    """Answers of like confidence.

    Attributes:
        low: least confidence of the bin.
        high: its upper end, which belongs to the next bin (but 1 to the last).
        count: how many answers fell in.
        confidence: their mean confidence; None if there are none.
        right: share of them that is right; None likewise.
    """

    low: float
    high: float
    count: int
    confidence: float | None
    right: Share | None


def reliability_bins(confidence: np.ndarray, right: np.ndarray, bins: int = BINS) -> tuple[Bin, ...]:
    """Sort answers into bins of equal width over [0, 1]."""
    confidence, right = _checked(confidence, right)
    edges = np.linspace(0.0, 1.0, bins + 1)
    place = np.searchsorted(edges[1:-1], confidence, side="right")
    found = []
    for number in range(bins):
        inside = place == number
        count = int(inside.sum())
        found.append(
            Bin(
                float(edges[number]),
                float(edges[number + 1]),
                count,
                float(confidence[inside].mean()) if count else None,
                wilson(int(right[inside].sum()), count) if count else None,
            )
        )
    return tuple(found)


def expected_calibration_error(confidence: np.ndarray, right: np.ndarray, bins: int = BINS) -> float:
    """Mean distance between what is claimed and what is true, over bins of equal width.

    Each bin's difference between mean confidence and share of right answers counts by its number
    of answers.
    """
    apart = [
        one.count * abs(one.confidence - one.right.share)
        for one in reliability_bins(confidence, right, bins)
        if one.confidence is not None and one.right is not None
    ]
    return float(sum(apart) / len(right))


@dataclass(frozen=True)
class RiskCoverage:
    """What each threshold lets through; the arrays (K,) go from the strictest threshold down.

    Attributes:
        threshold: every confidence that occurs, descending; answers of at least that are accepted.
        coverage: share of all answers that is accepted.
        risk: share of the accepted that is wrong.
        recall: share of the right ones that is accepted; 0 where none is right.
    """

    threshold: np.ndarray
    coverage: np.ndarray
    risk: np.ndarray
    recall: np.ndarray


def risk_coverage(confidence: np.ndarray, right: np.ndarray) -> RiskCoverage:
    """Move the threshold over all confidences; answers of one confidence are accepted together."""
    confidence, right = _checked(confidence, right)
    order = np.argsort(-confidence, kind="stable")
    ordered = confidence[order]
    last = np.append(np.flatnonzero(np.diff(ordered)), len(ordered) - 1)  # of each run of equals
    accepted = last + 1
    hits = np.cumsum(right[order])[last]
    return RiskCoverage(
        ordered[last], accepted / len(ordered), 1.0 - hits / accepted, hits / max(1, int(right.sum()))
    )


@dataclass(frozen=True)
class Accepted:
    """What a rule of acceptance lets through, with 95 % Wilson intervals.

    Attributes:
        coverage: accepted ones of all answers.
        right: accepted ones of the right answers; None if no answer is right.
        wrong: wrong ones of the accepted answers; None if none is accepted.
    """

    coverage: Share
    right: Share | None
    wrong: Share | None


def accepted_at(confidence: np.ndarray, right: np.ndarray, threshold: float) -> Accepted:
    """Accept answers with at least a confidence."""
    return accepted_where(np.asarray(confidence) >= threshold, right)


def accepted_where(accepted: np.ndarray, right: np.ndarray) -> Accepted:
    """Judge a given choice (N,) bool."""
    accepted, right = np.asarray(accepted, dtype=bool), np.asarray(right, dtype=bool)
    both = int((accepted & right).sum())
    count, answers = int(accepted.sum()), int(right.sum())
    return Accepted(
        wilson(count, len(right)),
        wilson(both, answers) if answers else None,
        wilson(count - both, count) if count else None,
    )


def threshold_for(confidence: np.ndarray, right: np.ndarray, most_risk: float) -> float | None:
    """Return the lowest threshold at which at most a share of the accepted is wrong; None if no one does."""
    curve = risk_coverage(confidence, right)
    good = np.flatnonzero(curve.risk <= most_risk)
    return float(curve.threshold[good[-1]]) if len(good) else None


def _checked(confidence: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    confidence, right = np.asarray(confidence, dtype=np.float64), np.asarray(right, dtype=bool)
    if confidence.ndim != 1 or confidence.shape != right.shape or not len(confidence):
        raise ValueError(f"confidence {confidence.shape} and right {right.shape} must be (N,) alike, N > 0")
    if not ((confidence >= 0.0) & (confidence <= 1.0)).all():
        raise ValueError("a confidence lies outside [0, 1]")
    return confidence, right
