from __future__ import annotations

import numpy as np
import pytest

from tests.synthesis.conftest import ball, cuboid, joined
from utopic_cli.synthesis.procedural import procedural_mesh
from utopic_cli.synthesis.scanner import range_scan, ray_noise, view_frame, visible
from utopic_cli.synthesis.surface import bounding_diagonal, sample_surface

DIRECTION = np.array([0.3, -0.5, 0.81]) / np.linalg.norm([0.3, -0.5, 0.81])


def height_behind_front(vertices, faces, points, direction):
    """How far below the first hit of its own ray each point lies: brute-force ray casting."""
    open3d = pytest.importorskip("open3d")
    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(
        open3d.core.Tensor(vertices.astype(np.float32)), open3d.core.Tensor(faces.astype(np.uint32))
    )
    rays = np.concatenate([points + 10 * direction, np.tile(-direction, (len(points), 1))], axis=1)
    return 10.0 - scene.cast_rays(open3d.core.Tensor(rays.astype(np.float32)))["t_hit"].numpy()


def scenes():
    hidden_ball = joined(ball(1.0), ball(0.5, tuple(-1.8 * DIRECTION)))
    nested = joined(cuboid((2, 1.4, 1.1)), ball(0.4))
    return {
        "two balls": hidden_ball,
        "ball in a box": nested,
        "detailed": procedural_mesh(np.random.default_rng(3), 56),
    }


@pytest.mark.parametrize("name", ["two balls", "ball in a box", "detailed"])
def test_what_is_seen_is_the_front_surface(name):
    vertices, faces = scenes()[name]
    points, normals = sample_surface(vertices, faces, 90_000, np.random.default_rng(0))
    extent = bounding_diagonal(points)
    seen = visible(points, normals, DIRECTION, extent / 130, 0.15)[::7]
    behind = height_behind_front(vertices, faces, points[::7], DIRECTION)
    front = (behind < 0.002 * extent) & (np.abs(normals[::7] @ DIRECTION) > 0.15)
    assert (seen & (behind > 0.03 * extent)).mean() < 1e-3  # nothing from a second layer
    assert (seen & ~front).sum() / seen.sum() < 0.02
    assert (seen & front).sum() / front.sum() > 0.94


def test_a_ball_behind_a_ball_is_never_seen():
    vertices, faces = joined(ball(1.0), ball(0.5, tuple(-1.8 * DIRECTION)))
    points, normals = sample_surface(vertices, faces, 60_000, np.random.default_rng(1))
    behind = np.linalg.norm(points + 1.8 * DIRECTION, axis=1) < 0.6
    assert not (visible(points, normals, DIRECTION, 0.03) & behind).any()


def test_grazing_surfaces_return_nothing():
    points, normals = sample_surface(*ball(), 60_000, np.random.default_rng(2))
    seen = visible(points, normals, DIRECTION, 0.025, 0.25)
    cosine = np.abs(normals @ DIRECTION)
    assert cosine[seen].min() > 0.25
    assert seen[points @ DIRECTION > 0.3].mean() > 0.97


def test_the_sign_of_normals_does_not_matter():
    points, normals = sample_surface(*ball(), 30_000, np.random.default_rng(3))
    flip = np.random.default_rng(4).choice([-1.0, 1.0], (len(points), 1))
    np.testing.assert_array_equal(
        visible(points, normals, DIRECTION, 0.04), visible(points, normals * flip, DIRECTION, 0.04)
    )


def test_noise_moves_points_along_the_ray_only_and_is_cut_off():
    vertices, faces = cuboid((1, 1, 1))
    points, normals = sample_surface(vertices, faces, 30_000, np.random.default_rng(5))
    up = np.array([0.0, 0.0, 1.0])
    scan = range_scan(points, normals, up, np.random.default_rng(6), cell=0.03, count=2000, noise=0.01)
    assert len(scan) == 2000
    error = scan.points[:, 2] - 0.5
    assert np.abs(error).max() <= 0.03 + 1e-6
    assert error.std() == pytest.approx(0.01, rel=0.1)
    assert np.abs(ray_noise(100_000, 2.0, np.random.default_rng(7))).max() == 6.0


def test_view_frame_is_a_rotation_whose_last_row_is_the_direction():
    for direction in (DIRECTION, np.eye(3)[0], -np.eye(3)[2]):
        frame = view_frame(direction)
        np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(frame) == pytest.approx(1.0)
        np.testing.assert_allclose(frame[2], direction)
