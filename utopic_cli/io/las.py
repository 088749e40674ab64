"""LAS, and LAZ where lazrs is installed: every record, dimension and variable length record is kept.

A file's coordinates are integers on a grid (scale and offset). A moved file gets a grid ten times
finer than the finest of the old one, so that rounding stays below a twentieth of what the file could
tell apart; where that would not fit into 32 bits, a coarser one. A shift alone moves the grid and
leaves the integers as they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from utopic_cli.io.columns import Column
from utopic_cli.io.las_header import LasHeader, parse_header
from utopic_cli.io.laz import compress, decompress
from utopic_cli.io.records import Motion, Records

_LARGEST = 2**31 - 2  # of an integer coordinate, with room for rounding
_FINER = 10.0
_STEPS = 1e6  # the offset is a whole number of this many grid steps


@dataclass(frozen=True)
class _Las:
    data: bytes
    block: bytearray | memoryview  # the point records, decompressed
    header: LasHeader
    normals: tuple[Column, ...]

    def rewrite(self, motion: Motion) -> bytes:
        header = self.header
        block = bytearray(self.block)
        integers = _integers(block, header)
        rotation, translation = motion.transformation[:3, :3], motion.transformation[:3, 3]
        if (rotation == np.eye(3)).all():
            scale, offset = header.scale, header.offset + translation
        else:
            scale, offset = _grid(motion.points, header.scale)
            integers[:] = np.rint((motion.points - offset) / scale)
        ends = np.stack([integers.min(axis=0), integers.max(axis=0)]) * scale + offset
        for axis, column in enumerate(self.normals):
            if motion.normals is not None and motion.normal_rows is not None:
                column.write(block, motion.normals[:, axis], motion.normal_rows)
        head = header.rewritten(self.data, scale, offset, ends[0], ends[1])
        if not header.compressed:
            return b"".join([head, block, self.data[header.points_at + len(block) :]])
        return compress(head, block, self.data, header)


def read_las(data: bytes) -> Records:
    """Read the points of a LAS or LAZ file, told apart by the header.

    Normals are read where extra bytes are named so (NormalX or nx and so on).

    Raises:
        FormatError: the file is not sound, or compressed and lazrs is not installed.
    """
    header, block = las_block(data)
    points = _integers(block, header) * header.scale + header.offset
    normals = tuple(
        Column(dtype, header.count, offset=place, stride=header.record_size)
        for dtype, place in header.normals(data)
    )
    warnings = ["the directions of its waveforms do not turn with its points"] * header.waveforms
    warnings += ["is COPC; moved, it is plain LAZ, since its octree no longer fits"] * header.octree
    values = np.stack([column.read(block) for column in normals], axis=1) if normals else None
    return Records(points, values, _Las(data, block, header, normals), tuple(warnings))


def las_block(data: bytes) -> tuple[LasHeader, bytearray | memoryview]:
    """Return a file's header and its point records, decompressed.

    Raises:
        FormatError: see ``read_las``.
    """
    header = parse_header(data)
    if header.compressed:
        return header, decompress(data, header)
    return header, memoryview(data)[header.points_at : header.points_at + header.count * header.record_size]


def _integers(block: bytearray | memoryview, header: LasHeader) -> np.ndarray:
    """Return a view (count, 3) of the integer coordinates, which begin every record."""
    return np.ndarray((header.count, 3), "<i4", block, 0, (header.record_size, 4))


def _grid(points: np.ndarray, scale: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Choose (3,) scale and offset for (N, 3) points whose old scale is given."""
    low, high = points.min(axis=0), points.max(axis=0)
    finest = np.full(3, float(scale.min()) / _FINER)
    step = finest * _STEPS
    offset = np.rint((low + high) / 2 / step) * step
    reach = np.maximum(high - offset, offset - low)
    coarser = np.ceil(np.log10(np.maximum(reach / (finest * _LARGEST), 1.0)))
    return finest * 10.0**coarser, offset
