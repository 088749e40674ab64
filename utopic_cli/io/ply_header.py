"""The header of a PLY file: elements, their properties, and the lines as they were."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from utopic_cli.io.records import FormatError

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("int64", "long"), "i8"),  # not in the specification, but written by some tools
    **dict.fromkeys(("uint64", "ulong"), "u8"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_COUNT = re.compile(r"\d{1,18}")


@dataclass(frozen=True)
class Property:
    """One property of an element.

    Attributes:
        name: lower case.
        dtype: type and byte order of the value, or of a list's entries.
        list_count: type of a list's length, or None for a single number.
        line: index of its line in the header.
    """

    name: str
    dtype: np.dtype
    list_count: np.dtype | None
    line: int


@dataclass(frozen=True)
class Element:
    """A promise of ``count`` records with these properties."""

    name: str
    count: int
    properties: tuple[Property, ...]

    @property
    def has_lists(self) -> bool:
        """Whether records may differ in length."""
        return any(p.list_count is not None for p in self.properties)

    @property
    def smallest(self) -> int:
        """Least bytes one record takes in a binary file."""
        return sum((p.list_count or p.dtype).itemsize for p in self.properties)


@dataclass(frozen=True)
class PlyHeader:
    """A parsed header.

    Attributes:
        order: ``<``, ``>``, or the empty string for ascii.
        elements: in file order.
        lines: the header's lines as they were, with their ends, ``end_header`` last.
        warnings: odd lines that were skipped.
    """

    order: str
    elements: tuple[Element, ...]
    lines: tuple[bytes, ...]
    warnings: tuple[str, ...]

    @property
    def size(self) -> int:
        """Bytes before the first record."""
        return sum(map(len, self.lines))

    def with_doubles(self, properties: list[Property]) -> bytes:
        """Return the header with some properties declared double, and a comment saying so."""
        lines = list(self.lines)
        for p in properties:
            line = lines[p.line]
            words = line.split()
            lines[p.line] = b" ".join([words[0], b"double", *words[2:]]) + line[len(line.rstrip()) :]
        if properties:
            names = b" ".join(p.name.encode("latin-1") for p in properties)
            end = lines[0][len(lines[0].rstrip()) :]
            lines.insert(-1, b"comment " + names + b" widened to double, not to lose detail" + end)
        return b"".join(lines)


def parse_header(data: bytes) -> PlyHeader:
    """Parse a PLY header.

    Raises:
        FormatError: it does not start with ``ply``, never ends, or declares nonsense.
    """
    lines = _split(data)
    order: str | None = None
    elements: list[tuple[str, int, list[Property]]] = []
    warnings = []
    for index, line in enumerate(lines[:-1]):
        text = line.decode("latin-1").strip()
        words = text.split()
        keyword = words[0] if words else "comment"
        if keyword in ("comment", "obj_info") or index == 0:
            continue
        if keyword == "format":
            if order is not None or len(words) < 2 or words[1] not in _ORDERS:
                raise FormatError(f"its header says '{text[:60]}', which is no PLY format; export it again")
            order = _ORDERS[words[1]]
            if words[2:] != ["1.0"]:
                warnings.append(f"PLY header says '{text[:60]}'; read as version 1.0")
        elif keyword == "element":
            if len(words) != 3 or not _COUNT.fullmatch(words[2]):
                raise FormatError(f"its header says '{text[:60]}', which is no element; export it again")
            elements.append((words[1], int(words[2]), []))
        elif keyword == "property":
            if order is None or not elements:
                raise FormatError(f"its header says '{text[:60]}' too early; export it again")
            elements[-1][2].append(_property(words, order, index))
        else:
            warnings.append(f"PLY header line '{text[:60]}' is unknown and was skipped")
    if order is None:
        raise FormatError("its PLY header has no format line; export it again")
    built = tuple(Element(name, count, tuple(properties)) for name, count, properties in elements)
    if len({element.name for element in built}) != len(built):
        raise FormatError("its PLY header has an element twice; export it again")
    for element in built:
        names = [p.name for p in element.properties]
        if len(set(names)) != len(names):
            raise FormatError(f"its PLY element '{element.name[:40]}' has a property twice; export it again")
    return PlyHeader(order, built, tuple(lines), tuple(warnings))


def _split(data: bytes) -> list[bytes]:
    """Return the header's lines with their ends, up to and with ``end_header``."""
    first = re.match(rb"ply[ \t]*(\r\n|\n|\r)", data)
    if first is None:
        raise FormatError("does not start like a PLY file; check what it is, or export it again")
    end = b"\r" if first[1] == b"\r" else b"\n"
    lines, position = [], 0
    while True:
        stop = data.find(end, position)
        if stop < 0:
            raise FormatError("its PLY header has no end_header; the file is cut short, copy it again")
        lines.append(data[position : stop + 1])
        position = stop + 1
        if lines[-1].strip() == b"end_header":
            return lines


def _property(words: list[str], order: str, line: int) -> Property:
    text = " ".join(words)[:60]
    is_list = len(words) == 5 and words[1] == "list"
    types = words[2:4] if is_list else words[1:2]
    if len(words) != (5 if is_list else 3) or any(name not in _TYPES for name in types):
        raise FormatError(f"its header says '{text}', which is no property; export it again")
    dtypes = [np.dtype((order or "<") + _TYPES[name]) for name in types]
    if is_list and dtypes[0].kind == "f":
        raise FormatError(f"its header says '{text}': a list's length must be an integer; export it again")
    return Property(words[-1].lower(), dtypes[-1], dtypes[0] if is_list else None, line)
