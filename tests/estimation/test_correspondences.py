from __future__ import annotations

from collections.abc import Callable
from itertools import permutations

import numpy as np
import pytest

from utopic_cli.estimation.correspondences import (
    candidate_correspondences,
    linear_assignment,
    overlap_weights,
)
from utopic_cli.result import Correspondences


@pytest.mark.parametrize("shape", [(5, 5), (4, 6), (6, 3)])
def test_linear_assignment_is_the_best_of_all(shape: tuple[int, int]) -> None:
    scores = np.random.default_rng(shape[1]).random(shape)
    pairs = linear_assignment(scores, minimum_mass=0.0)
    wide = scores if shape[0] <= shape[1] else scores.T
    best = max(
        sum(wide[i, j] for i, j in enumerate(columns))
        for columns in permutations(range(wide.shape[1]), wide.shape[0])
    )
    assert pairs.weights.sum() == pytest.approx(best)
    assert len(set(pairs.source_indices)) == len(set(pairs.target_indices)) == min(shape)
    assert np.array_equal(pairs.weights, scores[pairs.source_indices, pairs.target_indices])


def test_linear_assignment_leaves_out_what_the_slack_took() -> None:
    scores = np.diag([0.9, 0.8, 0.3, 0.7])  # row and column 2 gave .7 of their mass to the slack
    pairs = linear_assignment(scores)
    assert pairs.source_indices.tolist() == pairs.target_indices.tolist() == [0, 1, 3]
    assert len(linear_assignment(np.full((3, 3), 0.01))) == 0


def test_overlap_weights_are_the_normalised_products() -> None:
    pairs = Correspondences(np.array([0, 2]), np.array([1, 0]), np.ones(2))
    weighted = overlap_weights(pairs, np.array([0.5, 0.9, 1.0]), np.array([0.2, 0.8]))
    assert weighted.weights == pytest.approx([0.4 / 0.6, 0.2 / 0.6])
    nothing = overlap_weights(pairs, np.zeros(3), np.array([0.2, 0.8]))
    assert np.array_equal(nothing.weights, [0.0, 0.0])


def test_candidates_are_the_best_of_rows_and_columns() -> None:
    scores = np.random.default_rng(2).random((30, 20))
    pairs = candidate_correspondences(scores, limit=10_000, per_point=2)
    expected = {(i, j) for i in range(30) for j in np.argsort(-scores[i])[:2]}
    expected |= {(i, j) for j in range(20) for i in np.argsort(-scores[:, j])[:2]}
    found = list(zip(pairs.source_indices.tolist(), pairs.target_indices.tolist(), strict=True))
    assert len(found) == len(expected) and set(found) == expected
    assert (np.diff(pairs.weights) <= 0).all()
    few = candidate_correspondences(scores, limit=7, per_point=2)
    assert np.array_equal(few.source_indices, pairs.source_indices[:7])


def test_candidates_leave_out_zero_scores() -> None:
    scores = np.zeros((4, 5))
    scores[1, 2] = 0.3
    pairs = candidate_correspondences(scores, per_point=9)
    assert pairs.source_indices.tolist() == [1] and pairs.target_indices.tolist() == [2]


@pytest.mark.parametrize("bad", [np.ones(3), np.ones((0, 4)), np.array([[np.nan]]), np.array([[-0.1]])])
@pytest.mark.parametrize("function", [linear_assignment, candidate_correspondences])
def test_scores_that_are_none_are_refused(
    function: Callable[[np.ndarray], Correspondences], bad: np.ndarray
) -> None:
    with pytest.raises(ValueError, match="matching scores"):
        function(bad)
