"""The one form that packed meshes have: centred, radius 1, at most 3,000 triangles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from utopic_cli.errors import InputError
from utopic_cli.synthesis.surface import DegenerateShape, normalised, sample_surface

MOST_FACES = 3000
MERGE = 1e-5  # vertices closer than this are one; the radius is 1
THINNEST = 0.02  # smallest over largest singular value of points spread over the surface
_TRIED_POINTS = 2000


@dataclass(frozen=True)
class PackedMesh:
    """One mesh as it is stored.

    Attributes:
        vertices: (V, 3) float16, radius 1 about the centre of their bounding box.
        faces: (F, 3) uint16.
        decimated: whether it had more than 3,000 triangles.
    """

    vertices: np.ndarray
    faces: np.ndarray
    decimated: bool


def packed_mesh(vertices: np.ndarray, faces: np.ndarray) -> PackedMesh:
    """Bring a mesh (V, 3), (F, 3) of any size and place into the form.

    Raises:
        DegenerateShape: it has a vertex that is not finite, no area, or is flat; says which.
        InputError: it has to be decimated and Open3D can't be loaded.
    """
    if len(faces) == 0:
        raise DegenerateShape("has no faces, and its points form no surface")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise DegenerateShape("has faces with vertices that do not exist")
    vertices, faces = _used(vertices, faces)
    if not np.isfinite(vertices).all():
        raise DegenerateShape("has vertices that are NaN or infinite")
    vertices, faces = _merged(normalised(vertices), faces)
    decimated = len(faces) > MOST_FACES
    if decimated:
        vertices, faces = _merged(*_simplified(vertices, faces))
        if len(faces) > MOST_FACES:
            raise DegenerateShape(f"can't be reduced to {MOST_FACES} triangles")
    if len(faces) == 0:
        raise DegenerateShape("has no surface area")
    stored = normalised(vertices).astype(np.float16)
    thin = thickness(stored.astype(np.float64), faces)
    if thin < THINNEST:
        raise DegenerateShape(f"is flat (thickness {thin:.3f} of its length, {THINNEST} is needed)")
    return PackedMesh(stored, faces.astype(np.uint16), decimated)


def thickness(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Return the smallest over the largest singular value of points spread over a mesh.

    Raises:
        DegenerateShape: the mesh has no area.
    """
    points, _ = sample_surface(vertices, faces, _TRIED_POINTS, np.random.default_rng(0))
    spread = np.linalg.svd(points - points.mean(axis=0, dtype=np.float64), compute_uv=False)
    return float(spread[2] / spread[0]) if spread[0] > 0 else 0.0


def _used(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Leave out the vertices that no face has."""
    used, faces = np.unique(faces, return_inverse=True)
    return np.asarray(vertices, dtype=np.float64)[used], faces.reshape(-1, 3)


def _merged(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Join equal vertices, and leave out the triangles that have none but two."""
    _, first, number = np.unique(
        np.round(vertices / MERGE).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    faces = number.ravel()[faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    return _used(vertices[first], faces)


def _simplified(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Reduce a mesh to 3,000 triangles by quadric decimation."""
    o3d = _load_open3d()
    mesh = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(faces))
    mesh = mesh.simplify_quadric_decimation(MOST_FACES)
    return np.asarray(mesh.vertices, np.float64), np.asarray(mesh.triangles, np.int64)


def _load_open3d() -> Any:
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise InputError(
            f"meshes above {MOST_FACES} triangles are reduced with Open3D, which can't be loaded ({error}); "
            "pip install open3d (or its system libraries), or reduce the meshes yourself"
        ) from error
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    return open3d
