from __future__ import annotations

import numpy as np
import pytest

from utopic_cli.geometry.rigid import apply, random_rotation, rigid
from utopic_cli.report import about_centroid, quaternion


def matrix_of(q):
    w, v = q["w"], np.array([q["x"], q["y"], q["z"]])
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


@pytest.mark.parametrize("seed", range(5))
def test_the_quaternion_is_the_rotation(seed):
    rotation = random_rotation(np.random.default_rng(seed))
    q = quaternion(rotation)
    assert q["w"] >= 0
    np.testing.assert_allclose(matrix_of(q), rotation, atol=1e-14)


@pytest.mark.parametrize("seed", range(5))
def test_rotation_about_the_centroid_moves_points_like_the_matrix(seed):
    rng = np.random.default_rng(seed)
    transformation = rigid(random_rotation(rng), rng.normal(0, 10, 3))
    points = rng.normal(0, 1, (20, 3)) + [4e5, 5e6, 100]
    motion = about_centroid(transformation, points)
    half = np.radians(motion["angle_deg"]) / 2
    x, y, z = np.sin(half) * motion["axis"]
    rotation = matrix_of({"w": np.cos(half), "x": x, "y": y, "z": z})
    moved = (points - motion["centroid"]) @ rotation.T + motion["centroid"] + motion["translation"]
    np.testing.assert_allclose(moved, apply(transformation, points), atol=1e-7)


def test_no_rotation_has_no_axis():
    motion = about_centroid(rigid(np.eye(3), np.array([1.0, 2, 3])), np.zeros((4, 3)))
    assert motion["axis"] is None
    assert motion["angle_deg"] == 0
    np.testing.assert_array_equal(motion["translation"], [1, 2, 3])
