from __future__ import annotations

import numpy as np
import pytest

from tests.estimation.conftest import VOXEL, lumpy_surface
from utopic_cli.estimation.depth_map import DepthMap, find_direction
from utopic_cli.estimation.surface import make_surface, point_spacing, thinned
from utopic_cli.estimation.verification import measure_fit, verify
from utopic_cli.geometry import rigid
from utopic_cli.point_cloud import PointCloud

Scans = tuple[PointCloud, PointCloud]


def sheet(z: float, across: float = 1.0, step: float = 0.02) -> PointCloud:
    """A level square seen from above (+z)."""
    axis = np.arange(-across, across, step)
    x, y = np.meshgrid(axis, axis)
    points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z)])
    return PointCloud(points, np.tile([0.0, 0.0, 1.0], (len(points), 1)))


def test_depth_map_knows_what_stands_before_the_surface() -> None:
    cloud = sheet(0.0)
    seen = DepthMap(cloud.points, cloud.normals, 0.03)  # type: ignore[arg-type]
    places = np.array(
        [[0.1, 0.2, 0.5], [0.1, 0.2, -0.5], [0.1, 0.2, 0.01], [5.0, 0.0, 0.5], [-5.0, 9.0, 0.5]]
    )
    assert seen.in_front(places, 0.03).tolist() == [True, False, False, False, False]


def test_depth_map_turns_with_the_scan() -> None:
    T = rigid.rigid(rigid.random_rotation(np.random.default_rng(0)), np.array([3.0, 1.0, -2.0]))
    cloud = sheet(0.0).transformed(T)
    seen = DepthMap(cloud.points, cloud.normals, 0.03)  # type: ignore[arg-type]
    assert seen.in_front(rigid.apply(T, np.array([[0.1, 0.2, 0.3], [0.1, 0.2, -0.3]])), 0.03).tolist() == [
        True,
        False,
    ]


def test_the_direction_is_the_one_that_hides_least() -> None:
    # Louvres, tilted by 50 degrees: from above all of them is seen, along their normals half lies behind.
    tilt = np.radians(50.0)
    normal, along = np.array([np.sin(tilt), 0.0, np.cos(tilt)]), np.array([np.cos(tilt), 0.0, -np.sin(tilt)])
    u, v, number = np.meshgrid(np.arange(0, 1, 0.03), np.arange(0, 3, 0.06), np.arange(6), indexing="ij")
    points = u.reshape(-1, 1) * along + np.stack([0.7 * number, v, 0.0 * v], axis=-1).reshape(-1, 3)
    motion = rigid.random_rotation(np.random.default_rng(4))
    found = find_direction(points @ motion.T, np.tile(motion @ normal, (len(points), 1)))
    assert np.linalg.norm(found) == pytest.approx(1.0)
    assert np.degrees(np.arccos(found @ motion @ [0.0, 0.0, 1.0])) < 25.0
    plate = points[number.ravel() == 0]
    alone = find_direction(plate, np.tile(normal, (len(plate), 1)))
    assert np.degrees(np.arccos(min(alone @ normal, 1.0))) < 5.0


def test_free_space_prefers_the_true_transformation_over_a_penetrating_one() -> None:
    # Two level steps; a third of the lower one also fits the upper, but then the source's
    # upper step would stand in the air where the target's scanner saw past it.
    low, high = sheet(0.0, 0.5), sheet(0.3, 0.5)
    right = np.array([1.0, 0.0, 0.0])
    points = np.concatenate([low.points, high.points + right])
    cloud = PointCloud(points, np.tile([0.0, 0.0, 1.0], (len(points), 1)))
    surface = make_surface(cloud, 0.02)
    wrong = rigid.rigid(np.eye(3), np.array([0.0, 0.0, 0.3]))
    verdict = verify(surface, surface, np.stack([np.eye(4), wrong]))
    assert verdict.violation[0] == 0.0 and verdict.violation[1] > 0.2
    assert verdict.score[0] > 0.95 > 0.4 > verdict.score[1]


def test_opposite_normals_do_not_fit() -> None:
    up = sheet(0.0)
    assert up.normals is not None
    surface = make_surface(up, 0.02)
    flipped = rigid.rigid(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    assert verify(surface, surface, flipped[None]).fit[0] == 0.0


def test_the_true_transformation_scores_best(scans: Scans, gt_transformation: np.ndarray) -> None:
    source, target = (make_surface(scan, VOXEL) for scan in scans)
    rng = np.random.default_rng(0)
    others = [rigid.rigid(rigid.random_rotation(rng), gt_transformation[:3, 3]) for _ in range(20)]
    verdict = verify(source, target, np.stack([gt_transformation, *others]))
    assert verdict.score.argmax() == 0 and verdict.fit[0] > 0.3 and verdict.violation[0] < 0.02
    back = verify(target, source, rigid.invert(gt_transformation)[None])
    assert back.score[0] == pytest.approx(verdict.score[0])


def test_make_surface_needs_points_and_normals() -> None:
    with pytest.raises(ValueError, match="normals"):
        make_surface(PointCloud(np.eye(3)), 0.1)
    with pytest.raises(ValueError, match="three points"):
        make_surface(PointCloud(np.eye(3)[:2], np.eye(3)[:2]), 0.1)


def test_thinning_keeps_no_step_with_the_rows_of_a_range_image() -> None:
    columns = np.tile(np.arange(100), 200)
    kept = thinned(np.column_stack([columns, columns, columns]).astype(float), 1000)[:, 0]
    assert len(kept) == 1000
    assert np.bincount(kept.astype(int), minlength=100).min() >= 1


def test_point_spacing_is_that_of_the_places() -> None:
    points = sheet(0.0).points
    assert point_spacing(points) == pytest.approx(0.02)
    assert point_spacing(np.concatenate([points, points, points])) == pytest.approx(0.02)
    assert point_spacing(np.ones((5, 3))) == 0.0


def test_measure_fit_counts_both_ways_in_the_points_own_units() -> None:
    whole, part = sheet(0.0), sheet(0.0, across=0.5)
    T = rigid.rigid(np.eye(3), np.array([0.0, 0.0, 0.004]))
    fit = measure_fit(part, whole, T, 0.03, inlier_ratio=0.4)
    assert fit.overlap_ratio["source"] == 1.0
    assert fit.overlap_ratio["target"] == pytest.approx(0.25, abs=0.04)
    assert fit.inlier_rmse == pytest.approx(0.004)
    assert fit.residual_percentiles == pytest.approx(dict.fromkeys(("p50", "p75", "p90", "p95"), 0.004))
    assert fit.inlier_ratio == 0.4 and fit.threshold == 0.03


def test_measure_fit_of_scans_that_do_not_meet() -> None:
    fit = measure_fit(sheet(0.0), sheet(9.0), np.eye(4), 0.1, 0.0)
    assert fit.overlap_ratio == {"source": 0.0, "target": 0.0}
    assert np.isnan(fit.inlier_rmse) and np.isnan(fit.residual_percentiles["p50"])


def test_measure_fit_refuses_nonsense() -> None:
    with pytest.raises(ValueError, match="threshold"):
        measure_fit(sheet(0.0), sheet(0.0), np.eye(4), 0.0, 0.0)
    with pytest.raises(ValueError, match="empty"):
        measure_fit(PointCloud(np.zeros((0, 3))), sheet(0.0), np.eye(4), 0.1, 0.0)


def test_a_sparse_sample_lies_on_the_surface_of_another_one(gt_transformation: np.ndarray) -> None:
    # Points of two sparse samples are nearly a spacing apart; their tangent planes are not.
    rng = np.random.default_rng(4)
    whole = lumpy_surface(40_000, 0.0)
    assert whole.normals is not None
    rows = rng.permutation(len(whole))
    first, second = (
        PointCloud(whole.points[each], whole.normals[each]) for each in (rows[:700], rows[-700:])
    )
    spacing = 1.2 * point_spacing(first.points)
    source, target = (
        make_surface(first, spacing),
        make_surface(second.transformed(gt_transformation), spacing),
    )
    others = [rigid.rigid(rigid.random_rotation(rng), gt_transformation[:3, 3]) for _ in range(20)]
    verdict = verify(source, target, np.stack([gt_transformation, *others]))
    assert verdict.fit[0] > 0.6 and verdict.fit[0] > 2 * verdict.fit[1:].max()
