"""STL, OFF and GLB meshes through trimesh: sampled by area."""

from __future__ import annotations

import io
import json
import logging
import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from utopic_cli.io.records import FormatError, Motion, Records

SAMPLES = 30_000
_COMMENT = re.compile(rb"#[^\n]*")
_COUNTS = re.compile(rb"\s*OFF\s+(\d{1,18})\s+(\d{1,18})")


@dataclass(frozen=True)
class _Mesh:
    scene: Any  # trimesh.Scene or Trimesh
    file_type: str

    def rewrite(self, motion: Motion) -> bytes:
        scene = self.scene.copy()
        scene.apply_transform(motion.transformation)
        exported = scene.export(file_type=self.file_type)
        return exported if isinstance(exported, bytes) else exported.encode()


def read_mesh(data: bytes, kind: str, rng: np.random.Generator) -> Records:
    """Read a mesh and draw points from its surface by area.

    A file without faces gives its vertices. Nothing outside the file is opened.

    Args:
        data: the file.
        kind: ``stl``, ``off`` or ``glb``.
        rng: draws the points.

    Raises:
        FormatError: the file is damaged, promises more than it holds, or has no surface.
    """
    check_promises(data, kind, len(data))
    import trimesh  # heavy, and not needed for scans

    file_type = "stl_ascii" if kind == "stl" and not _is_binary_stl(data, len(data)) else kind
    try:
        with _silenced(logging.getLogger("trimesh")):
            scene = trimesh.load(io.BytesIO(data), file_type=file_type, process=False)
        whole: Any = scene.to_mesh() if isinstance(scene, trimesh.Scene) else scene
        vertices = np.asarray(whole.vertices, np.float64)
        faces = np.asarray(getattr(whole, "faces", np.empty((0, 3))), np.int64)
    except Exception as error:  # trimesh raises whatever its parsing meets
        reason = " ".join(str(error).split())[:80] or type(error).__name__
        raise FormatError(f"can't be read as {kind.upper()} ({reason}); export it again") from None
    # A GLB keeps its nodes and materials; the others are one mesh.
    document = _Mesh(scene if kind == "glb" else whole, file_type)
    if not len(faces):
        return Records(vertices.reshape(-1, 3), None, document)
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise FormatError("has faces with vertices that do not exist; export it again")
    if not np.isfinite(vertices).all():
        raise FormatError("has vertices that are NaN or infinite; repair the mesh first")
    points, normals = _sample(vertices[faces], rng)
    warning = f"a mesh: {SAMPLES} points drawn from its surface stand for it"
    return Records(points, normals, document, (warning,))


@contextmanager
def _silenced(logger: logging.Logger) -> Iterator[None]:
    """Keep a library from writing tracebacks to stderr: what goes wrong is raised as well."""
    before = logger.disabled
    logger.disabled = True
    try:
        yield
    finally:
        logger.disabled = before


def _sample(triangles: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw points from (F, 3, 3) triangles by area; returns (S, 3) points and unit normals."""
    first, second = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    crosses = np.cross(first, second)  # (F, 3)
    with np.errstate(over="ignore", invalid="ignore"):
        doubled_areas = np.linalg.norm(crosses, axis=1)
        total = doubled_areas.sum()
    if not np.isfinite(total) or total <= 0:
        raise FormatError("has faces without any area; export it again")
    chosen = rng.choice(len(triangles), SAMPLES, p=doubled_areas / total)
    u, v = rng.random((2, SAMPLES, 1))
    beyond = u + v > 1  # the other half of the parallelogram, folded back
    u, v = np.where(beyond, 1 - u, u), np.where(beyond, 1 - v, v)
    points = triangles[chosen, 0] + u * first[chosen] + v * second[chosen]
    return points, crosses[chosen] / doubled_areas[chosen, None]


def _is_binary_stl(data: bytes, size: int) -> bool:
    """A binary STL's length follows from its count; ascii ones may not even start with solid."""
    return size >= 84 and size == 84 + 50 * struct.unpack_from("<I", data, 80)[0]


def check_promises(data: bytes, kind: str, size: int) -> None:
    """Compare promised counts with the bytes there are, before trimesh allocates for them.

    Args:
        data: the file, or some of its beginning.
        kind: ``stl``, ``off`` or ``glb``.
        size: of the file, in bytes.

    Raises:
        FormatError: it promises more than it holds, or is no such file.
    """
    if kind == "stl":
        if not _is_binary_stl(data, size) and (not data.lstrip().startswith(b"solid") or b"\0" in data):
            if size < 84:
                raise FormatError("is too short for an STL; copy it again")
            promised = struct.unpack_from("<I", data, 80)[0]
            raise FormatError(
                f"its STL header promises {promised} triangles but there are {(size - 84) / 50:g};"
                " the file is damaged or cut short, copy it again"
            )
    elif kind == "off":
        counts = _COUNTS.match(_COMMENT.sub(b"", data))
        if counts is None:
            raise FormatError("does not start like an OFF file; check what it is, or export it again")
        vertices, faces = int(counts[1]), int(counts[2])
        lines = sum(1 for line in data.splitlines() if line.strip() and not line.lstrip().startswith(b"#"))
        if len(data) == size and vertices + faces + 1 > lines:
            raise FormatError(
                f"its OFF header promises {vertices} vertices and {faces} faces but there are {lines} lines;"
                " the file is cut short or damaged, copy it again"
            )
    else:
        _check_glb(data, size)


def _check_glb(data: bytes, whole: int) -> None:
    if len(data) < 20 or data[:4] != b"glTF":
        raise FormatError("does not start like a GLB file; check what it is, or export it again")
    _, length, size = struct.unpack_from("<III", data, 4)
    if length > whole or size > whole - 20:
        raise FormatError(
            f"its GLB header promises {length} bytes but there are {whole};"
            " the file is cut short, copy it again"
        )
    if len(data) < 20 + size:
        return
    try:
        content = json.loads(data[20 : 20 + size])
        # An accessor without data means zeros, as many as it likes to promise.
        counts = [int(a["count"]) if "bufferView" in a else -1 for a in content.get("accessors", [])]
        outside = [b for b in content.get("buffers", []) + content.get("images", []) if "uri" in b]
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError):
        raise FormatError("its GLB description is damaged; export it again") from None
    if any(not 0 <= count <= whole for count in counts):
        raise FormatError("its GLB description promises data the file does not hold; export it again")
    if any(not str(b["uri"]).startswith("data:") for b in outside):
        raise FormatError("refers to other files, which are never opened; export it as one GLB")
