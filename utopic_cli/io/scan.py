"""A scan file: read once, checked, and written again with its points moved."""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from utopic_cli.errors import InputError
from utopic_cli.io.e57 import read_e57
from utopic_cli.io.files import read_bytes
from utopic_cli.io.las import read_las
from utopic_cli.io.mesh import read_mesh
from utopic_cli.io.obj import read_obj
from utopic_cli.io.pcd import read_pcd
from utopic_cli.io.ply import read_ply
from utopic_cli.io.records import FormatError, Records
from utopic_cli.io.text import read_text
from utopic_cli.point_cloud import PointCloud

_log = logging.getLogger(__name__)

FEWEST_POINTS = 50
# Spread across the second axis, relative to the first, below which points lie on a line.
_LINE = 1e-5
_LARGEST_COORDINATE = 1e100  # beyond it squares overflow, and nothing was measured

TEXTS = ("xyz", "txt", "pts", "asc", "csv")
MESHES = ("stl", "off", "glb")
_READERS: dict[str, Callable[[bytes], Records]] = {
    "ply": read_ply,
    "pcd": read_pcd,
    "obj": read_obj,
    **dict.fromkeys(("las", "laz"), read_las),
    "e57": read_e57,
    **dict.fromkeys(TEXTS, read_text),
}
SUFFIXES = tuple(f".{name}" for name in (*_READERS, *MESHES))


@dataclass(frozen=True)
class Scan:
    """A scan file in memory.

    Attributes:
        path: where it was read from.
        cloud: its finite points, float64, file units; normals if the file has whole ones.
        kept: (N,) int64, the record of the file each point came from.
        records: how many records the file has.
        format: its suffix without the dot, lower case.
        sha256: of the file's bytes.
        warnings: what a user should know about it.
        document: the file kept whole; private to this room.
    """

    path: Path
    cloud: PointCloud
    kept: np.ndarray
    records: int
    format: str
    sha256: str
    warnings: tuple[str, ...]
    document: Records

    def moved(self, transformation: np.ndarray) -> bytes:
        """Return the file in its own format with coordinates and normals moved.

        Attributes, types, faces and comments are kept; records without a finite point stay
        as they are. Coordinates declared as integers, or as float32 where that would lose
        detail after the move, are widened to double and a comment says so.

        Args:
            transformation: (4, 4) rigid, ``p_moved = transformation @ p``.
        """
        return self.document.moved(transformation)


def read_scan(path: str | os.PathLike[str], *, seed: int = 0, to_align: bool = True) -> Scan:
    """Read a scan file strictly.

    Args:
        path: a regular file; its suffix says the format.
        seed: of the points drawn from a mesh (STL, OFF, GLB).
        to_align: refuse points that fix no transformation, and warn of what is left out; without
            it any file is read that can be moved.

    Raises:
        InputError: the file can't be read, is not sound, or (to align it) holds fewer than 50
            distinct finite points, or all on a line. One line: file, reason, what to do.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES and os.path.isfile(path):
        raise InputError(f"{path}: is no known scan format; use one of {' '.join(SUFFIXES)}")
    return parse_scan(path, read_bytes(path), seed=seed, to_align=to_align)


def parse_scan(path: Path, data: bytes, *, seed: int = 0, to_align: bool = True) -> Scan:
    """Parse the bytes of a scan file strictly; see ``read_scan``.

    Args:
        path: what to call it; its suffix, a known one, says the format.
        data: the whole file.
        seed: of the points drawn from a mesh.
        to_align: whether the points have to fix a transformation.

    Raises:
        InputError: it is not sound, or can't be aligned.
    """
    kind = path.suffix.lower()[1:]
    try:
        check_magic(data, kind)
        if kind in MESHES:
            records = read_mesh(data, kind, np.random.default_rng(seed))
        else:
            records = _READERS[kind](data)
        kept = np.flatnonzero(records.finite)
        points = records.points if len(kept) == len(records.points) else records.points[kept]
        if to_align:
            check_points(points, len(records.points))
        else:
            _check_coordinates(points, len(records.points))
    except FormatError as error:
        raise InputError(f"{path}: {printable_line(str(error))}") from None
    except MemoryError:
        raise InputError(f"{path}: is too large for this machine's memory; thin it out first") from None
    # A mesh that is only moved is moved itself, whatever was drawn from it.
    told = records.warnings if to_align or kind not in MESHES else ()
    warnings = [printable_line(warning) for warning in told]
    dropped = len(records.points) - len(kept)
    if dropped and to_align:
        warnings.append(f"{dropped} of {len(records.points)} points are NaN or infinite and were left out")
    normals = None
    if records.normals is not None:
        normals = _unit(records.normals[kept])
        if normals is None and to_align:
            warnings.append("its normals are not used: some are zero or not finite")
    _log.info("read %s: %d points", path, len(points))
    for warning in warnings:
        _log.warning("%s: %s", path, warning)
    digest = hashlib.sha256(data).hexdigest()
    cloud = PointCloud(np.ascontiguousarray(points), normals)
    return Scan(path, cloud, kept, len(records.points), kind, digest, tuple(warnings), records)


def check_magic(data: bytes, kind: str) -> None:
    """Refuse a file whose first bytes belong to another format than its suffix.

    Raises:
        FormatError: they do.
    """
    head = data[:64].lstrip()
    content = None
    if head.startswith((b"ply\n", b"ply\r")):
        content = "ply"
    elif head.startswith((b"# .PCD", b"VERSION 0.7", b"VERSION .7")):
        content = "pcd"
    elif head.startswith(b"glTF"):
        content = "glb"
    elif head.startswith(b"LASF"):
        content = kind if kind in ("las", "laz") else "las"
    elif head.startswith(b"ASTM-E57"):
        content = "e57"
    if content is not None and content != kind:
        raise FormatError(f"is a {content.upper()} file by its content; rename it to end in .{content}")


def check_points(points: np.ndarray, records: int, remedy: str = "export it again") -> None:
    """Refuse points that fix no transformation.

    Args:
        points: (N, 3) finite float64.
        records: how many points there were before those that are not finite were dropped.
        remedy: what to do about points that no scan has; an array is not exported.

    Raises:
        FormatError: too few distinct points, all on a line, or coordinates beyond all reason.
    """
    _check_coordinates(points, records, remedy)
    if (points == points[0]).all():
        raise FormatError(f"all of its {len(points)} points are equal; {remedy}")
    distinct = _count_distinct(points)
    if distinct < FEWEST_POINTS:
        raise FormatError(
            f"has {distinct} distinct finite points; at least {FEWEST_POINTS} are needed,"
            " use a denser scan (or a mesh as .stl, whose surface is sampled)"
        )
    centred = points - points.mean(axis=0)
    centred = centred / np.abs(centred).max()
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(centred.T @ centred), 0.0))  # ascending
    if spread[1] <= _LINE * spread[2]:
        raise FormatError("all of its points lie on a line; use a scan of a surface")


def _check_coordinates(points: np.ndarray, records: int, remedy: str = "export it again") -> None:
    if len(points) == 0:
        raise FormatError(f"none of its {records} points is finite; {remedy}")
    if np.abs(points).max() > _LARGEST_COORDINATE:
        raise FormatError(f"has coordinates beyond 1e100, which no scanner measures; {remedy}")


def _count_distinct(points: np.ndarray) -> int:
    """Count distinct points, exactly only where there are few."""
    thinned = points[:: max(1, len(points) // 1000)]
    count = len(np.unique(thinned, axis=0))
    return count if count >= FEWEST_POINTS else len(np.unique(points, axis=0))


def printable_line(message: str) -> str:
    """Return a message as one plain line, whatever of the file's bytes it quotes."""
    return "".join(c if c.isprintable() else "?" for c in message)


def _unit(normals: np.ndarray) -> np.ndarray | None:
    """Return (N, 3) normals at unit length, or None if any has none."""
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    if not np.isfinite(lengths).all() or (lengths == 0).any():
        return None
    return normals / lengths
