"""Transformations as rows of numbers, told apart by how many there are and how long they are."""

from __future__ import annotations

import numpy as np

from utopic_cli.io.ascii_table import is_number, parse_table
from utopic_cli.io.quaternion import rigid_of
from utopic_cli.io.records import FormatError
from utopic_cli.io.transformation_tree import Entries

_BRACKETS = bytes.maketrans(b"[](),;", b"      ")
_SHAPES = "4 rows of 4 numbers, or rows of 12 (KITTI), 8 (TUM: t tx ty tz qx qy qz qw) or 16"


def entries_of_rows(data: bytes) -> Entries:
    """Read 4x4 matrices, KITTI and TUM rows, Open3D's logs and PDAL's matrix string.

    Blanks separate the numbers; in matrices commas, semicolons and brackets may stand between
    them too (NumPy prints them). Lines that begin with ``#`` or ``//`` are comments.

    Raises:
        FormatError: the rows are none of these, or hold what is no number.
    """
    if b"\0" in data:
        raise FormatError("is no text; a .npy file should be named so")
    filled = [line.strip() for line in data.removeprefix(b"\xef\xbb\xbf").splitlines()]
    filled = [line for line in filled if line and not line.startswith((b"#", b"//"))]
    rows = [line.translate(_BRACKETS) for line in filled]
    rows = [row for row in rows if row.strip()]  # a bracket of its own on a line
    widths = [len(row.split()) for row in rows]

    def parse(first: int, last: int, width: int) -> np.ndarray:
        return parse_table(rows[first:last], width, range(width), lambda i: f"row {first + i + 1}")

    if len(rows) == 4 and set(widths) & {3, 4, 5} and set(widths) <= {3, 4, 5}:
        return [("", parse(0, 4, 4))]
    if widths == [16]:
        return [("", parse(0, 1, 16).reshape(4, 4))]
    if widths and len(widths) % 5 == 0 and set(widths[::5]) == {3}:
        blocks = range(0, len(rows), 5)
        return _numbered([parse(first + 1, first + 5, 4) for first in blocks])
    if set(widths) == {12}:
        return _numbered([_with_last_row(row) for row in parse(0, len(rows), 12)])
    if set(widths) == {8}:
        if any(b"," in line or b";" in line for line in filled):  # EuRoC's order is qw qx qy qz
            raise FormatError("has rows of 8 with commas; TUM's are separated by blanks, with qw last")
        poses = parse(0, len(rows), 8)
        return _numbered([rigid_of(pose[1:4], pose[4:]) for pose in poses])
    if not rows:
        raise FormatError(f"holds no numbers; a transformation is {_SHAPES}")
    word = _first_word(data)
    if word:
        raise FormatError(f"{word}; a transformation is {_SHAPES}")
    lengths = " or ".join(str(width) for width in sorted(set(widths))[:3])
    raise FormatError(f"has {len(rows)} rows of {lengths} numbers; a transformation is {_SHAPES}")


def _first_word(data: bytes) -> str:
    """Return which line holds the first word that is no number, and the word; empty if none does."""
    for number, line in enumerate(data.removeprefix(b"\xef\xbb\xbf").splitlines(), 1):
        if line.strip().startswith((b"#", b"//")):
            continue
        for word in line.translate(_BRACKETS).split():
            if not is_number(word):
                return f"line {number} holds '{word[:24].decode('utf-8', 'replace')}', which is no number"
    return ""


def _numbered(matrices: list[np.ndarray]) -> Entries:
    return [(str(number), matrix) for number, matrix in enumerate(matrices, 1)]


def _with_last_row(row: np.ndarray) -> np.ndarray:
    return np.concatenate([row.reshape(3, 4), [[0.0, 0.0, 0.0, 1.0]]])
