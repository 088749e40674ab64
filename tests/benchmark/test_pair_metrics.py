from __future__ import annotations

import numpy as np
import pytest

from tests.synthesis.conftest import cuboid
from utopic_cli.benchmark.pair_metrics import (
    KnownNodes,
    euler_differences_deg,
    in_one_place,
    known_nodes,
    measure_matches,
    measure_overlap,
    measure_pose,
    object_distances,
)
from utopic_cli.bridge import NetworkView
from utopic_cli.geometry.rigid import apply, invert, rigid, rotation_from_vector
from utopic_cli.point_cloud import PointCloud
from utopic_cli.preprocess import prepare
from utopic_cli.synthesis.surface import bounding_diagonal, sample_surface


def about(axis: tuple[float, float, float], degrees: float) -> np.ndarray:
    return rotation_from_vector(np.radians(degrees) * np.array(axis, float))


def same_place(points: np.ndarray, T: np.ndarray, gt: np.ndarray, tolerance: float) -> bool:
    return in_one_place(*object_distances(points, T, gt, tolerance), tolerance)


def turned(degrees: float) -> np.ndarray:
    return rigid(about((0, 0, 1), degrees), np.zeros(3))


@pytest.fixture(scope="module")
def cube() -> np.ndarray:
    return sample_surface(*cuboid((1, 1, 1)), 20_000, np.random.default_rng(0))[0].astype(np.float64)


def test_identity_and_known_errors() -> None:
    gt = rigid(about((1, 0, 0), 30.0), np.array([0.1, 0.2, 0.3]))
    perfect = measure_pose(gt, gt, 1.0)
    assert perfect.rotation_deg == pytest.approx(0.0, abs=1e-5)
    assert perfect.translation == 0.0 and perfect.within((1.0, 0.02)) and perfect.symmetric
    off = measure_pose(rigid(about((0, 0, 1), 4.0) @ gt[:3, :3], gt[:3, 3] + [0.0, 0.03, -0.04]), gt, 0.5)
    assert off.rotation_deg == pytest.approx(4.0)
    assert off.translation == pytest.approx(0.1)  # 0.05 in units of 0.5
    assert off.axes == pytest.approx((0.0, 0.06, 0.08))
    assert not off.within((5.0, 0.05)) and not off.symmetric
    half_turn = measure_pose(rigid(about((0, 1, 0), 180.0), np.zeros(3)), np.eye(4), 1.0)
    assert half_turn.rotation_deg == pytest.approx(180.0)


def test_translations_are_compared_where_they_are_asked_for() -> None:
    centre = np.array([3.0, 0.0, 0.0])
    spin = about((0, 0, 1), 90.0)
    about_centre = rigid(spin, centre - spin @ centre)
    assert measure_pose(about_centre, np.eye(4), 1.0, centre=centre).translation == pytest.approx(
        0, abs=1e-12
    )
    assert measure_pose(about_centre, np.eye(4), 1.0).translation == pytest.approx(3.0 * np.sqrt(2.0))


def test_euler_angles_are_xyz_about_fixed_axes_and_go_round_the_circle() -> None:
    angles = np.array([10.0, 20.0, 40.0])
    x, y, z = (about(axis, a) for axis, a in zip(((1, 0, 0), (0, 1, 0), (0, 0, 1)), angles, strict=True))
    np.testing.assert_allclose(euler_differences_deg(z @ y @ x, np.eye(3)), angles, atol=1e-9)
    nearly = euler_differences_deg(about((0, 0, 1), 179.0), about((0, 0, 1), -179.0))
    np.testing.assert_allclose(nearly, [0.0, 0.0, 2.0], atol=1e-9)


@pytest.mark.parametrize(("degrees", "same"), [(0, True), (90, True), (180, True), (270, True), (45, False)])
def test_a_cube_is_the_same_after_a_quarter_turn_only(cube: np.ndarray, degrees: float, same: bool) -> None:
    extent = bounding_diagonal(cube)
    gt = rigid(about((1, 2, 3), 40.0), np.array([5.0, -2.0, 1.0]))
    estimate = gt @ turned(degrees)
    measures = measure_pose(estimate, gt, 1.0, object_points=cube, extent=extent)
    assert measures.symmetric is same
    assert measures.object_p95 is not None and measures.object_max is not None
    assert (measures.object_p95 < 0.02) is same and measures.object_p95 <= measures.object_max
    if degrees == 45:  # an edge sticks out of the middle of a face by (sqrt(2) - 1) / 2 of a side
        assert measures.object_max * extent == pytest.approx((np.sqrt(2) - 1) / 2, abs=0.02)
    assert measure_pose(estimate, gt, 1.0).within((5.0, 0.05)) == (degrees == 0)


def test_the_tolerance_is_two_percent_of_the_extent(cube: np.ndarray) -> None:
    tolerance = 0.02 * bounding_diagonal(cube)
    for share, same in ((0.7, True), (1.6, False)):
        shift = rigid(np.eye(3), np.array([share * tolerance, 0, 0]))
        assert same_place(cube, shift, np.eye(4), tolerance) is same


def test_a_handle_makes_the_difference_both_ways(cube: np.ndarray) -> None:
    """One small part in another place is enough, whichever cloud it sticks out of."""
    handle = sample_surface(*cuboid((0.2, 0.1, 0.1)), 600, np.random.default_rng(1))[0] + [0.6, 0.0, 0.3]
    cup = np.concatenate([cube, handle])
    tolerance = 0.02 * bounding_diagonal(cup)
    assert not same_place(cup, turned(90), np.eye(4), tolerance)
    assert not same_place(cup, np.eye(4), turned(90), tolerance)
    assert same_place(cup, turned(360), np.eye(4), tolerance)


def test_a_stray_sample_decides_nothing(cube: np.ndarray) -> None:
    tolerance = 0.02 * bounding_diagonal(cube)
    stray = np.concatenate([np.array([[0.1, 0.2, 0.3]]), cube])  # the first is always probed
    assert same_place(stray, turned(90), np.eye(4), tolerance)
    assert not same_place(stray, turned(45), np.eye(4), tolerance)


def test_a_sample_that_says_nothing_is_refused(cube: np.ndarray) -> None:
    with pytest.raises(ValueError, match="too sparse"):
        object_distances(cube[:20], np.eye(4), np.eye(4), 1e-3)


def grid_pair() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same 8 x 8 x 2 lattice, the target shifted by half its length: half of each overlaps."""
    axes = np.meshgrid(np.arange(8.0), np.arange(8.0), np.arange(2.0), indexing="ij")
    points = np.stack(axes, -1).reshape(-1, 3)
    gt = rigid(about((0, 0, 1), 25.0), np.array([1.0, 2.0, 3.0]))
    return points, apply(gt, points + [4.0, 0.0, 0.0]), gt


def test_known_nodes_by_brute_force() -> None:
    source, target, gt = grid_pair()
    prepared = prepare(PointCloud(source), PointCloud(target), 1024)
    known = known_nodes(prepared, gt, 0.5 / prepared.scale)
    nodes = prepared.source.points * prepared.scale + prepared.source_centre
    expected = nodes[:, 0] > 3.5
    np.testing.assert_array_equal(known.source_overlap, expected)
    np.testing.assert_array_equal(known.mutual_source, expected)
    assert known.target_overlap.sum() == known.mutual_target.sum() == 64
    # A wider radius reaches a column further, but nobody there is anybody's nearest.
    wide = known_nodes(prepared, gt, 1.2 / prepared.scale)
    assert wide.source_overlap.sum() == 80 and wide.mutual_source.sum() == 64


def hand_made(distance: list[list[float]], overlap: list[bool]) -> KnownNodes:
    size = len(distance)
    none = np.zeros(size, bool)
    return KnownNodes(np.array(distance), 1.0, np.array(overlap), none, none, none)


def test_hit_rate_and_inlier_ratio() -> None:
    known = hand_made([[0.0, 9.0], [2.1, 9.0], [9.0, 0.0], [0.0, 9.0]], [True, True, True, False])
    scores = np.array([[0.9, 0.1], [0.8, 0.2], [0.7, 0.3], [0.1, 0.6]])
    measures = measure_matches(scores, known, inlier_radius=1.0)
    assert measures.hit_rate == pytest.approx(2 / 3)  # the third's best is far off, the fourth doesn't count
    assert measures.inlier_ratio == pytest.approx(1 / 4)
    nothing = hand_made([[0.0, 0.0]] * 4, [False] * 4)
    assert measure_matches(scores, nothing, 1.0).hit_rate is None


def test_only_the_surest_count_as_inliers() -> None:
    distance = np.full((300, 1), 5.0)
    distance[:250] = 0.0
    known = KnownNodes(distance, 1.0, *(np.ones(300, bool) for _ in range(4)))
    scores = np.linspace(1.0, 0.1, 300)[:, None]
    assert measure_matches(scores, known, 1.0).inlier_ratio == 1.0
    assert measure_matches(scores[::-1], known, 1.0).inlier_ratio == pytest.approx(200 / 250)


def view(source: list[float], target: list[float]) -> NetworkView:
    n, m = np.array(source), np.array(target)
    return NetworkView(np.zeros((len(n), len(m))), n, m, n, m, n, m)


def test_overlap_is_counted_over_both_clouds() -> None:
    known = KnownNodes(
        np.zeros((3, 1)),
        1.0,
        source_overlap=np.array([True, True, False]),
        target_overlap=np.array([True]),
        mutual_source=np.array([True, False, False]),
        mutual_target=np.array([False]),
    )
    measures = measure_overlap(view([0.9, 0.2, 0.8], [0.7]), known)
    assert measures.accuracy == 0.5
    assert measures.precision == pytest.approx(2 / 3)
    assert measures.recall == pytest.approx(2 / 3)
    assert measures.accuracy_mutual == pytest.approx(2 / 4)
    silent = measure_overlap(view([0.1, 0.1, 0.1], [0.1]), known)
    assert silent.precision is None and silent.recall == 0.0 and silent.accuracy == 0.25


def test_moving_back_is_no_error_at_all(cube: np.ndarray) -> None:
    gt = rigid(about((1, 1, 0), 77.0), np.array([1.0, 2.0, 3.0]))
    assert same_place(cube, invert(invert(gt)), gt, 0.01)
