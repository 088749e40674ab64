"""A group of scans as one PLY, written scan by scan: one of them is in memory at a time."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from utopic_cli.errors import InputError
from utopic_cli.geometry.rigid import apply
from utopic_cli.io.output import open_atomically
from utopic_cli.io.scan import Scan, read_scan
from utopic_cli.multiway.colours import read_colours
from utopic_cli.multiway.scans import ScanFile

LAYOUT = np.dtype([("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("rgb", "u1", (3,)), ("scan", "<f4")])

_DIGITS = 18  # room for the number of points, which is known at the end
_CELL_BITS = 21  # of each coordinate of a cell in its 63-bit number
_GREY = 190


def write_merged(
    path: Path,
    group: Mapping[int, np.ndarray],
    files: Mapping[int, ScanFile],
    *,
    seed: int,
    voxel: float | None = None,
    overwrite: bool = False,
    progress: Callable[[str], None] | None = None,
) -> int:
    """Write the points of a group in its world frame; the field ``scan`` says whose a point is.

    A scan with colours in its file keeps them; the points of one without get a colour of the scan's
    own if no scan has any, grey otherwise.

    Args:
        path: a PLY, binary, coordinates in double precision.
        group: T_world_scan (4, 4) by scan; numbers are those of the field ``scan``.
        files: of the scans.
        seed: of the points drawn from meshes.
        voxel: keep one point, the first, in each cell of this edge length, in the files' unit.
        overwrite: whether an existing file may be replaced.
        progress: called with a word on each scan.

    Returns:
        The number of points written.

    Raises:
        InputError: a scan can't be read any more, or the cells are too small for the model.
        OutputError: the file can't be written.
    """
    total = 0
    seen: np.ndarray = np.empty(0, np.int64)
    origin: np.ndarray | None = None
    comments = [f"scan {number}: {files[number].name}" for number in group]
    with open_atomically(path, overwrite=overwrite) as stream:
        stream.write(_header(0, comments))
        for number, transformation in group.items():
            if progress is not None:
                progress(f"merging {files[number].name}")
            scan = read_scan(files[number].path, seed=seed)
            if scan.sha256 != files[number].sha256:
                raise InputError(f"{scan.path}: has changed since it was aligned; run again")
            table = _table(scan, number, transformation)
            if voxel is not None:
                cells, origin = _cells(table, voxel, origin)
                fresh, first = np.unique(cells, return_index=True)
                new = ~np.isin(fresh, seen, assume_unique=True)
                seen = np.concatenate([seen, fresh[new]])
                table = table[np.sort(first[new])]
            stream.write(table.tobytes())
            total += len(table)
        stream.seek(0)
        stream.write(_header(total, comments))
    return total


def _table(scan: Scan, number: int, transformation: np.ndarray) -> np.ndarray:
    table = np.empty(len(scan.cloud), LAYOUT)
    points = apply(transformation, scan.cloud.points)
    for axis, name in enumerate("xyz"):
        table[name] = points[:, axis]
    colours = read_colours(scan)
    table["rgb"] = colours if colours is not None else _GREY
    table["scan"] = number
    return table


def _cells(table: np.ndarray, voxel: float, origin: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Return one number for the cell of each point, and the grid's origin."""
    points = np.stack([table[name] for name in "xyz"], axis=1)
    if origin is None:
        origin = points.mean(axis=0)
    half = 1 << (_CELL_BITS - 1)
    steps = np.floor((points - origin) / voxel)
    if np.abs(steps).max() >= half:
        raise InputError(f"cells of {voxel:g} are too small for a model of this size; choose larger ones")
    x, y, z = (steps.astype(np.int64) + half).T
    return (x << (2 * _CELL_BITS)) | (y << _CELL_BITS) | z, origin


def _header(count: int, comments: list[str]) -> bytes:
    # The header keeps its length when the count is filled in.
    padding = "." * (_DIGITS - len(str(count)))
    lines: list[Any] = ["ply", "format binary_little_endian 1.0", f"comment utopic merged scans {padding}"]
    lines += [f"comment {line.encode('ascii', 'backslashreplace').decode()}" for line in comments]
    lines += [f"element vertex {count}", *(f"property double {name}" for name in "xyz")]
    lines += [f"property uchar {name}" for name in ("red", "green", "blue")]
    lines += ["property float scan", "end_header", ""]
    return "\n".join(lines).encode("ascii")
