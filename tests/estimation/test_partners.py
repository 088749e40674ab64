from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from tests.estimation.conftest import lumpy_surface
from utopic_cli.estimation.partners import BEYOND_CHANCE, Coincidence
from utopic_cli.estimation.problem import Problem
from utopic_cli.estimation.procrustes import weighted_procrustes
from utopic_cli.estimation.refinement import refine
from utopic_cli.estimation.solver import solve
from utopic_cli.geometry import rigid
from utopic_cli.geometry.normals import estimate_normals, orient_normals
from utopic_cli.point_cloud import PointCloud

JITTER = 0.007


def random_sample(count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw points of the blob at random, as samples of a mesh are."""
    points = lumpy_surface(40 * count, 0.2).points
    return points[rng.permutation(len(points))[:count]]


def crop(points: np.ndarray, direction: tuple[float, float, float]) -> np.ndarray:
    """Rows of the 70 % of the points that lie farthest along a direction."""
    return np.argsort(-(points @ np.array(direction)))[: int(0.7 * len(points))]


@pytest.fixture(scope="module")
def shared(gt_transformation: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two crops of one sample, each with jitter of its own, and the true partners (K, 2)."""
    rng = np.random.default_rng(0)
    whole = random_sample(1000, rng)
    rows = crop(whole, (1.0, 0.2, 0.0)), crop(whole, (0.3, 1.0, 0.5))
    source, target = (whole[each] + rng.normal(0, JITTER, (len(each), 3)) for each in rows)
    _, first, second = np.intersect1d(*rows, return_indices=True)
    return source, rigid.apply(gt_transformation, target), np.column_stack([first, second])


def thinned_evenly(points: np.ndarray, count: int) -> np.ndarray:
    """Farthest-point sampling."""
    rows = [0]
    distance = np.linalg.norm(points - points[0], axis=1)
    while len(rows) < count:
        rows.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[rows[-1]], axis=1))
    return points[rows]


def nudged(T: np.ndarray, points: np.ndarray, degrees: float, shift: float) -> np.ndarray:
    centre = rigid.apply(T, points.mean(axis=0))
    turn = rigid.rotation_from_vector(np.radians(degrees) * np.array([0.6, -0.64, 0.48]))
    return rigid.rigid(turn, centre - turn @ centre + shift * np.array([0.6, 0.0, 0.8])) @ T


def test_shared_points_are_told_from_samples_of_their_own(
    shared: tuple[np.ndarray, np.ndarray, np.ndarray], gt_transformation: np.ndarray
) -> None:
    source, target, _ = shared
    turned = nudged(gt_transformation, source, 90.0, 0.0)
    at_the_truth, elsewhere = Coincidence(source, target).evidence(np.stack([gt_transformation, turned]))
    assert at_the_truth > 10 * BEYOND_CHANCE and elsewhere < 0.5 * BEYOND_CHANCE
    other = rigid.apply(gt_transformation, random_sample(1000, np.random.default_rng(1)))
    coincidence = Coincidence(source, other)
    poses = np.stack([nudged(gt_transformation, source, degrees, 0.0) for degrees in np.linspace(0, 20, 9)])
    assert coincidence.evidence(poses).max() < 0.5 * BEYOND_CHANCE
    assert not len(coincidence.meet(poses, 9)[0])


def test_shared_points_are_told_though_the_jitter_is_as_large_as_their_distances(
    gt_transformation: np.ndarray,
) -> None:
    rng = np.random.default_rng(5)
    whole = random_sample(700, rng)
    distance = np.median(cKDTree(whole).query(whole, k=2)[0][:, 1])
    source, target = (whole + rng.normal(0, 0.5 * distance, whole.shape) for _ in range(2))
    target = rigid.apply(gt_transformation, target)
    # The nearest point of the other cloud is the partner's only half of the time.
    nearest = cKDTree(target).query(rigid.apply(gt_transformation, source))[1]
    assert (nearest == np.arange(700)).mean() < 0.6
    coincidence = Coincidence(source, target)
    assert coincidence.evidence(gt_transformation[None])[0] > BEYOND_CHANCE
    starts = np.stack([nudged(gt_transformation, source, degrees, 0.0) for degrees in (90.0, 1.5, 40.0)])
    found, begun = coincidence.meet(starts, 3)
    assert begun[0] == 1
    assert rigid.relative_rotation_error_deg(found[0], gt_transformation) < 0.5


def test_grids_do_not_pass_for_shared_points() -> None:
    axis = np.arange(20) * 0.1
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    flat = np.column_stack([grid, np.zeros(len(grid))])
    rng = np.random.default_rng(0)
    for _ in range(5):
        turn = rigid.rotation_from_vector(np.array([0.0, 0.0, rng.uniform(0.2, 1.3)]))
        pose = rigid.rigid(turn, np.append(rng.uniform(0, 1, 2), 0.0))
        assert Coincidence(flat, flat).evidence(pose[None])[0] < BEYOND_CHANCE


def test_even_samples_of_their_own_do_not_pass_for_shared_points() -> None:
    rng = np.random.default_rng(2)
    sheets = [np.column_stack([rng.uniform(0, 1, (4000, 2)), np.zeros(4000)]) for _ in range(2)]
    source, target = (thinned_evenly(sheet, 300) for sheet in sheets)
    turns = [rigid.rotation_from_vector(np.array([0.0, 0.0, angle])) for angle in np.linspace(0.2, 1.3, 20)]
    poses = np.stack([rigid.rigid(turn, 0.1 * rng.normal(size=3) * [1, 1, 0]) for turn in turns])
    assert Coincidence(source, target).evidence(poses).max() < 0.5 * BEYOND_CHANCE
    assert Coincidence(source, source + 0.001).evidence(np.eye(4)[None])[0] > 2 * BEYOND_CHANCE


def means_of_voxels(points: np.ndarray, size: float) -> np.ndarray:
    """Thin a cloud as scanning programs do."""
    rows = np.unique(np.floor(points / size).astype(int), axis=0, return_inverse=True)[1].ravel()
    sums = np.stack([np.bincount(rows, points[:, axis]) for axis in range(3)], axis=1)
    return np.asarray(sums / np.bincount(rows)[:, None])


@pytest.mark.parametrize(("count", "noise"), [(6000, 0.0), (6000, 0.25), (1200, 0.0), (1200, 0.2)])
def test_thinned_samples_of_their_own_do_not_pass_for_shared_points(
    count: int, noise: float, gt_transformation: np.ndarray
) -> None:
    rng = np.random.default_rng(7)
    size = 0.11
    source, other = (
        means_of_voxels(random_sample(count, rng) + offset, size) - offset for offset in (0.0, 0.043)
    )
    source, other = (cloud + noise * size * rng.normal(size=cloud.shape) for cloud in (source, other))
    coincidence = Coincidence(source, rigid.apply(gt_transformation, other))
    starts = np.stack([nudged(gt_transformation, source, degrees, 0.0) for degrees in np.linspace(0, 9, 10)])
    poses = np.concatenate([starts, [coincidence.fit(T) for T in starts[:4]]])
    assert coincidence.evidence(poses).max() < 0.5 * BEYOND_CHANCE
    same = source + 0.05 * size * rng.normal(size=source.shape)
    assert Coincidence(source, same).evidence(np.eye(4)[None])[0] > 5 * BEYOND_CHANCE


def test_rods_of_even_points_do_not_pass_for_shared_points() -> None:
    # Along a rod any place is near a point, though there are few in the space around it.
    rod = np.column_stack([0.02 * np.arange(150), np.zeros((150, 2))])
    poses = np.stack([rigid.rigid(np.eye(3), np.array([shift, 0.0, 0.0])) for shift in (0.003, 0.005, 0.008)])
    coincidence = Coincidence(rod, rod)
    assert coincidence.regular and coincidence.evidence(poses).max() < 1.0


def test_shared_points_are_told_where_little_overlaps() -> None:
    for seed in range(3):
        rng = np.random.default_rng(seed)
        whole = random_sample(1000, rng)
        along = np.argsort(whole[:, 0])
        source, target = (
            whole[rows] + rng.normal(0, JITTER, (len(rows), 3)) for rows in (along[500:], along[:620])
        )
        assert Coincidence(source, target).evidence(np.eye(4)[None])[0] > 1.5 * BEYOND_CHANCE


def test_partners_that_are_some_reaches_apart_are_brought_together(
    shared: tuple[np.ndarray, np.ndarray, np.ndarray], gt_transformation: np.ndarray
) -> None:
    source, target, _ = shared
    coincidence = Coincidence(source, target)
    start = nudged(gt_transformation, source, 6.0, 0.04)
    assert coincidence.evidence(start[None])[0] < 0
    found, begun = coincidence.meet(start[None], 1)
    assert begun[0] == 0
    assert rigid.relative_rotation_error_deg(found[0], gt_transformation) < 0.3


def flag(rng: np.random.Generator) -> np.ndarray:
    """A pole 2 long, hardly thicker than its points are apart, with a sheet on one side."""
    pole = np.column_stack([rng.uniform(-1.0, 1.0, 100), 0.01 * rng.normal(size=(100, 2))])
    sheet = np.column_stack([rng.uniform(-1.0, 1.0, 400), rng.uniform(0.3, 2.3, 400), np.zeros(400)])
    return np.concatenate([pole, sheet])


def test_poles_that_meet_do_not_pass_for_shared_points() -> None:
    # Turned about the pole only poles meet. Pairs crowd there as they don't on a sheet.
    turn = rigid.rotation_from_vector(np.array([np.pi, 0.0, 0.0]))
    poses = np.stack([rigid.rigid(turn, np.array([shift, 0.0, 0.0])) for shift in np.linspace(-0.5, 0.5, 21)])
    for seed in range(5):
        rng = np.random.default_rng(seed)
        source, other = flag(rng), flag(rng)
        assert Coincidence(source, other).evidence(poses).max() < 0.8 * BEYOND_CHANCE
        same = source + 0.003 * rng.normal(size=source.shape)
        assert Coincidence(source, same).evidence(np.eye(4)[None])[0] > 2 * BEYOND_CHANCE


def test_a_crowd_elsewhere_does_not_hide_shared_points() -> None:
    rng = np.random.default_rng(0)
    sheet = np.column_stack([rng.uniform(-1.0, 1.0, (400, 2)), np.zeros(400)])
    source, target = (sheet + 0.02 * rng.normal(size=sheet.shape) for _ in range(2))
    rod = np.column_stack([3.0 + rng.uniform(-1.0, 1.0, 200), 0.005 * rng.normal(size=(200, 2))])
    coincidence = Coincidence(np.concatenate([source, rod]), target)
    assert coincidence.evidence(np.eye(4)[None])[0] > 1.1 * BEYOND_CHANCE
    assert len(coincidence.meet(np.eye(4)[None], 1)[0]) == 1


def test_shared_points_are_found_where_neither_matches_nor_surfaces_tell(
    gt_transformation: np.ndarray,
) -> None:
    rng = np.random.default_rng(6)
    ball = rng.normal(size=(600, 3))
    ball /= np.linalg.norm(ball, axis=1)[:, None]
    rows = crop(ball, (1.0, 0.2, 0.0)), crop(ball, (0.3, 1.0, 0.5))
    source, target = (ball[each] + rng.normal(0, 0.01, (len(each), 3)) for each in rows)
    target = rigid.apply(gt_transformation, target)
    problem = Problem(
        source_nodes=source,
        target_nodes=target,
        matching_scores=rng.random((len(source), len(target))),
        source_overlap=np.ones(len(source)),
        target_overlap=np.ones(len(target)),
        source_certainty=np.ones(len(source)),
        target_certainty=np.ones(len(target)),
        source_dense=surface_of(source),
        target_dense=surface_of(target),
        spacing=0.1,
    )
    estimate = solve(problem)
    assert estimate.shared_points
    assert rigid.relative_rotation_error_deg(estimate.T_target_source, gt_transformation) < 0.5


def test_few_or_doubled_points_say_nothing() -> None:
    points = np.random.default_rng(0).normal(size=(100, 3))
    for cloud in (points[:8], np.repeat(points, 2, axis=0)):
        coincidence = Coincidence(points, cloud)
        assert coincidence.reach == 0
        assert coincidence.evidence(np.eye(4)[None])[0] == -np.inf


def test_points_that_are_there_often_do_no_harm() -> None:
    points = random_sample(300, np.random.default_rng(4))
    crowded = np.concatenate([points, np.repeat(points[:3], 12, axis=0)])
    with np.errstate(all="raise"):
        assert Coincidence(crowded, points).evidence(np.eye(4)[None])[0] > BEYOND_CHANCE


def test_nothing_near_is_no_evidence() -> None:
    points = np.random.default_rng(0).normal(size=(100, 3))
    far = rigid.rigid(np.eye(3), np.full(3, 50.0))
    assert Coincidence(points, points).evidence(far[None])[0] == -np.inf
    assert not len(Coincidence(points, points).meet(far[None], 1)[0])
    assert np.array_equal(Coincidence(points, points).fit(far), far)


def test_the_fit_is_nearly_as_good_as_if_the_partners_were_known(
    shared: tuple[np.ndarray, np.ndarray, np.ndarray], gt_transformation: np.ndarray
) -> None:
    source, target, pairs = shared
    known = weighted_procrustes(source[pairs[:, 0]], target[pairs[:, 1]], np.ones(len(pairs)))
    start = nudged(gt_transformation, source, 1.5, 0.01)
    found = Coincidence(source, target).fit(start)
    floor = rigid.relative_rotation_error_deg(known, gt_transformation)
    assert rigid.relative_rotation_error_deg(found, gt_transformation) < 1.3 * floor + 0.1
    assert rigid.relative_rotation_error_deg(found, known) < 0.25
    assert rigid.is_rigid(found, 1e-9)


def test_exact_copies_are_aligned_exactly(gt_transformation: np.ndarray) -> None:
    source = random_sample(300, np.random.default_rng(2))
    target = rigid.apply(gt_transformation, source)[::-1]
    found = Coincidence(source, target).fit(nudged(gt_transformation, source, 1.0, 0.005))
    assert np.abs(found - gt_transformation).max() < 1e-6


def test_refine_leaves_shared_points_on_their_partners(
    shared: tuple[np.ndarray, np.ndarray, np.ndarray], gt_transformation: np.ndarray
) -> None:
    source, target, pairs = shared
    known = weighted_procrustes(source[pairs[:, 0]], target[pairs[:, 1]], np.ones(len(pairs)))
    refined = refine(PointCloud(source), PointCloud(target), nudged(gt_transformation, source, 2.0, 0.01))
    assert rigid.relative_rotation_error_deg(refined.T_target_source, known) < 0.25


def surface_of(points: np.ndarray) -> PointCloud:
    return PointCloud(points, orient_normals(points, estimate_normals(points, 12)))


def test_shared_points_tell_symmetric_poses_apart(gt_transformation: np.ndarray) -> None:
    # A box looks the same after half a turn; its sampled points do not. The scores favour
    # the wrong pose.
    rng = np.random.default_rng(3)
    faces = rng.integers(0, 3, 700)
    box = rng.uniform(-1.0, 1.0, (700, 3))
    box[np.arange(700), faces] = np.where(rng.random(700) < 0.5, -1.0, 1.0)
    box *= [0.5, 0.35, 0.2]
    source = box + rng.normal(0, 0.004, box.shape)
    target = rigid.apply(gt_transformation, box + rng.normal(0, 0.004, box.shape))
    half_turn = box @ np.diag([1.0, -1.0, -1.0])
    scores = np.zeros((700, 700))
    for points, score in ((box, 0.3), (half_turn, 0.5)):
        gap = np.linalg.norm(points[:, None] - box, axis=2)
        scores[np.arange(700), gap.argmin(axis=1)] += score
    problem = Problem(
        source_nodes=source,
        target_nodes=target,
        matching_scores=scores,
        source_overlap=np.ones(700),
        target_overlap=np.ones(700),
        source_certainty=np.ones(700),
        target_certainty=np.ones(700),
        source_dense=surface_of(source),
        target_dense=surface_of(target),
        spacing=0.1,
    )
    estimate = solve(problem)
    assert rigid.relative_rotation_error_deg(estimate.T_target_source, gt_transformation) < 0.3
    assert not estimate.rivals
    # Without points of their own for nodes, the clouds' surfaces decide, and can't.
    few = replace(
        problem,
        source_nodes=source[::2],
        target_nodes=target[::2],
        matching_scores=scores[::2, ::2],
        source_overlap=np.ones(350),
        target_overlap=np.ones(350),
        source_certainty=np.ones(350),
        target_certainty=np.ones(350),
    )
    surfaces = solve(few)
    half = surfaces.rivals[0].T_target_source if surfaces.rivals else surfaces.T_target_source
    turned = rigid.rotation_angle_deg(half[:3, :3] @ surfaces.T_target_source[:3, :3].T)
    assert surfaces.rivals and turned == pytest.approx(180.0, abs=3.0)
