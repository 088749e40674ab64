"""PCD: ascii, binary and binary_compressed; organised clouds, padding fields, any sizes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from utopic_cli.io import lzf
from utopic_cli.io.ascii_table import move_lines, parse_table
from utopic_cli.io.columns import Column, widen, write_columns
from utopic_cli.io.pcd_header import PcdHeader, parse_header
from utopic_cli.io.records import FormatError, Motion, Records


def read_pcd(data: bytes) -> Records:
    """Read a PCD file; the promised counts are checked against the bytes there are.

    Raises:
        FormatError: the header is unsound, or the data is not what it promises.
    """
    header = parse_header(data)
    wanted = header.wanted()
    if header.encoding == "ascii":
        return _read_ascii(data, header, wanted)
    return _read_binary(data, header, wanted)


@dataclass(frozen=True)
class _BinaryPcd:
    header: PcdHeader
    block: bytes | bytearray | memoryview  # records, or fields one after the other if compressed
    rest: bytes  # whatever follows the records
    wanted: tuple[int, ...]
    columns: tuple[Column, ...]

    def rewrite(self, motion: Motion) -> bytes:
        wide = motion.widened([column.dtype for column in self.columns], as_text=False)
        columns: Sequence[Column] = self.columns
        if any(wide):
            block, columns = widen(memoryview(self.block), columns, wide, "<")
        else:
            block = bytearray(self.block)
        write_columns(block, columns, motion)
        head = self.header.rewritten(motion, [i for i, grows in zip(self.wanted, wide) if grows])
        if self.header.encoding == "binary":
            return head + bytes(block) + self.rest
        stream = lzf.store(block)
        return head + np.array([len(stream), len(block)], "<u4").tobytes() + stream


def _read_binary(data: bytes, header: PcdHeader, wanted: list[int]) -> Records:
    promised = header.points * header.record_size
    compressed = header.encoding == "binary_compressed"
    block: bytearray | memoryview
    if compressed:
        block, end = _unpack(data, header.size, promised)
    else:
        left = len(data) - header.size
        if promised > left:
            raise truncated(header, left // header.record_size)
        end = header.size + promised
        block = memoryview(data)[header.size : end]
    columns = []
    for field in wanted:
        before = sum(d.itemsize * c for d, c in zip(header.dtypes[:field], header.counts[:field]))
        dtype = header.dtypes[field]
        if compressed:  # all x, then all y, ...
            columns.append(Column(dtype, header.points, before * header.points, dtype.itemsize))
        else:
            columns.append(Column(dtype, header.points, before, header.record_size))
    values = np.stack([column.read(block) for column in columns], axis=1)  # (R, 3 or 6)
    normals = values[:, 3:] if len(wanted) == 6 else None
    warnings = header.warnings
    rest = data[end:]
    if rest.strip(b"\0\r\n "):
        warnings += (f"{len(rest)} bytes after the last PCD point were not read",)
    document = _BinaryPcd(header, block, rest, tuple(wanted), tuple(columns))
    return Records(values[:, :3], normals, document, warnings)


def _unpack(data: bytes, start: int, promised: int) -> tuple[bytearray, int]:
    """Decompress the records; returns them and where the stream ends."""
    packed = check_packed(data, start, promised, len(data))
    return lzf.decompress(data[start + 8 : start + 8 + packed], promised), start + 8 + packed


def check_packed(data: bytes, start: int, promised: int, size: int) -> int:
    """Compare what a PCD's compressed data promises with its header and the size of the file.

    Args:
        data: the file, or its beginning up to 8 bytes behind its header.
        start: bytes of the header.
        promised: bytes of all records.
        size: of the file, in bytes.

    Returns:
        The bytes of the compressed data.

    Raises:
        FormatError: they don't fit.
    """
    if size - start < 8:
        raise FormatError("its compressed data is missing; the file is cut short, copy it again")
    packed, unpacked = (int(n) for n in np.frombuffer(data, "<u4", 2, start))
    if size - start - 8 < packed:
        raise FormatError(
            f"it promises {packed} bytes of compressed data but there are {size - start - 8};"
            " the file is cut short, copy it again"
        )
    if unpacked != promised or promised > packed * lzf.LARGEST_EXPANSION:
        raise FormatError(
            f"its PCD header promises {promised} bytes of points but its compressed data holds"
            f" {min(unpacked, packed * lzf.LARGEST_EXPANSION)}; export it again"
        )
    return packed


def truncated(header: PcdHeader, found: int) -> FormatError:
    """Return what to say of a file with fewer points than its header promises."""
    return FormatError(
        f"its PCD header promises {header.points} points but there are {found};"
        " the file is cut short or damaged, copy it again"
    )


@dataclass(frozen=True)
class _AsciiPcd:
    data: bytes
    header: PcdHeader
    wanted: tuple[int, ...]
    positions: tuple[int, ...]  # their tokens in a line

    def rewrite(self, motion: Motion) -> bytes:
        declared = [self.header.dtypes[i] for i in self.wanted]
        wide = motion.widened(declared, as_text=True)
        dtypes = [np.dtype("f8") if grows else dtype for dtype, grows in zip(declared, wide)]
        lines, places = _ascii_lines(self.data, self.header)
        move_lines(lines, places, [self.positions] * len(places), motion, dtypes)
        head = self.header.rewritten(motion, [i for i, grows in zip(self.wanted, wide) if grows])
        return head + b"\n".join(lines)


def _read_ascii(data: bytes, header: PcdHeader, wanted: list[int]) -> Records:
    lines, span = _ascii_lines(data, header)
    positions = [sum(header.counts[:field]) for field in wanted]
    points = [lines[i] for i in span]
    values = parse_table(points, sum(header.counts), positions, lambda i: f"its PCD point {i}")  # (R, 3 or 6)
    normals = values[:, 3:] if len(wanted) == 6 else None
    document = _AsciiPcd(data, header, tuple(wanted), tuple(positions))
    return Records(np.ascontiguousarray(values[:, :3]), normals, document, header.warnings)


def _ascii_lines(data: bytes, header: PcdHeader) -> tuple[list[bytes], list[int]]:
    """Return the body's lines and which of them are points."""
    lines = data[header.size :].split(b"\n")
    filled = [i for i, line in enumerate(lines) if line and not line.isspace()]
    if len(filled) < header.points:
        raise truncated(header, len(filled))
    return lines, filled[: header.points]
