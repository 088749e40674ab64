"""Text that holds poses where points are expected: its rows would pass for points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from utopic_cli.io.ascii_table import parse_table
from utopic_cli.io.records import FormatError
from utopic_cli.io.transformation_rows import entries_of_rows

START_BYTES = 1 << 16
"""The beginning of a file that is looked at."""

_QUATERNION, _POINT = {"qw", "qx", "qy", "qz"}, {"x", "y", "z"}
_TOLERANCE = 1e-3  # of rotations and quaternions written with few digits
_MATRIX, _TABLE = "a 4x4 matrix", "a table of poses"


def poses_in(start: bytes) -> str | None:
    """Tell a transformation or a trajectory from points.

    Args:
        start: a text file, or at least ``START_BYTES`` of its beginning.

    Returns:
        What it is, in words; None for everything else.
    """
    text = start[:START_BYTES]
    if len(start) >= START_BYTES:
        text = text[: text.rfind(b"\n") + 1]  # the last line may be cut
    named = text.lower().split(b"\n", 1)[0].decode("latin-1").strip("#/ \r\ufeff")
    names = {name.strip(" \"'") for name in named.replace(";", ",").replace(" ", ",").split(",")}
    if names >= _QUATERNION and not names >= _POINT:  # points may carry an orientation each
        return _TABLE
    rows = [
        line for line in map(bytes.strip, text.splitlines()) if line and not line.startswith((b"#", b"//"))
    ]
    if rows and len(rows[0].split()) == 8:
        return _TABLE if _is_trajectory(rows) else None
    try:
        matrices = np.array([matrix for _, matrix in entries_of_rows(text)])  # (P, 4, 4)
    except (FormatError, ValueError):
        return None
    if not len(matrices) or not (np.abs(matrices[:, 3] - [0, 0, 0, 1]) <= _TOLERANCE).all():
        return None
    if len(matrices) == 1 and len(text.split()) == 16:
        return _MATRIX  # whatever its rotation: four rows are no scan
    return _TABLE if _are_rotations(matrices[:, :3, :3]) else None


def _are_rotations(matrices: np.ndarray) -> bool:
    """Tell whether all of (P, 3, 3) are rotations."""
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max()
    return bool(off <= _TOLERANCE and (np.linalg.det(matrices) > 0).all())


def _is_trajectory(rows: Sequence[bytes]) -> bool:
    """Tell TUM's rows: a rising time, a place, a unit quaternion with its scalar part last."""
    try:
        table = parse_table(rows, 8, range(8), str)
    except FormatError:
        return False
    unit = np.abs(np.linalg.norm(table[:, 4:], axis=1) - 1.0) <= _TOLERANCE
    # Three that are of unit length throughout are rather normals, and the fourth a further column.
    normals = np.abs(np.linalg.norm(table[:, 4:7], axis=1) - 1.0) <= _TOLERANCE
    return bool(unit.all() and (np.diff(table[:, 0]) > 0).all() and not normals.all())
