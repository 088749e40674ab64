"""Shapes shared by the tests of this room."""

from __future__ import annotations

import numpy as np
import pytest

from utopic_cli.synthesis.procedural import procedural_mesh
from utopic_cli.synthesis.shapes import ShapeLibrary, pack


@pytest.fixture(scope="session")
def library() -> ShapeLibrary:
    rng = np.random.default_rng(7)
    meshes = [procedural_mesh(rng, 40) for _ in range(6)]
    return pack(meshes, list("abcdef"), ["train"] * 4 + ["val"] * 2, ["one"] * 5 + ["two"])


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """Where packed shapes are kept meanwhile."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path / "cache"))
    return tmp_path / "cache" / "utopic"


def ball(radius: float = 1.0, centre: tuple[float, float, float] = (0, 0, 0), rings: int = 40):
    """A closed triangulated sphere."""
    height = np.linspace(0, np.pi, rings)
    turn = np.linspace(0, 2 * np.pi, 2 * rings, endpoint=False)
    h, t = np.meshgrid(height, turn, indexing="ij")
    vertices = np.stack([np.sin(h) * np.cos(t), np.sin(h) * np.sin(t), np.cos(h)], -1).reshape(-1, 3)
    row, column = np.meshgrid(np.arange(rings - 1), np.arange(2 * rings), indexing="ij")
    a, b = row * 2 * rings + column, row * 2 * rings + (column + 1) % (2 * rings)
    c, d = a + 2 * rings, b + 2 * rings
    faces = np.concatenate([np.stack([a, c, b], -1).reshape(-1, 3), np.stack([b, c, d], -1).reshape(-1, 3)])
    return vertices * radius + np.array(centre), faces


def cuboid(size: tuple[float, float, float] = (1, 1, 1)):
    """A closed box about the origin, 12 triangles, wound outwards."""
    corner = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * np.array(size) / 2
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return corner, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def joined(*meshes):
    """Several meshes as one."""
    vertices, faces, offset = [], [], 0
    for v, f in meshes:
        vertices.append(v)
        faces.append(f + offset)
        offset += len(v)
    return np.concatenate(vertices), np.concatenate(faces)
