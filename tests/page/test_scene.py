from __future__ import annotations

import base64
from itertools import pairwise

import numpy as np
import pytest

from tests.page.conftest import make_pair, with_rivals
from utopic_cli.geometry.rigid import apply
from utopic_cli.io.colour import colour_map
from utopic_cli.page.scene import MOST_POINTS, build_scene, draw_clouds


def rotation(q):
    w, v = q[0], np.array(q[1:])
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def placed(scene, side, pose):
    """Decode a cloud and place it as the viewer does."""
    cloud = scene.data["clouds"][side]
    steps = np.frombuffer(base64.b64decode(cloud["places"]), "<i2").reshape(-1, 3)
    assert len(steps) == cloud["count"]
    return cloud["step"] * steps @ rotation(pose["turn"]).T + pose["place"]


def levels(scene, side):
    return np.frombuffer(base64.b64decode(scene.data["clouds"][side]["values"]), np.uint8).reshape(-1, 3)


def scene_of(pair):
    drawn = draw_clouds(pair.result, pair.source, pair.target)
    return build_scene(pair.result, *drawn), drawn


@pytest.mark.parametrize(
    ("offset", "spread"), [((0, 0, 0), 1.0), ((4.2e5, 5.1e6, 100.0), 30.0), ((0, 0, 0), 1e-4)]
)
def test_points_come_out_where_the_transformation_puts_them(offset, spread):
    pair = with_rivals(make_pair(300, offset, spread), 2)
    scene, _ = scene_of(pair)
    target = placed(scene, 1, scene.data["target"])
    # The view is the target's frame, moved and scaled: found from the target alone.
    middle, spreading = target.mean(axis=0), np.linalg.norm(target - target.mean(axis=0))
    real = pair.target.points.mean(axis=0)
    unit = np.linalg.norm(pair.target.points - real) / spreading
    poses = [pair.result.T_target_source, *pair.result.ambiguous_with]
    for pose, wanted in zip(scene.data["poses"][1:], poses, strict=True):
        found = (placed(scene, 0, pose) - middle) * unit + real
        np.testing.assert_allclose(found, apply(wanted, pair.source.points), atol=2e-4 * spread)


def test_before_the_source_lies_as_in_its_file():
    pair = make_pair(300)
    scene, _ = scene_of(pair)
    assert scene.apart is None
    before, target = placed(scene, 0, scene.data["poses"][0]), placed(scene, 1, scene.data["target"])
    shown = np.linalg.norm(before[:50] - target[:50], axis=1)
    real = np.linalg.norm(pair.source.points[:50] - pair.target.points[:50], axis=1)
    np.testing.assert_allclose(shown / shown[0], real / real[0], rtol=1e-3)


def test_scans_that_lie_far_apart_are_drawn_side_by_side_and_it_is_said():
    pair = make_pair(300, (0.0, 0.0, 5000.0))
    scene, _ = scene_of(pair)
    assert scene.apart == pytest.approx(5000, rel=0.01)
    before, target = placed(scene, 0, scene.data["poses"][0]), placed(scene, 1, scene.data["target"])
    # Neither far away nor one inside the other, and turned as in the file.
    gap = np.linalg.norm(before.mean(axis=0) - target.mean(axis=0))
    assert 1.0 < gap < 4.0
    np.testing.assert_allclose(scene.data["poses"][0]["turn"], [1, 0, 0, 0])


def test_every_view_frames_what_it_shows():
    pair = with_rivals(make_pair(300), 1)
    scene, _ = scene_of(pair)
    target = placed(scene, 1, scene.data["target"])
    for pose, frame in zip(scene.data["poses"], scene.data["frames"], strict=True):
        shown = np.concatenate([placed(scene, 0, pose), target])
        far = np.linalg.norm(shown - frame["middle"], axis=1)
        assert np.mean(far <= frame["radius"]) > 0.98
        assert far.max() > 0.9 * frame["radius"]


def test_a_stray_point_does_not_shrink_the_scene():
    pair = make_pair(300)
    radius = scene_of(pair)[0].data["frames"][1]["radius"]
    pair.target.points[0] = [500.0, 0, 0]
    stray, _ = scene_of(pair)
    assert stray.data["frames"][1]["radius"] == pytest.approx(radius, rel=0.1)


def test_values_are_those_of_the_points_drawn(pair):
    pair.result.source_overlap[3] = np.nan
    scene, (source, _) = scene_of(pair)
    for column, values in ((0, pair.result.source_overlap), (1, pair.result.source_uncertainty)):
        known = ~np.isnan(values)
        np.testing.assert_allclose(
            levels(scene, 0)[known, column] / 254, values[known], atol=0.5 / 254 + 1e-6
        )
        assert (levels(scene, 0)[~known, column] == 255).all()
    found = np.isfinite(source.residual)
    assert 0.1 < found.mean() < 0.9
    assert (levels(scene, 0)[~found, 2] == 255).all()
    assert (levels(scene, 0)[found, 2] < 255).all()


def test_residuals_are_distances_to_all_points_of_the_other_scan(pair):
    _, drawn = scene_of(pair)
    moved = apply(pair.result.T_target_source, pair.source.points)
    distances = np.linalg.norm(moved[:, None] - pair.target.points[None], axis=2)
    for cloud, nearest in zip(drawn, (distances.min(axis=1), distances.min(axis=0)), strict=True):
        reached = nearest < pair.result.fit.threshold
        np.testing.assert_allclose(cloud.residual[reached], nearest[reached], atol=1e-12)
        assert np.isinf(cloud.residual[~reached]).all()


def test_thinning_takes_points_from_everywhere_once_and_leaves_small_scans_whole(pair):
    large = make_pair(55_000)
    (source, _), (again, _) = (draw_clouds(large.result, large.source, large.target) for _ in range(2))
    assert len(source.indices) == MOST_POINTS
    assert all(a < b for a, b in pairwise(source.indices[:1000]))
    np.testing.assert_array_equal(source.indices, again.indices)
    shares = np.histogram(source.indices, 10, (0, len(large.source)))[0] / MOST_POINTS
    np.testing.assert_allclose(shares, 0.1, atol=0.01)
    assert len(draw_clouds(pair.result, pair.source, pair.target)[0].indices) == len(pair.source)


def test_the_colours_are_the_tools_own(pair):
    scene, _ = scene_of(pair)
    table = np.frombuffer(base64.b64decode(scene.data["map"]), np.uint8).reshape(-1, 3)
    np.testing.assert_array_equal(table, colour_map(np.linspace(0, 1, 255)))


def test_the_first_view_is_a_rotation_and_sees_the_surface_from_the_front():
    rng = np.random.default_rng(1)
    xy = rng.uniform(-1, 1, (3000, 2))
    dome = np.column_stack([xy, 1.5 - 0.8 * (xy**2).sum(axis=1)])[:, [2, 0, 1]]  # bulges towards +x
    pair = make_pair(50)
    values = np.zeros(3000, np.float32)
    pair = pair.with_result(
        T_target_source=np.eye(4), source_overlap=values, target_overlap=values, source_uncertainty=values,
        target_uncertainty=values,
    )  # fmt: skip
    pair.source = pair.target = type(pair.source)(dome)
    view = rotation(scene_of(pair)[0].data["turn"])
    np.testing.assert_allclose(view @ view.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(view) > 0
    assert view[2, 0] > 0.9  # towards the viewer
    assert view[1, 1] > 0.9  # y up
