"""Point pairs read off the network's soft matching scores."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from utopic_cli.result import Correspondences


def linear_assignment(matching_scores: np.ndarray, minimum_mass: float = 0.5) -> Correspondences:
    """Turn soft scores into one-to-one correspondences (the paper's LAP, Overlap-guided Registration).

    Only rows and columns whose soft mass (their sum, slack left out) exceeds
    ``minimum_mass`` take part: a point that gave most of its mass to the slack variable has
    no partner, and assigning it one all the same would feed an outlier to Procrustes.

    Args:
        matching_scores: (N, M) float64 in [0, 1], Sinkhorn output without slack.
        minimum_mass: smallest row or column sum that takes part.

    Returns:
        Correspondences in order of source index, weights = the scores of the pairs. Empty
        if no row or no column has mass enough. Pairs with score 0 are left out.

    Raises:
        ValueError: the scores are not a finite matrix without negative entries.
    """
    scores = _checked(matching_scores)
    rows = np.flatnonzero(scores.sum(axis=1) > minimum_mass)
    columns = np.flatnonzero(scores.sum(axis=0) > minimum_mass)
    chosen_rows, chosen_columns = linear_sum_assignment(scores[np.ix_(rows, columns)], maximize=True)
    source_indices, target_indices = rows[chosen_rows], columns[chosen_columns]
    weights = scores[source_indices, target_indices]
    real = weights > 0
    return Correspondences(source_indices[real], target_indices[real], weights[real])


def overlap_weights(
    correspondences: Correspondences, source_overlap: np.ndarray, target_overlap: np.ndarray
) -> Correspondences:
    """Weight each correspondence by the overlap of both ends: the paper's w_ij.

    w_ij = o_i o_j / sum of the same over all correspondences.

    Args:
        correspondences: K pairs.
        source_overlap: (N,) in [0, 1].
        target_overlap: (M,) in [0, 1].

    Returns:
        The same pairs, weights summing to 1 (all zero if every product is).
    """
    product = (
        source_overlap[correspondences.source_indices] * target_overlap[correspondences.target_indices]
    ).astype(np.float64)
    total = product.sum()
    weights = product / total if total > 0 else product
    return Correspondences(correspondences.source_indices, correspondences.target_indices, weights)


def candidate_correspondences(
    matching_scores: np.ndarray, limit: int = 2000, per_point: int = 3
) -> Correspondences:
    """Collect the pairs that are among the best few of their row or of their column.

    A right partner is often only the second or third choice; keeping several leaves the
    decision to geometry. Pairs may share points.

    Args:
        matching_scores: (N, M) float64, not negative.
        limit: most pairs returned, the highest scores first.
        per_point: how many pairs each row and each column may propose.

    Returns:
        Correspondences sorted by falling score (ties by position, so the order is
        deterministic), weights = the scores. Pairs with score 0 are left out.

    Raises:
        ValueError: the scores are not a finite matrix without negative entries.
    """
    scores = _checked(matching_scores)
    proposed = np.zeros(scores.shape, dtype=bool)
    for matrix, mark in ((scores, proposed), (np.ascontiguousarray(scores.T), proposed.T)):
        remaining = matrix.copy()
        each = np.arange(len(matrix))
        for _ in range(min(per_point, matrix.shape[1])):
            best = remaining.argmax(axis=1)
            mark[each, best] = True
            remaining[each, best] = -1.0
    source_indices, target_indices = np.nonzero(proposed & (scores > 0))
    weights = scores[source_indices, target_indices]
    order = np.argsort(-weights, kind="stable")[:limit]
    return Correspondences(source_indices[order], target_indices[order], weights[order])


def _checked(matching_scores: np.ndarray) -> np.ndarray:
    scores = np.asarray(matching_scores, dtype=np.float64)
    if scores.ndim != 2 or 0 in scores.shape:
        raise ValueError(f"matching scores of shape {scores.shape}; expected (N, M)")
    if not (np.isfinite(scores).all() and scores.min() >= 0):
        raise ValueError("matching scores must be finite and not negative")
    return scores
