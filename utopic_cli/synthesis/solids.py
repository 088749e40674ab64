"""Exact meshes of simple solids: boxes, turned and extruded parts.

A mesh is vertices (V, 3) float64 and faces (F, 3) int64, about the origin.
"""

from __future__ import annotations

import numpy as np

from utopic_cli.synthesis.surface import Mesh

SEGMENTS = 180  # round things are off by less than a thousandth of their radius


def box(halves: np.ndarray) -> Mesh:
    """Return a box about the origin by its half edges (3,)."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * np.asarray(halves)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return corners, np.array([face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))])


def revolved(profile: np.ndarray) -> Mesh:
    """Turn a profile (K, 2), rows (radius, height), about the third axis."""
    turn = np.linspace(0.0, 2.0 * np.pi, SEGMENTS, endpoint=False)
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    rings = [np.column_stack([radius * circle, np.full(SEGMENTS, height)]) for radius, height in profile]
    return np.concatenate(rings), _between_rings(len(profile), SEGMENTS)


def extruded(outline: np.ndarray, half_height: float, *, capped: bool = True) -> Mesh:
    """Extrude an outline (K, 2), star-shaped about the origin, along the third axis."""
    count = len(outline)
    ends = [np.column_stack([outline, np.full(count, height)]) for height in (-half_height, half_height)]
    vertices, faces = np.concatenate(ends), _between_rings(2, count)
    if not capped:
        return vertices, faces
    around, after = np.arange(count), np.roll(np.arange(count), -1)
    bottom = np.column_stack([np.full(count, 2 * count), after, around])
    top = np.column_stack([np.full(count, 2 * count + 1), around + count, after + count])
    centres = np.array([[0.0, 0.0, -half_height], [0.0, 0.0, half_height]])
    return np.concatenate([vertices, centres]), np.concatenate([faces, bottom, top])


def joined(*meshes: Mesh) -> Mesh:
    """Return several meshes as one; what of them lies inside others no scanner sees."""
    starts = np.cumsum([0] + [len(vertices) for vertices, _ in meshes])
    return (
        np.concatenate([vertices for vertices, _ in meshes]),
        np.concatenate([faces + start for (_, faces), start in zip(meshes, starts)]),
    )


def _between_rings(rings: int, count: int) -> np.ndarray:
    """Faces of a tube of rings of ``count`` vertices each."""
    ring, place = np.meshgrid(np.arange(rings - 1), np.arange(count), indexing="ij")
    a, b = ring * count + place, ring * count + (place + 1) % count
    quads = np.stack([a, b, b + count, a + count], axis=-1).reshape(-1, 4)
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
