"""A group of scans as one PLY, written scan by scan: one of them is in memory at a time."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from utopic_cli.errors import InputError
from utopic_cli.geometry.rigid import apply
from utopic_cli.io.files import read_bytes
from utopic_cli.io.output import open_atomically
from utopic_cli.io.ply_writer import property_name
from utopic_cli.io.records import FormatError
from utopic_cli.io.scan import Scan, read_scan
from utopic_cli.multiway.colours import colour_fields, colours_of, has_colours, scan_colour
from utopic_cli.multiway.fields import COLOURS, PACKED, SAMPLE_BYTES, Fields, find_fields, sample_size
from utopic_cli.multiway.scans import ScanFile

_DIGITS = 18  # room for the number of points, which is known at the end
_CELL_BITS = 21  # of each coordinate of a cell in its 63-bit number
_GREY = 190
_NO_SCALARS = {"nx", "ny", "nz", "normal_x", "normal_y", "normal_z", "normalx", "normaly", "normalz"}
_NO_SCALARS |= {*COLOURS, PACKED, "alpha", "a", "diffuse_alpha"}
_TYPES = {"<f4": "float", "<f8": "double"}
_SCAN = property_name("scan")


@dataclass(frozen=True)
class _Columns:
    """What a merged cloud says of a point besides its place.

    Attributes:
        fields: of each scan's file, by scan.
        scalars: what most files have: the name there, the property of the merged file, and its type.
        coloured: whether any scan has colours.
    """

    fields: Mapping[int, Fields]
    scalars: Sequence[tuple[str, str, str]]
    coloured: bool

    @property
    def layout(self) -> np.dtype:
        """A point's record."""
        own = [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("rgb", "u1", (3,)), (_SCAN, "<f4")]
        return np.dtype([*own, *((name, kind) for _, name, kind in self.scalars)])


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
    """Write the points of a group in its world frame; the field ``scalar_scan`` says whose a point is.

    A scan with colours in its file keeps them; the points of one without get a colour of the scan's
    own if no scan has any, grey otherwise. Scalar fields (intensity and the like) that more than half
    of the scans have are kept too, NaN where a scan has none; in double precision where float would
    round what a file declares.

    Args:
        path: a PLY, binary, coordinates in double precision.
        group: T_world_scan (4, 4) by scan; numbers are those of the field ``scalar_scan``.
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
    columns = _columns(files, list(group))
    with open_atomically(path, overwrite=overwrite) as stream:
        stream.write(_header(0, comments, columns))
        for number, transformation in group.items():
            if progress is not None:
                progress(f"merging {files[number].name}")
            scan = read_scan(files[number].path, seed=seed)
            if scan.sha256 != files[number].sha256:
                raise InputError(f"{scan.path}: has changed since it was aligned; run again")
            table = _table(scan, number, transformation, columns)
            del scan
            if voxel is not None:
                cells, origin = _cells(table, voxel, origin)
                fresh, first = np.unique(cells, return_index=True)
                places = np.searchsorted(seen, fresh)
                new = np.ones(len(fresh), bool)
                inside = places < len(seen)
                new[inside] = seen[places[inside]] != fresh[inside]
                seen = np.insert(seen, places[new], fresh[new])  # stays sorted
                table = table[np.sort(first[new])]
            stream.write(table.tobytes())
            total += len(table)
        stream.seek(0)
        stream.write(_header(total, comments, columns))
    return total


def fields_lost(files: Iterable[ScanFile]) -> tuple[str, ...]:
    """Say of which files a merged cloud can't keep what they have besides points, and why.

    Raises:
        InputError: a file can't be read any more.
    """
    lost = {file.path: _fields_of(file.path).lost for file in files}
    said = "its colours and scalar fields are not in the merged cloud"
    return tuple(f"{path}: {said}: {why}" for path, why in lost.items() if why)


def _columns(files: Mapping[int, ScanFile], group: Sequence[int]) -> _Columns:
    """Ask all files of a group, by their beginnings, what they say of their points."""
    fields = {number: _fields_of(files[number].path) for number in group}
    kinds: dict[str, set[np.dtype]] = {}
    having: Counter[str] = Counter()
    for found in fields.values():
        for name in found.dtypes.keys() - _NO_SCALARS:
            having[name] += 1
            kinds.setdefault(name, set()).add(found.dtypes[name])
    # In the order of the first file that has them, so that like runs give like files.
    order = dict.fromkeys(name for found in fields.values() for name in found.dtypes)
    scalars = []
    taken = {_SCAN}
    for name in order:
        if 2 * having[name] <= len(group):
            continue
        plain = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_") or "field"
        while property_name(plain) in taken:
            plain += "_"
        taken.add(property_name(plain))
        exact = all(np.can_cast(kind, np.float32) for kind in kinds[name])
        scalars.append((name, property_name(plain), "<f4" if exact else "<f8"))
    return _Columns(fields, scalars, any(has_colours(found.dtypes) for found in fields.values()))


def _fields_of(path: Path) -> Fields:
    try:
        kind = path.suffix.lower()[1:]
        with open(path, "rb") as stream:
            sample = stream.read(SAMPLE_BYTES)
            more = sample_size(sample, kind, os.fstat(stream.fileno()).st_size) - len(sample)
            return find_fields(sample + stream.read(max(more, 0)), kind)
    except OSError as error:
        raise InputError(f"{path}: can't be read any more ({error.strerror}); run again") from None
    except (FormatError, ValueError, KeyError):
        return Fields(lost=f"its {kind.upper()} layout is unusual")


def _table(scan: Scan, number: int, transformation: np.ndarray, columns: _Columns) -> np.ndarray:
    table = np.empty(len(scan.cloud), columns.layout)
    points = apply(transformation, scan.cloud.points)
    for axis, name in enumerate("xyz"):
        table[name] = points[:, axis]
    fields = columns.fields[number]
    colours = colour_fields(fields.dtypes)
    wanted = [name for name, _, _ in columns.scalars if name in fields.dtypes]
    values: dict[str, np.ndarray] = {}
    if colours or wanted:
        try:
            values = fields.read(read_bytes(scan.path), scan.records, [*colours, *wanted])
        except (FormatError, ValueError) as error:
            raise InputError(f"{scan.path}: {error}") from None
    kept = slice(None) if len(scan.kept) == scan.records else scan.kept
    if colours:
        table["rgb"] = colours_of({name: values[name][kept] for name in colours})
    else:
        table["rgb"] = _GREY if columns.coloured else scan_colour(number)
    table[_SCAN] = number
    for name, written, _ in columns.scalars:
        with np.errstate(invalid="ignore"):
            table[written] = values[name][kept] if name in values else np.nan
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


def _header(count: int, comments: list[str], columns: _Columns) -> bytes:
    # The header keeps its length when the count is filled in.
    padding = "." * (_DIGITS - len(str(count)))
    lines: list[Any] = ["ply", "format binary_little_endian 1.0", f"comment utopic merged scans {padding}"]
    lines += [f"comment {line.encode('ascii', 'backslashreplace').decode()}" for line in comments]
    lines += [f"element vertex {count}", *(f"property double {name}" for name in "xyz")]
    lines += [f"property uchar {name}" for name in COLOURS]
    lines += [f"property float {_SCAN}"]
    lines += [f"property {_TYPES[kind]} {name}" for _, name, kind in columns.scalars]
    return "\n".join([*lines, "end_header", ""]).encode("ascii")
