from __future__ import annotations

import numpy as np
import pytest

from tests.synthesis.conftest import ball, cuboid
from utopic_cli.synthesis.surface import bounding_box, face_areas, normalised, sample_surface


def test_points_lie_on_the_faces_with_the_windings_normals():
    points, normals = sample_surface(*cuboid((2, 1, 0.5)), 5000, np.random.default_rng(0))
    distance = np.abs(np.abs(points) - np.array([1, 0.5, 0.25]))
    assert distance.min(axis=1).max() < 1e-6
    assert (np.einsum("nd,nd->n", points, normals) > 0.24).all()  # outwards, by at least the half height


def test_density_is_even_by_area():
    vertices, faces = cuboid((2, 1, 0.5))
    points, _ = sample_surface(vertices, faces, 70_000, np.random.default_rng(1))
    share_of_top = (points[:, 2] > 0.25 - 1e-6).mean()
    assert share_of_top == pytest.approx(2.0 / 7.0, abs=0.01)  # 2 x 1 of 2 (2 + 1 + 0.5)
    top = points[points[:, 2] > 0.25 - 1e-6]
    counts, _, _ = np.histogram2d(top[:, 0], top[:, 1], bins=(8, 4))
    assert counts.std() < 2.0 * np.sqrt(counts.mean())


def test_a_point_from_any_stride_is_a_fair_sample():
    points, _ = sample_surface(*ball(), 40_000, np.random.default_rng(2))
    assert np.linalg.norm(points[::9].mean(axis=0)) < 0.03


def test_area_of_a_box():
    assert face_areas(*cuboid((2, 1, 0.5))).sum() == pytest.approx(7.0)


def test_a_mesh_without_area_is_refused():
    with pytest.raises(ValueError, match="no surface area"):
        sample_surface(np.zeros((3, 3)), np.array([[0, 1, 2]]), 10, np.random.default_rng(0))
    with pytest.raises(ValueError, match="coincide"):
        normalised(np.ones((4, 3)))


def test_normalised_has_radius_one_about_the_box_centre():
    vertices = normalised(cuboid((2, 1, 0.5))[0] * 40.0 + 7.0)
    assert np.linalg.norm(vertices, axis=1).max() == pytest.approx(1.0)
    np.testing.assert_allclose(vertices.max(axis=0), -vertices.min(axis=0), atol=1e-12)


@pytest.mark.parametrize("count", [1, 255, 256, 257, 5000])
def test_bounding_box_is_that_of_all_points(count):
    points = np.random.default_rng(count).standard_normal((count, 3))
    low, high = bounding_box(points)
    np.testing.assert_array_equal(low, points.min(axis=0))
    np.testing.assert_array_equal(high, points.max(axis=0))
