"""A triangle mesh as points spread evenly over its surface."""

from __future__ import annotations

import numpy as np

Mesh = tuple[np.ndarray, np.ndarray]
"""Vertices (V, 3) and faces (F, 3)."""

BLOCK = 8192  # points worked on at a time, so that temporaries stay in the cache


class DegenerateShape(ValueError):
    """A mesh that no scan can be made of."""


def face_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the area of each triangle of a mesh (V, 3), (F, 3) -> (F,) float64."""
    return 0.5 * np.linalg.norm(_face_crosses(vertices, faces), axis=1)


def sample_surface(
    vertices: np.ndarray, faces: np.ndarray, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw points uniformly by area, with normals.

    The points come grouped by face, because that is twice as fast as in random order: take a
    random subset (or every n-th point), never a prefix, where fewer are wanted.

    Args:
        vertices: (V, 3).
        faces: (F, 3) vertex numbers.
        count: number of points.
        rng: source of randomness.

    Returns:
        points: (count, 3) float32, on the faces.
        normals: (count, 3) float32 unit normals by the winding of the faces.

    Raises:
        DegenerateShape: the mesh has no area.
    """
    points, face = sample_faces(vertices, faces, count, rng)
    return points, face_normals(vertices, faces).take(face, axis=0)


def sample_faces(
    vertices: np.ndarray, faces: np.ndarray, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw points uniformly by area; like ``sample_surface``, with face numbers for normals.

    Returns:
        points: (count, 3) float32.
        face: (count,) int64, ascending.

    Raises:
        DegenerateShape: the mesh has no area.
    """
    areas = face_areas(vertices, faces)
    total = areas.sum()
    if not total > 0 or not np.isfinite(total):
        raise DegenerateShape("the mesh has no surface area to sample")
    per_face = rng.multinomial(count, areas / total)
    face = np.repeat(np.arange(len(faces)), per_face)
    corners = vertices.astype(np.float32)[faces]  # (F, 3, 3)
    origin = np.ascontiguousarray(corners[:, 0])
    first, second = corners[:, 1] - origin, corners[:, 2] - origin
    points = np.empty((count, 3), dtype=np.float32)
    for start in range(0, count, BLOCK):
        block = face[start : start + BLOCK]
        u = rng.random((2, len(block)), dtype=np.float32)
        u = np.where(u[0] + u[1] > 1.0, 1.0 - u, u)  # fold the square onto the triangle
        part = origin.take(block, axis=0)  # take is four times as fast as an index here
        part += u[0, :, None] * first.take(block, axis=0)
        part += u[1, :, None] * second.take(block, axis=0)
        points[start : start + BLOCK] = part
    return points, face


def face_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the unit normals (F, 3) float32 of a mesh's faces; zero where one has no area."""
    crosses = _face_crosses(vertices, faces)
    lengths = np.linalg.norm(crosses, axis=1, keepdims=True)
    return (crosses / np.where(lengths > 0, lengths, 1.0)).astype(np.float32)


def bounding_diagonal(points: np.ndarray) -> float:
    """Return the diagonal of the bounding box of (N, 3) points: the *extent* of an object."""
    low, high = bounding_box(points)
    return float(np.linalg.norm(high - low))


def bounding_box(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper corner (3,) of the bounding box of (N, 3) points.

    NumPy reduces short rows slowly, so long rows of many points are compared first: 20 times
    as fast as ``points.min(axis=0)``.
    """
    whole = len(points) // 256 * 256
    rows = np.ascontiguousarray(points[:whole]).reshape(-1, 256 * 3)
    rest = points[whole:]
    parts = [rest] if len(rest) else []
    low = np.concatenate([rows.min(axis=0).reshape(-1, 3), *parts]) if len(rows) else rest
    high = np.concatenate([rows.max(axis=0).reshape(-1, 3), *parts]) if len(rows) else rest
    return low.min(axis=0), high.max(axis=0)


def normalised(vertices: np.ndarray) -> np.ndarray:
    """Centre (V, 3) vertices on their bounding box and scale the farthest to norm 1.

    Raises:
        DegenerateShape: all vertices coincide.
    """
    centred = vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2.0
    radius = np.linalg.norm(centred, axis=1).max()
    if not radius > 0:
        raise DegenerateShape("all vertices coincide")
    return centred / radius


def _face_crosses(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (np.asarray(vertices[faces[:, i]], dtype=np.float64) for i in range(3))
    return np.cross(b - a, c - a)
