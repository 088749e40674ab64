"""What a scan taken from within saw past, and from where it was taken."""

from __future__ import annotations

import numpy as np

from utopic_cli.estimation.depth_map import DepthMap
from utopic_cli.estimation.panorama import Panorama, find_standpoint
from utopic_cli.estimation.surface import make_surface
from utopic_cli.geometry import rigid
from utopic_cli.point_cloud import PointCloud

HALVES = np.array([2.0, 1.5, 1.2])
ROUGHLY = 0.5  # a tenth of the room's diagonal
STANDPOINT = np.array([-0.8, 0.4, 0.1])
PILLARS = np.array([[0.6, -0.3], [-1.2, -0.7], [0.3, 1.0]])
RADIUS = 0.25


def room() -> tuple[np.ndarray, np.ndarray]:
    """Points and outward normals of a box with round pillars in it, as seen from ``STANDPOINT``."""
    rng = np.random.default_rng(0)
    points, normals = [], []
    for axis in range(3):
        for side in (-1.0, 1.0):
            wall = rng.uniform(-1.0, 1.0, (1500, 3)) * HALVES
            wall[:, axis] = side * HALVES[axis]
            points.append(wall)
            normals.append(np.tile(side * np.eye(3)[axis], (1500, 1)))
    for pillar in PILLARS:
        angle, height = rng.uniform(0.0, 2.0 * np.pi, 900), rng.uniform(-1.2, 1.2, 900)
        out = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(900)])
        points.append(out * RADIUS + np.column_stack([np.tile(pillar, (900, 1)), height]))
        normals.append(-out)  # away from the standpoint on what it sees, like the walls'
    whole, facing = np.concatenate(points), np.concatenate(normals)
    rays = (whole - STANDPOINT)[:, None, :2]
    # In the plan a ray meets a pillar where the circle's equation has its first root.
    a = (rays**2).sum(axis=2)
    b = (rays * (STANDPOINT[:2] - PILLARS)).sum(axis=2)
    c = ((STANDPOINT[:2] - PILLARS) ** 2).sum(axis=1) - RADIUS**2
    root = np.where(b**2 - a * c > 0, (-b - np.sqrt(np.maximum(b**2 - a * c, 0.0))) / a, np.inf)
    seen = ((root < 0) | (root > 0.999)).all(axis=1)
    return whole[seen], facing[seen]


def test_the_standpoint_of_a_room_is_found_whichever_side_its_normals_show() -> None:
    points, normals = room()
    for sign in (1.0, -1.0):
        found = find_standpoint(points, sign * normals)
        assert found is not None
        assert np.linalg.norm(found - STANDPOINT) < ROUGHLY
    assert find_standpoint(points[::6], normals[::6]) is None  # one could see through such walls


def test_the_standpoint_moves_with_the_scan() -> None:
    points, normals = room()
    motion = rigid.rigid(rigid.random_rotation(np.random.default_rng(1)), np.array([5.0, -2.0, 9.0]))
    found = find_standpoint(rigid.apply(motion, points), normals @ motion[:3, :3].T)
    assert found is not None
    assert np.linalg.norm(rigid.apply(rigid.invert(motion), found) - STANDPOINT) < ROUGHLY


def test_things_that_hide_each_other_from_everywhere_have_no_standpoint() -> None:
    rng = np.random.default_rng(2)
    normals = rng.standard_normal((6000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    balls = rng.uniform(-1.0, 1.0, (60, 3))[rng.integers(60, size=6000)]
    assert find_standpoint(balls + 0.1 * normals, normals) is None


def test_a_panorama_knows_what_stands_before_the_walls_and_nothing_of_what_lies_behind() -> None:
    points, _ = room()
    seen = Panorama(points, STANDPOINT, 0.1)
    behind_the_pillar = np.array([1.6, -0.8, 0.0])
    in_the_open = np.array([[-0.8, -0.9, 0.0], [1.0, 0.5, -0.5], [-1.6, 0.4, 0.8]])
    assert seen.in_front(in_the_open, 0.1).all()
    assert not seen.in_front(behind_the_pillar[None], 0.1).any()
    assert seen.in_front(points, 0.1).mean() < 0.01
    assert not seen.in_front(points * 1.3 - 0.3 * STANDPOINT, 0.1).any()  # farther out along every ray
    assert seen.in_front(in_the_open[:, None], 0.1).shape == (3, 1)


def test_a_panorama_closes_gaps_across_the_edges_of_its_cube() -> None:
    rng = np.random.default_rng(3)
    ball = rng.standard_normal((20_000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    seen = Panorama(ball, np.zeros(3), 0.05)
    edges = np.array([[1.0, 1.0, 0.3], [-1.0, 0.2, 1.0], [1.0, -1.0, -1.0]])
    edges *= 0.7 / np.linalg.norm(edges, axis=1, keepdims=True)
    assert seen.in_front(edges, 0.1).all()


def test_a_surface_sees_from_a_side_or_from_within() -> None:
    points, normals = room()
    assert isinstance(make_surface(PointCloud(points, normals), 0.06).sight, Panorama)
    wall = normals[:, 0] == 1.0
    assert isinstance(make_surface(PointCloud(points[wall], normals[wall]), 0.06).sight, DepthMap)
