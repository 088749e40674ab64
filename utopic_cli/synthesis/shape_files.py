"""A file of a mesh or a cloud as a triangle mesh."""

from __future__ import annotations

import io
import logging
import os
import re
from pathlib import Path
from typing import Any

import numpy as np

from utopic_cli.errors import InputError
from utopic_cli.io.files import read_bytes
from utopic_cli.io.mesh import read_mesh
from utopic_cli.io.obj import read_obj
from utopic_cli.io.ply import read_ply
from utopic_cli.io.ply_header import parse_header
from utopic_cli.io.records import FormatError
from utopic_cli.io.scan import check_points, read_scan
from utopic_cli.synthesis.reconstruction import mesh_from_points
from utopic_cli.synthesis.surface import DegenerateShape

MESH_SUFFIXES = (".ply", ".obj", ".stl", ".off", ".glb", ".gltf", ".dae")
TEXT_SUFFIXES = (".txt", ".asc", ".csv")
CLOUD_SUFFIXES = (".pcd", ".xyz", ".pts", *TEXT_SUFFIXES)
# Many files of the ModelNet40 meshes lack the line break after the first word.
_GLUED_OFF = re.compile(rb"\A\s*OFF(?=\d)")
NO_SHAPE = "is text without points, no shape"
"""Reason for not using a file that nobody would take for a shape: a readme, a licence."""

_THREE_NUMBERS = re.compile(rb"(?<![\w.])(?:[-+]?\.?\d[\d.eE+-]*[ \t,;]+){2}[-+]?\.?\d")
_PACKAGES = {"dae": "pycollada"}


def find_shape_files(root: Path) -> list[Path]:
    """List the files below a folder that may hold a shape, sorted; hidden ones left out."""
    found = []
    for folder, folders, names in os.walk(root):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        found += [
            Path(folder, name)
            for name in names
            if not name.startswith(".") and Path(name).suffix.lower() in MESH_SUFFIXES + CLOUD_SUFFIXES
        ]
    return sorted(found)


def read_shape(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read a file as one triangle mesh; points without faces are joined to a surface.

    The strict readers of ``io`` see PLY, OBJ, STL, OFF, GLB and clouds first, so that damaged
    files are refused and not half read.

    Args:
        path: its suffix, one of ``MESH_SUFFIXES`` or ``CLOUD_SUFFIXES``, says the format.

    Returns:
        vertices: (V, 3) float64, in the file's frame and units.
        faces: (F, 3) int64.

    Raises:
        DegenerateShape: the file can't be used; says why in a few words, without its name.
    """
    kind = path.suffix.lower()[1:]
    try:
        if f".{kind}" in CLOUD_SUFFIXES:
            return mesh_from_points(read_scan(path).cloud.points)
        data = read_bytes(path)
        points = _read_strictly(data, kind)
        if kind != "ply" or _has_faces(data):
            vertices, faces = _read_faces(data, kind, path)
            if len(faces):
                return vertices, faces
            points = vertices if points is None else points
        assert points is not None  # every format but those that trimesh alone reads
        finite = points[np.isfinite(points).all(axis=1)]
        check_points(finite, len(points))
        return mesh_from_points(finite)
    except InputError as error:
        if f".{kind}" in TEXT_SUFFIXES and path.is_file() and _is_prose(path.read_bytes()):
            raise DegenerateShape(NO_SHAPE) from error
        raise DegenerateShape(str(error).removeprefix(f"{path}: ")) from error
    except FormatError as error:
        raise DegenerateShape(str(error)) from error
    except MemoryError as error:
        raise DegenerateShape("is too large for this machine's memory") from error


def _is_prose(text: bytes) -> bool:
    """Tell whether a file begins with text (not empty) of which no line holds three numbers in a row."""
    start = text[:4096]
    return bool(start.strip()) and b"\0" not in start and _THREE_NUMBERS.search(start) is None


def _read_strictly(data: bytes, kind: str) -> np.ndarray | None:
    """Return the points that the strict reader of a format finds; None where there is none."""
    if kind == "ply":
        return read_ply(data).points
    if kind == "obj":
        return read_obj(data).points
    if kind in ("stl", "off", "glb"):
        return read_mesh(_GLUED_OFF.sub(b"OFF\n", data), kind, np.random.default_rng(0)).points
    return None


def _has_faces(ply: bytes) -> bool:
    return any(element.name == "face" and element.count for element in parse_header(ply).elements)


def _read_faces(data: bytes, kind: str, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and triangles through trimesh; a scene is one mesh."""
    import trimesh  # heavy, and not needed for packed shapes

    options: dict[str, Any] = {"file_type": kind, "process": False}
    if kind in ("gltf", "dae"):  # their geometry may lie in files beside them
        options["resolver"] = trimesh.resolvers.FilePathResolver(str(path))
    logger = logging.getLogger("trimesh")  # what goes wrong is raised as well
    before, logger.disabled = logger.disabled, True
    try:
        scene: Any = trimesh.load(io.BytesIO(_GLUED_OFF.sub(b"OFF\n", data)), **options)
        whole: Any = scene.to_mesh() if isinstance(scene, trimesh.Scene) else scene
        vertices = np.asarray(whole.vertices, np.float64).reshape(-1, 3)
        faces = np.asarray(getattr(whole, "faces", np.empty((0, 3))), np.int64)
    except ModuleNotFoundError as error:
        package = _PACKAGES.get(kind, error.name)
        raise FormatError(f"{kind.upper()} files need another package: pip install {package}") from error
    except Exception as error:  # trimesh raises whatever its parsing meets
        reason = " ".join(str(error).split())[:80] or type(error).__name__
        raise FormatError(f"can't be read as {kind.upper()} ({reason})") from error
    finally:
        logger.disabled = before
    return vertices, faces
