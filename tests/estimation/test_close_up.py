"""What a close-up shows: what tells a right pose from a wrong one, whichever scan comes first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.estimation.conftest import make_problem
from utopic_cli.estimation.candidates import Candidate, weigh
from utopic_cli.estimation.close_up import NODES, POINT_FEATURES, WHOLE_FEATURES, CloseUp, close_ups
from utopic_cli.estimation.problem import Problem
from utopic_cli.estimation.solver import _weighted_candidates
from utopic_cli.geometry import rigid
from utopic_cli.point_cloud import PointCloud

Scans = tuple[PointCloud, PointCloud]
MEETS, BESIDE, ABSOLUTE, COSINE = 5, 6, 7, 8  # of the middle neighbourhood
EMPTY_SPACE, MATCHED = 19, 21


@pytest.fixture(scope="module")
def problem(scans: Scans, gt_transformation: np.ndarray) -> Problem:
    return make_problem(*scans, gt_transformation, wrong=0.3)


def seen(problem: Problem, *transformations: np.ndarray) -> list[CloseUp]:
    candidates = [Candidate(T, 0.5, 0.6, 0.1, "consensus") for T in transformations]
    correspondences = _weighted_candidates(problem)
    weighed = weigh(problem, candidates, correspondences, 0.1, *problem.surfaces)
    return close_ups(problem, weighed)


def test_a_right_pose_meets_and_a_turned_one_crosses(problem: Problem, gt_transformation: np.ndarray) -> None:
    turn = rigid.rigid(rigid.rotation_from_vector(np.array([0.0, 0.0, np.pi])), np.zeros(3))
    right, wrong = seen(problem, gt_transformation, gt_transformation @ turn)
    counts = [min(NODES, len(nodes)) for nodes in (problem.source_nodes, problem.target_nodes)]
    assert right.points.shape == (sum(counts), POINT_FEATURES) and right.whole.shape == (WHOLE_FEATURES,)
    assert np.isfinite(right.points).all() and np.isfinite(wrong.points).all()
    met = right.points[:, MEETS] > 0.9
    assert met.mean() > 0.3
    assert np.abs(right.points[met, BESIDE]).mean() < 0.1 and right.points[met, COSINE].mean() > 0.95
    crossed = wrong.points[:, MEETS] > 0.9
    assert wrong.points[crossed, ABSOLUTE].mean() > 5 * right.points[met, ABSOLUTE].mean()
    assert wrong.points[:, EMPTY_SPACE].sum() > right.points[:, EMPTY_SPACE].sum()
    assert right.points[:, MATCHED].mean() > wrong.points[:, MATCHED].mean() + 0.1


def test_the_sign_tells_a_shift_from_noise(problem: Problem, gt_transformation: np.ndarray) -> None:
    voxel = problem.surfaces[1].voxel
    along = gt_transformation.copy()
    along[:3, 3] += 0.5 * voxel * np.array([0.0, 0.0, 1.0])
    straight, shifted = seen(problem, gt_transformation, along)
    count = min(NODES, len(problem.source_nodes))
    upward = straight.points[:count, MEETS] > 0.9
    # Moved towards where the source's surface faces or away from it: all of a neighbourhood alike.
    signed, unsigned = (np.abs(shifted.points[:count][upward, i]).mean() for i in (BESIDE, ABSOLUTE))
    assert signed > 0.8 * unsigned > 0.05


def test_swapped_scans_are_seen_alike(problem: Problem, gt_transformation: np.ndarray) -> None:
    there = seen(problem, gt_transformation)[0]
    swapped = replace(
        problem,
        source_nodes=problem.target_nodes,
        target_nodes=problem.source_nodes,
        matching_scores=problem.matching_scores.T,
        source_overlap=problem.target_overlap,
        target_overlap=problem.source_overlap,
        source_certainty=problem.target_certainty,
        target_certainty=problem.source_certainty,
        source_dense=problem.target_dense,
        target_dense=problem.source_dense,
    )
    back = seen(swapped, rigid.invert(gt_transformation))[0]
    count = min(NODES, len(problem.source_nodes))
    again = np.roll(back.points, count, axis=0)
    np.testing.assert_allclose(again, there.points, rtol=0, atol=1e-4)


def test_what_was_not_weighed_can_t_be_seen(problem: Problem) -> None:
    with pytest.raises(ValueError, match="not weighed"):
        close_ups(problem, [Candidate(np.eye(4), 0.5, 0.6, 0.1, "consensus")])
