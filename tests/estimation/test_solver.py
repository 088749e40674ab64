from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.estimation.conftest import VOXEL, make_problem
from utopic_cli.estimation.candidates import Candidate
from utopic_cli.estimation.meeting import Meeting
from utopic_cli.estimation.prior import Prior
from utopic_cli.estimation.problem import Problem
from utopic_cli.estimation.solver import Estimate, solve
from utopic_cli.geometry import rigid
from utopic_cli.point_cloud import PointCloud

Scans = tuple[PointCloud, PointCloud]


@pytest.fixture(scope="module")
def hard_problem(scans: Scans, gt_transformation: np.ndarray) -> Problem:
    return make_problem(*scans, gt_transformation, wrong=0.85)


@pytest.fixture(scope="module")
def automatic(hard_problem: Problem) -> Estimate:
    return solve(hard_problem)


def assert_right(T: np.ndarray, gt: np.ndarray, degrees: float = 1.0, distance: float = VOXEL / 2) -> None:
    assert rigid.relative_rotation_error_deg(T, gt) < degrees
    assert rigid.relative_translation_error(T, gt) < distance
    assert rigid.is_rigid(T, 1e-9)


@pytest.mark.parametrize("solver", ["auto", "consensus"])
def test_solves_a_pair_with_mostly_wrong_scores(
    hard_problem: Problem, automatic: Estimate, gt_transformation: np.ndarray, solver: str
) -> None:
    estimate = automatic if solver == "auto" else solve(hard_problem, solver)
    assert_right(estimate.T_target_source, gt_transformation)
    assert estimate.score == pytest.approx(estimate.best.fit - estimate.best.violation)
    assert all(rival.score <= estimate.score for rival in estimate.rivals)
    assert 0 < estimate.support < 1
    pairs = estimate.correspondences
    moved = rigid.apply(estimate.T_target_source, hard_problem.source_nodes[pairs.source_indices])
    apart = np.linalg.norm(moved - hard_problem.target_nodes[pairs.target_indices], axis=1)
    assert len(pairs) > 3 and apart.max() <= 2.6 * VOXEL


def test_svd_is_the_papers_solver_and_nothing_more(scans: Scans, gt_transformation: np.ndarray) -> None:
    easy = make_problem(*scans, gt_transformation, wrong=0.0)
    estimate = solve(easy, "svd")
    assert estimate.method == "svd" and estimate.hypotheses == 1 and not estimate.rivals
    assert estimate.correspondences.weights.sum() == pytest.approx(1.0)
    assert_right(estimate.T_target_source, gt_transformation, degrees=25.0, distance=0.5)


def test_an_initial_transformation_decides_where_the_scores_say_nothing(
    hard_problem: Problem, gt_transformation: np.ndarray
) -> None:
    rng = np.random.default_rng(0)
    noise = replace(hard_problem, matching_scores=0.01 * rng.random(hard_problem.matching_scores.shape))
    turn = rigid.rigid(rigid.nearest_rotation(np.eye(3) + rng.normal(0, 0.03, (3, 3))), np.full(3, 0.01))
    estimate = solve(noise, "auto", Prior(gt_transformation @ turn))
    assert estimate.method == "initial"
    assert_right(estimate.T_target_source, gt_transformation)


def test_nothing_that_is_turned_farther_than_allowed_is_an_answer_or_a_rival(
    hard_problem: Problem, gt_transformation: np.ndarray
) -> None:
    angle = rigid.rotation_angle_deg(gt_transformation[:3, :3])
    found = solve(hard_problem, "auto", Prior(max_rotation=angle + 1.0))
    assert_right(found.T_target_source, gt_transformation)
    short = Prior(max_rotation=angle - 20.0)
    elsewhere = solve(hard_problem, "auto", short)
    tried = [elsewhere.best, *elsewhere.rivals]
    assert len(tried) > 1
    assert short.admits(np.stack([one.T_target_source for one in tried])).all()
    # Counted from where an initial transformation puts the source, it is near enough again.
    turn = rigid.rigid(rigid.rotation_from_vector(np.array([0.3, 0.0, 0.0])), np.zeros(3))
    near = Prior(turn @ gt_transformation, 25.0)
    assert_right(solve(hard_problem, "consensus", near).T_target_source, gt_transformation)


@pytest.mark.parametrize("solver", ["auto", "svd"])
def test_no_answer_where_none_is_allowed(hard_problem: Problem, solver: str) -> None:
    with pytest.raises(ValueError, match=r"0\.5 degrees at most"):
        solve(hard_problem, solver, Prior(max_rotation=0.5))


def test_an_assignment_without_a_rotation_leaves_the_others_to_answer(
    hard_problem: Problem, gt_transformation: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    def collinear(*_: np.ndarray) -> np.ndarray:
        raise ValueError("the correspondences lie on one line or point: no unique rotation")

    monkeypatch.setattr("utopic_cli.estimation.solver.weighted_procrustes", collinear)
    assert_right(solve(hard_problem).T_target_source, gt_transformation)
    with pytest.raises(ValueError, match="no transformation"):
        solve(hard_problem, "svd")


def test_same_input_same_bits(hard_problem: Problem, automatic: Estimate) -> None:
    first, second = automatic, solve(hard_problem)
    assert np.array_equal(first.T_target_source, second.T_target_source)
    assert first.score == second.score and len(first.rivals) == len(second.rivals)


def test_swapping_source_and_target_inverts(hard_problem: Problem, automatic: Estimate) -> None:
    p = hard_problem
    swapped = Problem(
        p.target_nodes,
        p.source_nodes,
        p.matching_scores.T,
        p.target_overlap,
        p.source_overlap,
        p.target_certainty,
        p.source_certainty,
        p.target_dense,
        p.source_dense,
        p.spacing,
    )
    there, back = automatic.T_target_source, solve(swapped).T_target_source
    assert_right(back @ there, np.eye(4), degrees=0.7)


def test_nothing_depends_on_the_unit(hard_problem: Problem, automatic: Estimate) -> None:
    p, scale = hard_problem, 1e3
    scaled = replace(
        p,
        source_nodes=p.source_nodes * scale,
        target_nodes=p.target_nodes * scale,
        source_dense=replace(p.source_dense, points=p.source_dense.points * scale),
        target_dense=replace(p.target_dense, points=p.target_dense.points * scale),
        spacing=p.spacing * scale,
    )
    one, other = automatic.T_target_source, solve(scaled).T_target_source
    assert np.abs(one[:3, :3] - other[:3, :3]).max() < 1e-3
    assert np.abs(one[:3, 3] * scale - other[:3, 3]).max() < 1e-3 * scale


def test_input_that_fits_no_problem_is_refused(hard_problem: Problem) -> None:
    with pytest.raises(ValueError, match="unknown solver"):
        solve(hard_problem, "ransac")
    with pytest.raises(ValueError, match="shape"):
        solve(replace(hard_problem, matching_scores=np.ones((3, 3))))
    with pytest.raises(ValueError, match="source_overlap"):
        solve(replace(hard_problem, source_overlap=np.ones(2)))
    with pytest.raises(ValueError, match="spacing"):
        solve(replace(hard_problem, spacing=0.0))
    with pytest.raises(ValueError, match="no transformation"):
        solve(replace(hard_problem, matching_scores=np.zeros_like(hard_problem.matching_scores)))


def test_standing_prefers_what_lies_closer_over_what_covers_more() -> None:
    def candidate(score: float, looseness: float, support: float, conflict: float = 0.0) -> Candidate:
        meeting = Meeting(0.5, 0.5, 0.8, 0.9, 0.08, looseness, 0.03, 0.0, conflict, 0.0)
        return Candidate(np.eye(4), score, score, 0.0, "consensus", support, meeting)

    # Half a turn off, a nearly symmetric thing covers more, but lies less close.
    turned, right = candidate(0.5, 0.25, 0.05), candidate(0.4, 0.15, 0.05)
    assert right.standing > turned.standing
    assert candidate(0.4, 0.15, 0.05).standing > candidate(0.4, 0.15, 0.02).standing
    flat, shaped = (replace(right.meeting, turning=value) for value in (0.0, 0.1))  # type: ignore[type-var]
    assert replace(right, meeting=shaped).standing > replace(right, meeting=flat).standing
    assert candidate(0.4, 0.15, 0.0).standing == candidate(0.4, 0.15, 1e-9).standing
    assert candidate(0.4, 0.15, 0.05, conflict=0.3).standing < turned.standing
    with pytest.raises(ValueError, match="weighed"):
        _ = replace(right, meeting=None).standing


def test_two_estimates_of_one_pair_are_joined(
    automatic: Estimate, gt_transformation: np.ndarray, scans: Scans
) -> None:
    points = scans[0].points
    nudge = rigid.rigid(rigid.rotation_from_vector(np.array([0.0, 0.005, 0.0])), np.zeros(3))
    turn = rigid.rigid(rigid.rotation_from_vector(np.array([0.0, 2.0, 0.0])), np.zeros(3))

    def answering(motion: np.ndarray) -> Estimate:
        T = automatic.T_target_source @ motion
        return replace(automatic, best=replace(automatic.best, T_target_source=T), rivals=())

    agreeing = automatic.with_rivals(answering(nudge), points)
    assert agreeing.margin == automatic.margin  # the same answer is no rival
    doubted = automatic.with_rivals(answering(turn), points)
    assert doubted.margin == 0.0 and len(doubted.rivals) >= 1
    np.testing.assert_array_equal(doubted.rivals[0].T_target_source, automatic.T_target_source @ turn)
    standings = [rival.standing for rival in doubted.rivals]
    assert standings == sorted(standings, reverse=True)


def test_a_rival_that_the_verifier_likes_little_less_lags_by_the_surfaces_alone(automatic: Estimate) -> None:
    def lag(preferred: float) -> float:
        rival = replace(automatic.best, plausibility=automatic.best.plausibility - preferred)
        return automatic.lag(rival)

    assert lag(2.0) == pytest.approx(0.0, abs=1e-9)  # the same surfaces
    assert lag(5.0) == pytest.approx(0.5)
    assert lag(-2.0) == pytest.approx(-0.2)
