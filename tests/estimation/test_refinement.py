from __future__ import annotations

import numpy as np
import pytest

from tests.estimation.conftest import VOXEL
from utopic_cli.estimation.refinement import Stage, refine, refine_coarse
from utopic_cli.estimation.surface import make_surface
from utopic_cli.geometry import rigid
from utopic_cli.point_cloud import PointCloud

Scans = tuple[PointCloud, PointCloud]


def perturbed(gt: np.ndarray, degrees: float, shift: float, centre: np.ndarray) -> np.ndarray:
    """Turn a transformation about the moved centre and shift it."""
    angle = np.radians(degrees)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    moved = rigid.apply(gt, centre)
    return rigid.rigid(turn, moved - turn @ moved + np.array([0.0, shift, 0.0])) @ gt


def test_coarse_refinement_pulls_many_hypotheses_in(scans: Scans, gt_transformation: np.ndarray) -> None:
    source, target = (make_surface(scan, VOXEL) for scan in scans)
    centre = scans[0].points.mean(axis=0)
    starts = np.stack(
        [perturbed(gt_transformation, degrees, 0.05, centre) for degrees in (-8.0, -3.0, 0.0, 5.0, 10.0)]
    )
    refined = refine_coarse(source, target, starts, (Stage(5, 8, 250), Stage(3, 8, 500), Stage(1.2, 8, 1000)))
    for T in refined:
        assert rigid.relative_rotation_error_deg(T, gt_transformation) < 0.7
        assert rigid.relative_translation_error(T, gt_transformation, centre) < 0.2 * VOXEL
        assert rigid.is_rigid(T)


def test_coarse_refinement_leaves_hypotheses_without_partners_alone(
    scans: Scans,
) -> None:
    source, target = (make_surface(scan, VOXEL) for scan in scans)
    far = rigid.rigid(np.eye(3), np.array([100.0, 0.0, 0.0]))
    assert np.array_equal(refine_coarse(source, target, far[None], (Stage(5, 4, 250),))[0], far)


@pytest.mark.parametrize("scale", [1.0, 1000.0])
def test_refine_improves_a_perturbed_transformation(
    scans: Scans, gt_transformation: np.ndarray, scale: float
) -> None:
    source, target = (PointCloud(scan.points * scale) for scan in scans)
    gt = rigid.rigid(gt_transformation[:3, :3], gt_transformation[:3, 3] * scale)
    centre = source.points.mean(axis=0)
    start = perturbed(gt, 2.0, 0.02 * scale, centre)
    result = refine(source, target, start, radius=0.06 * scale)
    assert result.improved and result.residual < 0.9 * result.initial_residual
    assert rigid.relative_rotation_error_deg(result.T_target_source, gt) < 0.3
    assert rigid.relative_translation_error(result.T_target_source, gt, centre) < 0.004 * scale
    assert rigid.is_rigid(result.T_target_source, 1e-12)


def test_refine_keeps_the_transformation_where_nothing_meets(scans: Scans) -> None:
    source, target = scans
    far = rigid.rigid(np.eye(3), np.array([50.0, 0.0, 0.0]))
    result = refine(source, target, far)
    assert not result.improved
    assert np.array_equal(result.T_target_source, far)
    assert result.residual == result.initial_residual == pytest.approx(result.threshold)


def test_refine_keeps_a_perfect_transformation(gt_transformation: np.ndarray, scans: Scans) -> None:
    source, _ = scans
    result = refine(source, source.transformed(gt_transformation), gt_transformation)
    assert np.abs(result.T_target_source - gt_transformation).max() < 1e-9


def test_refine_never_raises_the_residual_on_noise() -> None:
    rng = np.random.default_rng(0)
    for _ in range(3):
        source, target = PointCloud(rng.normal(size=(300, 3))), PointCloud(rng.normal(size=(300, 3)))
        result = refine(source, target, np.eye(4))
        assert result.residual <= result.initial_residual
        assert rigid.is_rigid(result.T_target_source)


def test_refine_thins_large_scans(scans: Scans, gt_transformation: np.ndarray) -> None:
    source, target = scans
    centre = source.points.mean(axis=0)
    start = perturbed(gt_transformation, 1.5, 0.01, centre)
    result = refine(source, target, start, radius=0.06, limit=1500)
    assert rigid.relative_rotation_error_deg(result.T_target_source, gt_transformation) < 0.5


def test_refine_refuses_degenerate_input(scans: Scans) -> None:
    source, _ = scans
    with pytest.raises(ValueError, match="six points"):
        refine(source, PointCloud(np.eye(3)), np.eye(4))
    with pytest.raises(ValueError, match="rigid"):
        refine(source, source, np.diag([2.0, 1.0, 1.0, 1.0]))
    with pytest.raises(ValueError, match="coincide"):
        refine(PointCloud(np.ones((10, 3))), PointCloud(np.ones((10, 3))), np.eye(4))
