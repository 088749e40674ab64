"""What the signals say of right and wrong answers whose facts are known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tests.estimation.conftest import VOXEL, lumpy_surface, make_problem, view
from utopic_cli.estimation.evidence import (
    MOST_MARGIN,
    NO_CONFLICT,
    NO_MARGIN,
    NO_OVERLAP,
    SAME,
    Evidence,
    Seen,
    collect_evidence,
)
from utopic_cli.estimation.meeting import MEETING, MOST_ALIKE, meet
from utopic_cli.estimation.observability import find_twists
from utopic_cli.estimation.solver import Estimate, solve
from utopic_cli.estimation.surface import Surface, make_surface
from utopic_cli.estimation.verification import measure_fit
from utopic_cli.geometry import rigid
from utopic_cli.point_cloud import PointCloud

Scans = tuple[PointCloud, PointCloud]


@pytest.fixture(scope="module")
def surfaces(scans: Scans) -> tuple[Surface, Surface]:
    return make_surface(scans[0], VOXEL), make_surface(scans[1], VOXEL)


def test_surfaces_that_coincide_are_alike_and_do_not_conflict(
    surfaces: tuple[Surface, Surface], gt_transformation: np.ndarray
) -> None:
    right = meet(*surfaces, gt_transformation)
    assert right.likeness > 0.8 and right.conflict < 0.02 and right.turning < 0.02
    # Short of 1: a strip along the border meets the other scan and has nothing to lie on.
    # Two views 70 degrees apart share a bit more than half of what they see.
    assert 0.4 < right.source_share < 0.9


def test_a_wrong_transformation_meets_without_agreeing(
    surfaces: tuple[Surface, Surface], gt_transformation: np.ndarray
) -> None:
    right = meet(*surfaces, gt_transformation)
    turn = rigid.rigid(rigid.rotation_from_vector(np.array([0.0, 0.6, 0.0])), np.zeros(3))
    wrong = meet(*surfaces, gt_transformation @ turn)
    assert wrong.likeness < 0.6 * right.likeness
    assert wrong.looseness > 3.0 * right.looseness


def test_scans_out_of_each_others_reach_do_not_meet(surfaces: tuple[Surface, Surface]) -> None:
    far = meet(*surfaces, rigid.rigid(np.eye(3), np.array([100.0, 0.0, 0.0])))
    assert (far.source_share, far.target_share, far.agreement, far.likeness) == (0, 0, 0, 0)
    assert far.turning == 1.0 and far.looseness == MEETING


def test_swapping_the_scans_swaps_the_shares_alone(
    surfaces: tuple[Surface, Surface], gt_transformation: np.ndarray
) -> None:
    there = meet(*surfaces, gt_transformation)
    back = meet(surfaces[1], surfaces[0], rigid.invert(gt_transformation))
    assert back.source_share == there.target_share and back.target_share == there.source_share
    names = ("agreement", "likeness", "tightness", "looseness", "turning", "violation", "contradiction")
    for name in names:
        assert getattr(back, name) == pytest.approx(getattr(there, name)), name


def test_where_one_scan_was_taken_from_the_other_side_there_is_conflict_but_no_contradiction(
    surfaces: tuple[Surface, Surface], gt_transformation: np.ndarray
) -> None:
    """Normals inside out put the scanner behind the surface: a wrong guess, and seen in one way only."""
    source, target = surfaces
    inside_out = dataclasses.replace(source, normals=-source.normals)
    guessed = meet(inside_out, target, gt_transformation)
    assert guessed.conflict > 0.1 and guessed.contradiction < 0.01
    turn = rigid.rigid(rigid.rotation_from_vector(np.array([1.0, 0.0, 0.0])), np.zeros(3))
    wrong = meet(source, target, gt_transformation @ turn)
    assert wrong.contradiction > 0.08
    assert wrong.contradiction <= wrong.conflict


def test_likeness_forgives_roughness_that_agreement_does_not(gt_transformation: np.ndarray) -> None:
    rng = np.random.default_rng(0)

    def rough(cloud: PointCloud) -> PointCloud:
        noise = rng.normal(0.0, 0.35 * VOXEL, (len(cloud), 1)) * cloud.normals
        return PointCloud(cloud.points + noise, cloud.normals)

    source = make_surface(rough(view(lumpy_surface(5000, 0.0), (1.0, 0.0, 0.0))), VOXEL)
    target = rough(view(lumpy_surface(5000, 0.43), (0.34, 0.94, 0.0))).transformed(gt_transformation)
    met = meet(source, make_surface(target, VOXEL), gt_transformation)
    assert met.agreement < 0.65 and 0.85 < met.likeness <= MOST_ALIKE


def test_excess_is_low_where_scans_lie_as_close_as_their_own_points(
    answered: tuple[Estimate, Evidence], scans: Scans, gt_transformation: np.ndarray
) -> None:
    problem = make_problem(*scans, gt_transformation, wrong=0.5)
    estimate = answered[0]
    shifted = gt_transformation.copy()
    shifted[:3, 3] += 0.25 * VOXEL
    right, off = (
        evidence_of(
            problem,
            scans,
            dataclasses.replace(estimate, best=dataclasses.replace(estimate.best, T_target_source=T)),
        )
        for T in (gt_transformation, shifted)
    )
    assert right.excess < 0.15 and off.excess > right.excess + 0.2


@pytest.fixture(scope="module")
def answered(scans: Scans, gt_transformation: np.ndarray) -> tuple[Estimate, Evidence]:
    problem = make_problem(*scans, gt_transformation, wrong=0.5)
    estimate = solve(problem)
    return estimate, evidence_of(problem, scans, estimate)


def evidence_of(problem, scans: Scans, estimate: Estimate) -> Evidence:  # type: ignore[no-untyped-def]
    source, target = (make_surface(cloud, VOXEL) for cloud in scans)
    T = estimate.T_target_source
    seen = Seen(
        problem.source_nodes,
        problem.target_nodes,
        np.concatenate([problem.source_overlap, problem.target_overlap]),
        np.full(len(problem.source_nodes) + len(problem.target_nodes), 0.02),
    )
    fit = measure_fit(*scans, T, 3 * VOXEL, estimate.support)
    return collect_evidence(source, target, T, estimate, seen, fit, find_twists(source, target, T), SAME)


def test_every_signal_of_a_right_answer_is_finite_and_good(answered: tuple[Estimate, Evidence]) -> None:
    estimate, evidence = answered
    assert all(np.isfinite(value) for value in evidence.as_dict().values())
    assert evidence.score == estimate.score
    assert 10.0**evidence.margin > 0.1 and evidence.alone == 0.0 and evidence.support_lead > 0.3
    assert 0.3 < 10.0**evidence.overlap < 1.0
    assert 10.0**evidence.support == pytest.approx(estimate.support)
    assert evidence.conflict == pytest.approx(np.log10(NO_CONFLICT)) and evidence.completeness == 0.0
    assert evidence.seen_contrast > 0.2 and evidence.uncertainty == pytest.approx(0.02)
    assert evidence.fixed > -2.5 and evidence.stiffness > 0.1 and evidence.spread == SAME


def test_a_rival_as_good_as_the_answer_takes_the_margin_away(
    answered: tuple[Estimate, Evidence], scans: Scans, gt_transformation: np.ndarray
) -> None:
    estimate, _ = answered
    twin = dataclasses.replace(
        estimate.rivals[0],
        T_target_source=estimate.T_target_source,
        score=estimate.score,
        support=estimate.support,
        meeting=estimate.best.meeting,
    )
    problem = make_problem(*scans, gt_transformation, wrong=0.5)
    doubtful = evidence_of(problem, scans, dataclasses.replace(estimate, rivals=(twin,)))
    assert doubtful.margin == pytest.approx(np.log10(NO_MARGIN))
    assert doubtful.support_lead == pytest.approx(0.0)


def test_no_rival_at_all_is_the_clearest_margin_and_said(
    answered: tuple[Estimate, Evidence], scans: Scans, gt_transformation: np.ndarray
) -> None:
    problem = make_problem(*scans, gt_transformation, wrong=0.5)
    alone = evidence_of(problem, scans, dataclasses.replace(answered[0], rivals=()))
    assert alone.margin == pytest.approx(np.log10(MOST_MARGIN + NO_MARGIN)) and alone.alone == 1.0
    assert alone.margin >= answered[1].margin


def test_where_nothing_meets_the_signals_are_finite_all_the_same(
    answered: tuple[Estimate, Evidence], scans: Scans, gt_transformation: np.ndarray
) -> None:
    problem = make_problem(*scans, gt_transformation, wrong=0.5)
    source, target = (make_surface(cloud, VOXEL) for cloud in scans)
    far = rigid.rigid(np.eye(3), np.array([100.0, 0.0, 0.0]))
    seen = Seen(
        problem.source_nodes,
        problem.target_nodes,
        np.concatenate([problem.source_overlap, problem.target_overlap]),
        np.full(len(problem.source_nodes) + len(problem.target_nodes), 0.02),
    )
    fit = measure_fit(*scans, far, 3 * VOXEL, 0.0)
    evidence = collect_evidence(source, target, far, answered[0], seen, fit, None, 0.0)
    assert all(np.isfinite(value) for value in evidence.as_dict().values())
    assert evidence.seen_overlap == 0.0 and evidence.fixed == -5.0
    assert evidence.overlap == pytest.approx(np.log10(NO_OVERLAP))
    assert evidence.stiffness == 0.0
