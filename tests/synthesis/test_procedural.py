from __future__ import annotations

import numpy as np
import pytest

from utopic_cli.synthesis.demo_object import demo_mesh
from utopic_cli.synthesis.implicit import ball, blend, carve, grid_points, limb, surface_net
from utopic_cli.synthesis.procedural import procedural_mesh
from utopic_cli.synthesis.range_pairs import maps_onto_itself
from utopic_cli.synthesis.surface import face_areas, sample_surface


def volume(vertices, faces):
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return np.einsum("nd,nd->", a, np.cross(b, c)) / 6.0


def assert_closed(faces):
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forward = {tuple(edge) for edge in edges.tolist()}
    assert all((b, a) in forward for a, b in forward)


def test_the_surface_net_of_a_ball_is_that_ball():
    points = grid_points(48)
    vertices, faces = surface_net(ball(points, np.zeros(3), np.full(3, 0.8), np.eye(3)), points)
    assert np.abs(np.linalg.norm(vertices, axis=1) - 0.8).max() < 0.01
    assert volume(vertices, faces) == pytest.approx(4 / 3 * np.pi * 0.8**3, rel=0.01)  # > 0: wound outwards
    assert face_areas(vertices, faces).sum() == pytest.approx(4 * np.pi * 0.8**2, rel=0.01)
    assert_closed(faces)


def test_blend_joins_and_carve_takes_away():
    points = grid_points(40)
    one = ball(points, np.array([-0.3, 0, 0]), np.full(3, 0.5), np.eye(3))
    other = limb(points, np.array([0.0, 0, 0]), np.array([0.8, 0, 0]), 0.2, 0.2)
    alone = volume(*surface_net(one, points))
    assert volume(*surface_net(blend(one, other, 0.1), points)) > alone + 0.05
    assert volume(*surface_net(carve(one, other, 0.0), points)) < alone - 0.01


def test_a_solid_that_leaves_the_grid_is_refused():
    points = grid_points(16)
    with pytest.raises(ValueError, match="border"):
        surface_net(ball(points, np.zeros(3), np.full(3, 2.0), np.eye(3)), points)
    with pytest.raises(ValueError, match="empty"):
        surface_net(np.ones((16, 16, 16)), points)


def test_procedural_meshes_are_closed_outward_varied_and_repeatable():
    volumes = []
    for seed in range(5):
        vertices, faces = procedural_mesh(np.random.default_rng(seed), 40)
        assert np.isfinite(vertices).all() and np.linalg.norm(vertices, axis=1).max() < 1.2
        assert_closed(faces)
        volumes.append(volume(vertices, faces))
    assert min(volumes) > 0.01 and len({round(v, 3) for v in volumes}) == 5
    again = procedural_mesh(np.random.default_rng(4), 40)
    np.testing.assert_array_equal(again[0], vertices)


def test_the_demo_object_has_no_symmetry():
    vertices, faces = demo_mesh(48)
    points, _ = sample_surface(vertices, faces, 20_000, np.random.default_rng(0))
    assert not maps_onto_itself(points, np.random.default_rng(1))
