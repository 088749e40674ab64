from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from utopic_cli.synthesis.demo_object import demo_mesh
from utopic_cli.synthesis.implicit import (
    ball,
    bend,
    blend,
    carve,
    grid_points,
    limb,
    prism,
    surface_net,
    twist,
)
from utopic_cli.synthesis.mesh_form import thickness
from utopic_cli.synthesis.procedural import FAMILIES, procedural_mesh
from utopic_cli.synthesis.range_pairs import maps_onto_itself
from utopic_cli.synthesis.surface import face_areas, sample_surface


def volume(vertices, faces):
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return np.einsum("nd,nd->", a, np.cross(b, c)) / 6.0


def pieces(vertices, faces):
    rows, columns = faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()
    graph = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(len(vertices), len(vertices)))
    return connected_components(graph, directed=False)[0]


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


@pytest.mark.parametrize("family", FAMILIES)
def test_every_family_makes_closed_thick_varied_and_repeatable_meshes(family):
    volumes = []
    for seed in range(6):
        vertices, faces = procedural_mesh(np.random.default_rng(seed), 36, family)
        assert np.isfinite(vertices).all()
        assert np.linalg.norm(vertices, axis=1).max() == pytest.approx(1.0)
        assert faces.min() == 0 and faces.max() == len(vertices) - 1
        assert_closed(faces)
        assert thickness(vertices, faces) > 0.1
        assert pieces(vertices, faces) == 1
        volumes.append(volume(vertices, faces).sum())
    assert min(volumes) > 0.01 and len({round(v, 3) for v in volumes}) == 6
    again = procedural_mesh(np.random.default_rng(5), 36, family)
    np.testing.assert_array_equal(again[0], vertices)
    np.testing.assert_array_equal(again[1], faces)


def test_families_are_drawn_by_their_shares(monkeypatch):
    drawn = []
    points = grid_points(12)
    one_ball = ball(points, np.zeros(3), np.full(3, 0.6), np.eye(3))
    fakes = {
        name: (share, lambda grid, rng, name=name: drawn.append(name) or one_ball)
        for name, (share, _) in FAMILIES.items()
    }
    monkeypatch.setattr("utopic_cli.synthesis.procedural.FAMILIES", fakes)
    rng = np.random.default_rng(0)
    for _ in range(1000):
        procedural_mesh(rng, 12)
    assert sum(share for share, _ in FAMILIES.values()) == pytest.approx(1.0)
    for name, (share, _) in FAMILIES.items():
        assert drawn.count(name) / 1000 == pytest.approx(share, abs=0.04)


def test_bending_and_twisting_keep_distances_near_the_axis():
    rod = np.stack([np.linspace(-0.8, 0.8, 9), np.zeros(9), np.zeros(9)], axis=1)
    for curvature in (0.7, -0.7):
        arc = np.stack([np.sin(curvature * rod[:, 0]), 0 * rod[:, 0], 1 - np.cos(curvature * rod[:, 0])], 1)
        np.testing.assert_allclose(bend(arc / [curvature, 1, curvature], curvature), rod, atol=1e-6)
    turned = twist(np.array([[np.cos(0.6), np.sin(0.6), 0.3]]), 2.0)
    np.testing.assert_allclose(turned, [[1.0, 0.0, 0.3]], atol=1e-6)


def test_a_prism_has_the_distance_of_its_outline():
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * 0.5
    points = np.array([[0.0, 0, 0], [0.8, 0, 0], [0.4, 0.1, 0.0], [0.9, 0.8, 0.0], [0, 0, 0.9]], np.float32)
    distances = prism(points.reshape(-1, 1, 1, 3), square, 0.6).ravel()
    np.testing.assert_allclose(distances, [-0.5, 0.3, -0.1, 0.5, 0.3], atol=1e-6)
    bow = np.array([[-0.5, -0.5], [0.5, -0.5], [0.0, 0.0], [0.5, 0.5], [-0.5, 0.5]])  # not convex
    assert (
        prism(np.array([[[[0.3, 0.0, 0.0]]]]), bow, 1.0) > 0 > prism(np.array([[[[-0.3, 0, 0]]]]), bow, 1.0)
    )


def test_the_demo_object_has_no_symmetry():
    vertices, faces = demo_mesh(48)
    points, _ = sample_surface(vertices, faces, 20_000, np.random.default_rng(0))
    assert not maps_onto_itself(points, np.random.default_rng(1))
