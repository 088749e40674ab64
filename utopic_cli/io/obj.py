"""OBJ: the vertices are the points; every other line is kept as it is."""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import repeat

import numpy as np

from utopic_cli.io.ascii_table import parse_table, replace_columns, texts_of
from utopic_cli.io.records import FormatError, Motion, Records

_DOUBLE = np.dtype("f8")  # OBJ declares no types
_FACE_CORNER = re.compile(rb"(?<=\s)(\d+)/\d*/(\d+)")


@dataclass(frozen=True)
class _Obj:
    data: bytes

    def rewrite(self, motion: Motion) -> bytes:
        lines = self.data.split(b"\n")
        _put(lines, _lines_of(lines, b"v"), motion.rows, motion.points)
        normal_lines = _lines_of(lines, b"vn")
        normals = _parse(lines, normal_lines, "normal")
        rows = np.isfinite(normals).all(axis=1)
        with np.errstate(invalid="ignore"):
            normals = normals @ motion.transformation[:3, :3].T
        _put(lines, normal_lines, rows, normals)
        return b"\n".join(lines)


def read_obj(data: bytes) -> Records:
    """Read the vertices of an OBJ file. Material libraries it names are never opened.

    Raises:
        FormatError: there are no vertices, or one is not three numbers.
    """
    if b"\0" in data:
        raise FormatError("holds binary data, not OBJ text; check what it is, or export it again")
    lines = data.split(b"\n")
    vertices = _lines_of(lines, b"v")
    if not vertices:
        raise FormatError("has no OBJ vertices ('v' lines); check what it is, or export it again")
    points = _parse(lines, vertices, "vertex")
    normals = _parse(lines, _lines_of(lines, b"vn"), "normal")
    per_vertex = len(normals) == len(points) and _normals_follow_vertices(lines)
    return Records(points, normals if per_vertex else None, _Obj(data))


def _lines_of(lines: list[bytes], keyword: bytes) -> list[int]:
    space, tab = keyword + b" ", keyword + b"\t"
    return [i for i, line in enumerate(lines) if line.lstrip().startswith((space, tab))]


def _parse(lines: list[bytes], places: list[int], noun: str) -> np.ndarray:
    """Return the first three numbers of some lines, (N, 3); colours and weights may follow."""
    picked = [b" ".join(lines[i].split(None, 4)[1:4]) for i in places]
    return parse_table(picked, 3, range(3), lambda i: f"its line {places[i] + 1}, an OBJ {noun},")


def _normals_follow_vertices(lines: list[bytes]) -> bool:
    """Tell whether faces, if any, give each vertex the normal of its own number."""
    return all(
        vertex == normal for i in _lines_of(lines, b"f") for vertex, normal in _FACE_CORNER.findall(lines[i])
    )


def _put(lines: list[bytes], places: list[int], rows: np.ndarray, values: np.ndarray) -> None:
    """Replace the first three numbers of some lines."""
    texts = texts_of(values, [_DOUBLE] * 3)
    new = replace_columns([lines[i] for i in places], repeat((1, 2, 3)), rows.tolist(), texts)
    for i, line in zip(places, new):
        lines[i] = line
