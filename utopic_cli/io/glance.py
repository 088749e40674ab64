"""A scan file at a glance: what its size and its first bytes already tell is wrong with it.

The readers' own words, but found without reading clouds whole; what takes more than a beginning to
tell is left to the readers.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path

from utopic_cli.io import las_header, pcd, pcd_header, ply, ply_header
from utopic_cli.io.e57_file import check_header as check_e57
from utopic_cli.io.files import EMPTY
from utopic_cli.io.mesh import check_promises
from utopic_cli.io.obj import read_obj
from utopic_cli.io.pose_rows import START_BYTES
from utopic_cli.io.records import FormatError
from utopic_cli.io.scan import MESHES, TEXTS, check_magic, printable_line
from utopic_cli.io.text import is_content, read_text

_LAS_POINTS = 96  # place of the number of bytes before the points
_FEWEST_LINES = 3  # names, a count, a point


def read_start(path: Path) -> tuple[bytes, int]:
    """Return the beginning of a regular file, and its size in bytes.

    Raises:
        OSError: it can't be read.
    """
    with open(path, "rb") as stream:
        return stream.read(START_BYTES), path.stat().st_size


def problem_at_start(start: bytes, size: int, kind: str) -> str | None:
    """Tell what is wrong with a scan file as far as its beginning shows.

    Args:
        start: its first ``START_BYTES``, or the whole.
        size: of the file, in bytes.
        kind: its suffix without the dot, lower case: one of the formats that are read.

    Returns:
        The reason and what to do, without the file's name; None if nothing is seen.
    """
    if not size:
        return EMPTY
    try:
        check_magic(start, kind)
        _CHECKS[kind](start, size)
    except FormatError as error:
        return printable_line(str(error))
    return None


def _check_ply(start: bytes, size: int) -> None:
    if len(start) < size and start[:3] == b"ply" and b"end_header" not in start:
        return
    header = ply_header.parse_header(start)
    ply.vertex_of(header)
    left = size - header.size
    for element in header.elements:
        # In text a value takes a digit and what parts it from the next.
        smallest = element.smallest if header.order else 2 * len(element.properties)
        if element.count * smallest > left + (not header.order):
            raise ply.truncated(element, left // smallest)
        left -= element.count * smallest


def _check_pcd(start: bytes, size: int) -> None:
    if len(start) < size and b"\n" not in start.partition(b"\nDATA")[2]:
        return
    header = pcd_header.parse_header(start)
    header.wanted()
    left = size - header.size
    if header.encoding == "binary_compressed":
        if len(start) == size or len(start) >= header.size + 8:
            pcd.check_packed(start, header.size, header.points * header.record_size, size)
        return
    smallest = header.record_size if header.encoding == "binary" else 2 * sum(header.counts)
    if header.points * smallest > left + (header.encoding == "ascii"):
        raise pcd.truncated(header, left // smallest)


def _check_las(start: bytes, size: int) -> None:
    if (
        len(start) < size
        and start[:4] == b"LASF"
        and struct.unpack_from("<I", start, _LAS_POINTS)[0] > len(start)
    ):
        return
    las_header.check_count(las_header.parse_header(start, whole=False), size)


def _check_text(start: bytes, size: int) -> None:
    if len(start) < size:
        start = start[: max(start.rfind(b"\n"), start.rfind(b"\r")) + 1]
        if sum(map(is_content, start.splitlines())) < _FEWEST_LINES:
            return
        read_text(start, whole=False)
    else:
        read_text(start)


def _check_obj(start: bytes, size: int) -> None:
    if len(start) == size or b"\0" in start:
        read_obj(start)


def _check_mesh(kind: str, start: bytes, size: int) -> None:
    check_promises(start, kind, size)


_CHECKS: dict[str, Callable[[bytes, int], None]] = {
    "ply": _check_ply,
    "pcd": _check_pcd,
    "obj": _check_obj,
    **dict.fromkeys(("las", "laz"), _check_las),
    "e57": check_e57,
    **dict.fromkeys(TEXTS, _check_text),
    **{kind: partial(_check_mesh, kind) for kind in MESHES},
}
