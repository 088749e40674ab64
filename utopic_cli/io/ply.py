"""PLY: ascii and both binary orders, any property types, lists and extra elements."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from utopic_cli.io.ascii_table import move_lines, parse_table
from utopic_cli.io.columns import Column, widen, write_columns
from utopic_cli.io.ply_header import Element, PlyHeader, Property, parse_header
from utopic_cli.io.records import FormatError, Motion, Records

_COORDINATES = ("x", "y", "z")
_NORMALS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"))


def read_ply(data: bytes) -> Records:
    """Read the vertices of a PLY file.

    Every count the header promises is checked against the bytes there are before anything of
    that size is allocated.

    Raises:
        FormatError: the header is unsound, or the data is not what it promises.
    """
    header = parse_header(data)
    vertex = vertex_of(header)
    wanted = _wanted(vertex)
    if header.order:
        return _read_binary(data, header, vertex, wanted)
    return _read_ascii(data, header, vertex, wanted)


def vertex_of(header: PlyHeader) -> Element:
    """Return the element that holds the points.

    Raises:
        FormatError: there is none, or it has no coordinates.
    """
    found = [element for element in header.elements if element.name == "vertex"]
    if len(found) != 1:
        raise FormatError(f"its PLY header has {len(found)} vertex elements, not one; export it again")
    single = {p.name for p in found[0].properties if p.list_count is None}
    if not single.issuperset(_COORDINATES):
        raise FormatError("its PLY vertices have no x, y and z; export them as points")
    return found[0]


def _wanted(vertex: Element) -> list[int]:
    """Return where among the vertex's properties x, y, z and, if whole, the normals are."""
    place = {p.name: i for i, p in enumerate(vertex.properties) if p.list_count is None}
    normals = next((names for names in _NORMALS if place.keys() >= set(names)), ())
    return [place[name] for name in (*_COORDINATES, *normals)]


# Binary ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _BinaryPly:
    data: bytes
    header: PlyHeader
    properties: tuple[Property, ...]  # x y z, then normals
    columns: tuple[Column, ...]  # theirs, offsets after the header

    def rewrite(self, motion: Motion) -> bytes:
        wide = motion.widened([p.dtype for p in self.properties], as_text=False)
        body = memoryview(self.data)[self.header.size :]
        columns: Sequence[Column] = self.columns
        if any(wide):
            block, columns = widen(body, columns, wide, self.header.order)
        else:
            block = bytearray(body)
        write_columns(block, columns, motion)
        doubles = [p for p, grows in zip(self.properties, wide) if grows]
        return self.header.with_doubles(doubles) + bytes(block)


def _read_binary(data: bytes, header: PlyHeader, vertex: Element, wanted: list[int]) -> Records:
    body = memoryview(data)[header.size :]
    position = 0
    columns: tuple[Column, ...] = ()
    for element in header.elements:
        places = wanted if element is vertex else []
        end, found = _walk(body, position, element, places, header.order)
        columns = found or columns
        position = end
    warnings = header.warnings
    if position < len(body):
        warnings += (f"{len(body) - position} bytes after the last PLY element were not read",)
    properties = tuple(vertex.properties[i] for i in wanted)
    values = np.stack([column.read(body) for column in columns], axis=1)  # (R, 3 or 6)
    normals = values[:, 3:] if len(wanted) == 6 else None
    return Records(values[:, :3], normals, _BinaryPly(data, header, properties, columns), warnings)


def _walk(
    body: memoryview, start: int, element: Element, wanted: list[int], order: str
) -> tuple[int, tuple[Column, ...]]:
    """Find an element's end and where its wanted properties are, checking it is all there."""
    left = len(body) - start
    if element.count * element.smallest > left:
        raise truncated(element, left // element.smallest)
    size = _uniform_size(body, start, element)
    if size is None:
        return _walk_lists(body, start, element, wanted, "big" if order == ">" else "little")
    offsets, offset = [], start
    for p in element.properties:
        offsets.append(offset)
        offset += p.dtype.itemsize
        if p.list_count is not None and element.count:
            entries = int(np.ndarray((), p.list_count, body, offset - p.dtype.itemsize))
            offset += p.list_count.itemsize + (entries - 1) * p.dtype.itemsize
    columns = [Column(element.properties[i].dtype, element.count, offsets[i], size) for i in wanted]
    return start + size * element.count, tuple(columns)


def _uniform_size(body: memoryview, start: int, element: Element) -> int | None:
    """Return the bytes of each record if all are alike (all triangles, say), else None."""
    if not element.has_lists or not element.count:
        return element.smallest
    offset, lengths = start, []  # (where the first record's list lengths are, their values)
    for p in element.properties:
        if p.list_count is None:
            offset += p.dtype.itemsize
            continue
        if offset + p.list_count.itemsize > len(body):
            return None
        entries = int(np.ndarray((), p.list_count, body, offset))
        lengths.append((offset, p.list_count, entries))
        offset += p.list_count.itemsize + max(entries, 0) * p.dtype.itemsize
    size = offset - start
    if start + size * element.count > len(body):
        return None
    for offset, dtype, entries in lengths:
        every = np.ndarray((element.count,), dtype, body, offset, (size,))
        if entries < 0 or (every != entries).any():
            return None
    return size


def _walk_lists(
    body: memoryview, start: int, element: Element, wanted: list[int], order: Literal["little", "big"]
) -> tuple[int, tuple[Column, ...]]:
    """Walk records of differing lengths one by one."""
    starts = np.empty((element.count, len(wanted)), np.int64)
    row_of = {place: row for row, place in enumerate(wanted)}
    layout = [(row_of.get(i), p.dtype.itemsize, p.list_count) for i, p in enumerate(element.properties)]
    position, total = start, len(body)
    for record in range(element.count):
        for row, size, length_type in layout:
            if row is not None:
                starts[record, row] = position
            if length_type is None:
                position += size
                continue
            length_size = length_type.itemsize
            raw = body[position : position + length_size]
            entries = int.from_bytes(raw, order, signed=length_type.kind == "i")
            if entries < 0:
                raise FormatError(f"its PLY {element.name} {record} has a list of {entries}; export it again")
            position += length_size + entries * size
        if position > total:
            raise truncated(element, record)
    columns = [
        Column(element.properties[i].dtype, element.count, starts=starts[:, row])
        for row, i in enumerate(wanted)
    ]
    return position, tuple(columns)


def truncated(element: Element, found: int) -> FormatError:
    """Return what to say of a file with fewer records than its header promises."""
    return FormatError(
        f"its PLY header promises {element.count} {element.name} records but there are at most {found};"
        " the file is cut short or damaged, copy it again"
    )


# Ascii -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _AsciiPly:
    data: bytes
    header: PlyHeader
    vertex: Element
    wanted: tuple[int, ...]

    def rewrite(self, motion: Motion) -> bytes:
        properties = [self.vertex.properties[i] for i in self.wanted]
        wide = motion.widened([p.dtype for p in properties], as_text=True)
        dtypes = [np.dtype("f8") if grows else p.dtype for p, grows in zip(properties, wide)]
        lines, spans = _ascii_lines(self.data, self.header)
        places = spans["vertex"]
        positions = _token_positions([lines[i] for i in places], self.vertex, list(self.wanted))
        move_lines(lines, places, positions, motion, dtypes)
        doubles = [p for p, grows in zip(properties, wide) if grows]
        return self.header.with_doubles(doubles) + _line_end(self.header).join(lines)


def _read_ascii(data: bytes, header: PlyHeader, vertex: Element, wanted: list[int]) -> Records:
    lines, spans = _ascii_lines(data, header)
    for element in header.elements:
        _check_last_record(element, lines, spans[element.name])
    vertex_lines = [lines[i] for i in spans["vertex"]]

    def label(i: int) -> str:
        return f"its PLY vertex {i}"

    if vertex.has_lists:
        positions = _token_positions(vertex_lines, vertex, wanted)
        picked = []
        for line, where in zip(vertex_lines, positions):
            tokens = line.split()
            picked.append(b" ".join([tokens[i] for i in where]))
        values = parse_table(picked, len(wanted), range(len(wanted)), label)
    else:
        values = parse_table(vertex_lines, len(vertex.properties), wanted, label)
    normals = values[:, 3:] if len(wanted) == 6 else None
    document = _AsciiPly(data, header, vertex, tuple(wanted))
    return Records(np.ascontiguousarray(values[:, :3]), normals, document, header.warnings)


def _line_end(header: PlyHeader) -> bytes:
    return b"\r" if header.lines[0].endswith(b"\r") else b"\n"


def _ascii_lines(data: bytes, header: PlyHeader) -> tuple[list[bytes], dict[str, list[int]]]:
    """Return the body's lines, and for each element which of them are its records."""
    lines = data[header.size :].split(_line_end(header))
    filled = [i for i, line in enumerate(lines) if line and not line.isspace()]
    spans, first = {}, 0
    for element in header.elements:
        count = element.count if element.properties else 0  # a record without values has no line
        if first + count > len(filled):
            raise truncated(element, len(filled) - first)
        spans[element.name] = filled[first : first + count]
        first += count
    return lines, spans


def _check_last_record(element: Element, lines: list[bytes], span: list[int]) -> None:
    """Refuse a file cut within a line: the last record of an element must be whole."""
    if span:
        last = len(span) - 1
        _, total = _record_positions(lines[span[-1]].split(), element, last)
        if total != len(lines[span[-1]].split()):
            raise FormatError(
                f"its PLY {element.name} {last} is not whole; the file is cut short or damaged, copy it again"
            )


def _token_positions(lines: list[bytes], element: Element, wanted: list[int]) -> list[list[int]]:
    """Return for each record which of its tokens are the wanted properties."""
    if not element.has_lists:
        return [wanted] * len(lines)
    positions = []
    for record, line in enumerate(lines):
        tokens = line.split()
        where, total = _record_positions(tokens, element, record)
        if total != len(tokens):
            raise FormatError(f"its PLY {element.name} {record} has {len(tokens)} values; export it again")
        positions.append([where[i] for i in wanted])
    return positions


def _record_positions(tokens: list[bytes], element: Element, record: int) -> tuple[list[int], int]:
    """Return the token at which each property starts, and how many tokens belong."""
    where, position = [], 0
    for p in element.properties:
        where.append(position)
        if p.list_count is not None:
            token = tokens[position] if position < len(tokens) else b""
            if not token.isdigit() or len(token) > 18:
                raise FormatError(f"its PLY {element.name} {record} has no list length; export it again")
            position += int(token)
        position += 1
    return where, position
