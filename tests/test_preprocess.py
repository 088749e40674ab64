"""From raw clouds to network input and back."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from tests.model.conftest import bumpy_points
from utopic_cli.frame import find_frame
from utopic_cli.geometry import rigid
from utopic_cli.geometry.rigid import random_rotation
from utopic_cli.point_cloud import PointCloud
from utopic_cli.preprocess import PATCHES, carry_to_all, prepare, sample, sample_pair


def half(points: np.ndarray, direction: list[float], keep: float = 0.7) -> np.ndarray:
    height = points @ np.asarray(direction)
    return points[height > np.quantile(height, 1 - keep)]


@pytest.fixture(scope="module")
def scans():
    return half(bumpy_points(6000, 0), [1, 0.2, 0]), half(bumpy_points(5000, 1), [0.2, 1, 0.3])


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("offset", [0.0, 5e6])
def test_unit_and_place_do_not_matter(scans, scale, offset):
    source, target = scans
    plain = prepare(PointCloud(source), PointCloud(target), 300)
    shift = np.array([4e5, offset, 10.0]) if offset else np.zeros(3)
    moved = prepare(PointCloud(source * scale + shift), PointCloud(target * scale + shift), 300)
    # At 5e6 a float64 resolves 1e-9: the clouds differ by that, relative to their size.
    tolerance = 1e-9 + 1e-8 * bool(offset) / scale
    assert moved.spacing == pytest.approx(plain.spacing, abs=tolerance)
    assert moved.scale == pytest.approx(plain.scale * scale, rel=tolerance)
    if not offset:
        np.testing.assert_allclose(moved.source.points, plain.source.points, atol=1e-9)


def test_normalise_and_denormalise_are_inverse_and_mean_what_they_say(scans):
    source, target = scans
    prepared = prepare(PointCloud(source * 50 + 7), PointCloud(target * 50 - 3), 300)
    rng = np.random.default_rng(0)
    gt = rigid.rigid(rigid.random_rotation(rng), rng.uniform(-100, 100, 3))
    normalised = prepared.normalise(gt)
    np.testing.assert_allclose(prepared.denormalise(normalised), gt, atol=1e-9)
    point = (source * 50 + 7)[10]
    inside = rigid.apply(normalised, (point - prepared.source_centre) / prepared.scale)
    np.testing.assert_allclose(
        inside * prepared.scale + prepared.target_centre, rigid.apply(gt, point), atol=1e-9
    )


def test_dense_clouds_are_sampled_to_about_the_number_asked_for(scans):
    prepared = prepare(PointCloud(scans[0]), PointCloud(scans[1]), 300)
    counts = len(prepared.source.points), len(prepared.target.points)
    assert max(counts) <= 300 and max(counts) > 240
    assert min(counts) > 150  # the same spacing holds for both


def test_sparse_clouds_keep_every_point():
    source, target = bumpy_points(200, 0), bumpy_points(150, 1)
    prepared = prepare(PointCloud(source), PointCloud(target), 300)
    assert (len(prepared.source.points), len(prepared.target.points)) == (200, 150)
    original = source[prepared.source.node_index]
    moved_back = prepared.source.points * prepared.scale + prepared.source_centre
    np.testing.assert_allclose(moved_back, original, atol=1e-9)


def test_patches_hold_points_within_their_radius_and_nothing_else(scans):
    sampled = sample(scans[0], 0.15, 100)
    for patch, mask, (_, size) in zip(sampled.patches, sampled.patch_masks, PATCHES, strict=True):
        assert patch.shape[1:] == (size, 6) and mask.shape[1] == size
        distance = np.linalg.norm(patch[..., :3], axis=2)
        assert (distance[mask] <= 1.0 + 1e-6).all()
        assert (patch[~mask] == 0).all()
        np.testing.assert_allclose(np.linalg.norm(patch[..., 3:], axis=2)[mask], 1.0, atol=1e-5)
        assert mask.mean() > 0.5


def test_a_viewpoint_turns_normals_towards_it(scans):
    view = np.array([10.0, 2.0, 0.0])
    facing = prepare(PointCloud(scans[0]), PointCloud(scans[1]), 300, source_viewpoint=view)
    offset = (view - facing.source_centre) / facing.scale - facing.source.dense.points
    assert (np.einsum("nd,nd->n", facing.source.dense.normals, offset) >= 0).all()


def test_normals_point_outwards_without_a_viewpoint():
    prepared = prepare(PointCloud(bumpy_points(6000, 0)), PointCloud(bumpy_points(6000, 1)), 400)
    dense = prepared.source.dense
    assert (np.einsum("nd,nd->n", dense.normals, dense.points) > 0).mean() > 0.99


def test_fifty_points_and_repeated_points_are_enough():
    few = bumpy_points(50, 0)
    prepared = prepare(PointCloud(few), PointCloud(np.repeat(bumpy_points(60, 1), 5, axis=0)), 1024)
    assert len(prepared.source.points) == 50
    assert len(prepared.target.points) == 60
    assert np.isfinite(prepared.source.patches[0]).all()


def test_values_carried_to_all_points_interpolate_and_keep_their_range():
    rng = np.random.default_rng(0)
    nodes, points = rng.uniform(-1, 1, (200, 3)), rng.uniform(-1, 1, (3000, 3))
    values = np.stack([(nodes[:, 0] > 0).astype(float), np.full(200, 0.25)], axis=1)
    carried = carry_to_all(points, nodes, values)
    assert carried.shape == (3000, 2) and carried.dtype == np.float32
    assert carried[:, 0].min() >= 0 and carried[:, 0].max() <= 1 + 1e-6
    np.testing.assert_allclose(carried[:, 1], 0.25, atol=1e-6)
    assert (carried[points[:, 0] > 0.5, 0] > 0.5).mean() > 0.98
    at_nodes = carry_to_all(nodes, nodes, values)
    np.testing.assert_allclose(at_nodes, values, atol=1e-5)


def test_another_sampling_shows_the_same_surface_through_other_points():
    rng = np.random.default_rng(0)
    points = rng.standard_normal((20_000, 3)) * [1.0, 0.7, 0.4]
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    clouds = PointCloud(points), PointCloud(points[::2])
    first = prepare(*clouds, 300)
    anew = prepare(*clouds, 300, resampled=np.random.default_rng(1))
    assert (anew.scale, anew.spacing) == (first.scale, first.spacing)  # one frame for both
    for one, other in ((first.source, anew.source), (first.target, anew.target)):
        assert abs(len(one.points) - len(other.points)) < 0.2 * len(one.points)
        apart, _ = cKDTree(one.points).query(other.points)
        assert 0.1 * first.spacing < np.median(apart) < first.spacing
        on_surface, index = cKDTree(one.dense.points).query(other.dense.points)
        assert on_surface.max() < first.spacing
        agreement = np.einsum("nd,nd->n", one.dense.normals[index], other.dense.normals)
        assert np.median(agreement) > 0.99
    again = prepare(*clouds, 300, resampled=np.random.default_rng(1))
    assert np.array_equal(again.source.points, anew.source.points)


def test_a_turned_sample_is_turned_throughout():
    rng = np.random.default_rng(0)
    cloud = sample(rng.standard_normal((4000, 3)), 0.3, 500)
    rotation = random_rotation(rng)
    turned = cloud.rotated(rotation)
    np.testing.assert_allclose(turned.points, cloud.points @ rotation.T)
    np.testing.assert_allclose(turned.normals, cloud.normals @ rotation.T)
    np.testing.assert_allclose(turned.patches[0][..., 3:], cloud.patches[0][..., 3:] @ rotation.T, atol=1e-6)
    for mine, theirs in zip(turned.patches, cloud.patches, strict=True):
        assert mine.dtype == np.float32
        np.testing.assert_allclose(
            np.linalg.norm(mine[..., :3], axis=-1), np.linalg.norm(theirs[..., :3], axis=-1), atol=1e-5
        )


def test_sparse_clouds_are_sampled_anew_by_leaving_points_out():
    points = np.random.default_rng(0).standard_normal((500, 3))
    anew = prepare(PointCloud(points), PointCloud(points), 1000, resampled=np.random.default_rng(1))
    assert len(anew.source.points) == len(anew.target.points) == 450
    assert set(map(tuple, anew.source.points.round(9))) != set(map(tuple, anew.target.points.round(9)))


def test_many_scattered_points_are_left_out_of_the_sampling():
    rng = np.random.default_rng(0)
    ball = rng.standard_normal((6000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    air = rng.uniform(-2, 2, (1500, 3))
    dirty = PointCloud(np.concatenate([ball, air[np.abs(np.linalg.norm(air, axis=1) - 1) > 0.3]]))
    radius = {}
    for clean in (False, True):
        pair = prepare(dirty, dirty, 300, clean=clean)
        nodes = pair.source.points * pair.scale + pair.source_centre
        radius[clean] = np.linalg.norm(nodes, axis=1)
    in_the_air = {clean: (np.abs(found - 1.0) > 0.2).mean() for clean, found in radius.items()}
    assert in_the_air[True] < 0.4 * in_the_air[False]
    few = PointCloud(np.concatenate([ball, air[:60]]))
    pairs = [prepare(few, few, 300, clean=clean) for clean in (False, True)]
    assert np.array_equal(pairs[0].source.points, pairs[1].source.points)  # a few do no harm


def test_a_frame_found_once_serves_for_two_samplings():
    clouds = [PointCloud(np.random.default_rng(seed).uniform(-1, 1, (900, 3))) for seed in (3, 4)]
    frame = find_frame(*clouds, 300, clean=True)
    for resampled in (None, 5):
        rngs = [None if resampled is None else np.random.default_rng(resampled) for _ in range(2)]
        here = sample_pair(frame, resampled=rngs[0])
        there = prepare(*clouds, 300, clean=True, resampled=rngs[1])
        np.testing.assert_array_equal(here.source.points, there.source.points)
        np.testing.assert_array_equal(here.target.node_index, there.target.node_index)
        assert here.scale == there.scale and here.spacing == there.spacing
