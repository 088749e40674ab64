from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from utopic_cli.geometry import rigid
from utopic_cli.geometry.normals import estimate_normals, orient_normals, orient_towards


def sphere(count: int = 1500) -> np.ndarray:
    number = np.arange(count) + 0.5
    z = 1.0 - 2.0 * number / count
    angle = number * np.pi * (3.0 - np.sqrt(5.0))
    flat = np.sqrt(1.0 - z**2)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1)


def test_normals_of_a_sphere_point_along_the_radius() -> None:
    points = sphere()
    cosine = np.abs(np.einsum("nd,nd->n", estimate_normals(points, 16), points))
    assert cosine.min() > 0.995


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_normals_of_an_exact_plane(axis: int) -> None:
    points = np.random.default_rng(axis).uniform(-1, 1, (200, 3))
    points[:, axis] = 0.3
    normals = estimate_normals(points, 10)
    assert np.abs(normals[:, axis]) == pytest.approx(1.0)
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1.0)


def test_normals_of_points_that_have_none_are_unit_all_the_same() -> None:
    line = np.outer(np.linspace(0, 1, 50), [1.0, 2.0, 3.0])
    normals = estimate_normals(line, 8)
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1.0)
    assert np.abs(normals @ [1.0, 2.0, 3.0]).max() < 1e-6


def test_orientation_is_outward_and_the_same_in_any_frame() -> None:
    points = sphere()
    random_sign = np.where(np.random.default_rng(0).random(len(points)) < 0.5, -1.0, 1.0)
    oriented = orient_normals(points, estimate_normals(points, 16) * random_sign[:, None])
    assert (np.einsum("nd,nd->n", oriented, points) > 0).all()
    T = rigid.rigid(rigid.random_rotation(np.random.default_rng(3)), np.array([5.0, -2.0, 1.0]))
    moved = rigid.apply(T, points)
    again = orient_normals(moved, estimate_normals(moved, 16))
    assert np.einsum("nd,nd->n", again, oriented @ T[:3, :3].T).min() > 0.999


def test_an_open_bowl_gets_one_consistent_side() -> None:
    points = sphere(3000)
    bowl = points[points[:, 2] < -0.2]
    outward = np.einsum("nd,nd->n", orient_normals(bowl, estimate_normals(bowl, 16)), bowl)
    assert (outward > 0).all()


def test_orient_towards_faces_the_viewpoint() -> None:
    points = sphere(200)
    viewpoint = np.array([0.0, 0.0, 10.0])
    facing = orient_towards(points, points, viewpoint)
    assert (np.einsum("nd,nd->n", facing, viewpoint - points) >= 0).all()
    assert np.abs(np.abs(facing) - np.abs(points)).max() == 0.0


def test_normals_of_some_points_are_those_among_all() -> None:
    points = sphere() + 0.02 * np.random.default_rng(3).standard_normal((1500, 3))
    rows = np.array([700, 3, 1400])
    some = estimate_normals(points, 16, 0.2, tree=cKDTree(points), at=rows)
    np.testing.assert_array_equal(some, estimate_normals(points, 16, 0.2)[rows])
    assert not np.array_equal(some, estimate_normals(points, 16)[rows])
    assert estimate_normals(points, 16, at=rows[:0]).shape == (0, 3)


def test_a_normal_is_the_least_axis_of_the_weighted_neighbours() -> None:
    points = np.random.default_rng(4).standard_normal((400, 3))
    normals = estimate_normals(points, 12, 0.3)
    distance = np.linalg.norm(points[:, None] - points, axis=2)
    for i in (0, 17, 399):
        nearest = np.argsort(distance[i])[:12]
        weights = np.exp(-0.5 * (distance[i, nearest] / 0.3) ** 2)
        weights[:3] = 1.0  # an outlier far from everything has a plane all the same
        least = np.linalg.eigh(np.cov(points[nearest].T, aweights=weights))[1][:, 0]
        assert abs(least @ normals[i]) == pytest.approx(1.0, abs=1e-9)


def test_near_points_tell_the_normal_at_an_edge() -> None:
    rng = np.random.default_rng(5)
    floor = np.column_stack([rng.uniform(0, 1, (1500, 2)), np.zeros(1500)])
    wall = np.column_stack([np.zeros(1500), rng.uniform(0, 1, (1500, 2))])
    points = np.concatenate([floor, wall])
    at = np.flatnonzero((floor[:, 0] > 0.03) & (floor[:, 0] < 0.06))
    upright = [
        np.abs(estimate_normals(points, 30, softness, at=at)[:, 2]).mean() for softness in (0.025, np.inf)
    ]
    assert upright[0] > 0.98 > upright[1]
