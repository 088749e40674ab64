"""What a scan file says of its points besides where they are: named numbers, one per record.

Which fields a file has is told by its beginning (E57: its end), so that all files of a batch can be
asked before any is read in earnest.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice

import numpy as np

from utopic_cli.io import lzf
from utopic_cli.io.ascii_table import is_number, parse_table
from utopic_cli.io.e57 import e57_document
from utopic_cli.io.las import las_block
from utopic_cli.io.las_header import parse_header as las_header
from utopic_cli.io.ply import vertex_of
from utopic_cli.io.ply_header import parse_header
from utopic_cli.io.records import FormatError

Values = dict[str, np.ndarray]

COLOURS = ("red", "green", "blue")
PACKED = "rgb"
"""PCD's three colours in the bits of one number."""

SAMPLE_BYTES = 1 << 20
"""Of most files this beginning says the fields; see ``sample_size``."""

_SAMPLE_LINES = 500
_LAS_POINTS = 96  # place in a LAS file of the number of bytes before its points
_DOUBLE = np.dtype("<f8")
_COORDINATES = ("x", "y", "z")
_NORMALS = {"nx", "ny", "nz", "normal_x", "normal_y", "normal_z"}
_SPELLINGS = {
    **{spelling: name for name in COLOURS for spelling in (name[0], f"diffuse_{name}")},
    "rgba": PACKED,
    "i": "intensity",
}


@dataclass(frozen=True)
class Fields:
    """A file's fields.

    Attributes:
        dtypes: as the file declares them, by name; names are lower case, those of colours
            ``red``, ``green``, ``blue`` whatever the file calls them; coordinates are none.
        read: takes the whole file's bytes, the number of its records, and names; returns (R,)
            values by name. Raises FormatError if the file is another than the one asked.
        lost: why what its points have besides can't be told, or None.
    """

    dtypes: Mapping[str, np.dtype] = field(default_factory=dict)
    read: Callable[[bytes, int, Sequence[str]], Values] = lambda data, records, names: {}
    lost: str | None = None


def sample_size(start: bytes, kind: str, size: int) -> int:
    """Tell how many of a file's bytes ``find_fields`` takes.

    Args:
        start: the first ``SAMPLE_BYTES`` of a file, or the whole.
        kind: its suffix without the dot, lower case.
        size: of the file, in bytes.
    """
    if kind == "e57":  # what it holds is said at its end
        return size
    says = int.from_bytes(start[_LAS_POINTS : _LAS_POINTS + 4], "little") if kind in ("las", "laz") else 0
    return min(size, max(SAMPLE_BYTES, says))


def find_fields(sample: bytes, kind: str) -> Fields:
    """Tell a file's fields from its beginning.

    Args:
        sample: the first bytes of a sound file, ``sample_size`` of them.
        kind: its suffix without the dot, lower case.

    Returns:
        No fields, but why they are lost, for layouts that are not known here: PLY whose vertices
        hold lists or don't come first. None for meshes, whose points are drawn.

    Raises:
        FormatError: the beginning is too short to tell.
    """
    if kind == "ply":
        return _ply_fields(sample)
    if kind == "pcd":
        return _pcd_fields(sample)
    if kind == "obj":
        return _obj_fields(sample)
    if kind in ("las", "laz"):
        return _las_fields(sample)
    if kind == "e57":
        return _e57_fields(sample)
    return _text_fields(sample) if kind in ("xyz", "txt", "pts", "asc", "csv") else Fields()


def _named(names: Sequence[str]) -> dict[str, int]:
    """Return where each field is, under one spelling; coordinates and fields without a name left out."""
    places: dict[str, int] = {}
    for i, name in enumerate(names):
        plain = name.strip().lower().removeprefix("scalar_")  # CloudCompare's prefix
        plain = _SPELLINGS.get(plain, plain)
        if plain and plain != "_" and plain not in _COORDINATES:
            places.setdefault(plain, i)
    return places


def _from_table(
    lines: Sequence[bytes],
    columns: int,
    places: Mapping[str, int],
    names: Sequence[str],
    delimiter: bytes | None = None,
) -> Values:
    """Parse columns of text; one that is not all numbers, a label or empty cells, is all NaN."""
    wanted = [places[name] for name in names]
    try:
        table = parse_table(lines, columns, wanted, lambda i: f"its record {i}", delimiter)
    except FormatError:
        if len(names) <= 1:
            return {name: np.full(len(lines), np.nan) for name in names}
        one_by_one = (_from_table(lines, columns, places, [name], delimiter) for name in names)
        return {name: values for found in one_by_one for name, values in found.items()}
    return {name: table[:, i] for i, name in enumerate(names)}


def _content(data: bytes, records: int) -> list[bytes]:
    lines = [line for line in data.splitlines() if line.strip()][:records]
    if len(lines) < records:
        raise _changed()
    return lines


def _changed() -> FormatError:
    return FormatError("has changed while it was read; run again")


def _ply_fields(sample: bytes) -> Fields:
    header = parse_header(sample)
    vertex = vertex_of(header)
    places = _named([p.name for p in vertex.properties])
    if vertex is not header.elements[0] or vertex.has_lists:
        why = "its PLY vertices hold lists" if vertex.has_lists else "its PLY vertices don't come first"
        return Fields(lost=why if places.keys() - _NORMALS else None)
    layout = np.dtype([(p.name, p.dtype) for p in vertex.properties])

    def read(data: bytes, records: int, names: Sequence[str]) -> Values:
        body = memoryview(data)[header.size :]
        if vertex.count != records or len(body) < (layout.itemsize * records if header.order else 0):
            raise _changed()
        if not header.order:
            return _from_table(_content(bytes(body), records), len(vertex.properties), places, names)
        table = np.frombuffer(body, layout, records)
        return {name: table[vertex.properties[places[name]].name] for name in names}

    return Fields({name: vertex.properties[i].dtype for name, i in places.items()}, read)


def _las_fields(sample: bytes) -> Fields:
    found = las_header(sample, whole=False).fields(sample)
    known = list(found)
    places = {name: found[known[i]] for name, i in _named(known).items()}

    def read(data: bytes, records: int, names: Sequence[str]) -> Values:
        header, block = las_block(data)
        if header.count != records:
            raise _changed()
        step = (header.record_size,)
        wanted = {name: places[name] for name in names}
        return {n: np.ndarray((records,), f.dtype, block, f.place, step) for n, f in wanted.items()}

    return Fields({name: place.dtype for name, place in places.items()}, read)


def _e57_fields(sample: bytes) -> Fields:
    def read(data: bytes, records: int, names: Sequence[str]) -> Values:
        found = e57_document(data).fields(records)
        return {name: found[name] for name in names}

    return Fields(dict.fromkeys(e57_document(sample).field_names(), _DOUBLE), read)


def _pcd_fields(sample: bytes) -> Fields:
    words: dict[bytes, list[str]] = {}
    size = 0
    for line in sample.splitlines(keepends=True):
        size += len(line)
        keyword, *rest = line.split() or [b"#"]
        words[keyword.upper()] = [word.decode("latin-1") for word in rest]
        if keyword.upper() == b"DATA":
            break
    named = words.get(b"FIELDS") or words.get(b"COLUMNS") or []
    counts = [int(count) for count in words.get(b"COUNT", ["1"] * len(named))]
    dtypes = [np.dtype(f"<{k.lower()}{n}") for k, n in zip(words[b"TYPE"], words[b"SIZE"], strict=True)]
    places = {name: i for name, i in _named(named).items() if counts[i] == 1}
    encoding = " ".join(words[b"DATA"]).lower()
    layout = np.dtype([(f"f{i}", d, (counts[i],)) for i, d in enumerate(dtypes)])

    def read(data: bytes, records: int, names: Sequence[str]) -> Values:
        body = memoryview(data)[size:]
        if encoding == "ascii":
            first = [sum(counts[:i]) for i in range(len(counts))]
            tokens = {name: first[i] for name, i in places.items()}
            values = _from_table(_content(bytes(body), records), sum(counts), tokens, names)
            with np.errstate(over="ignore", invalid="ignore"):
                return {name: values[name].astype(dtypes[places[name]]) for name in names}
        promised = records * layout.itemsize
        if encoding == "binary_compressed":
            packed = int.from_bytes(body[:4], "little")
            block: bytearray | memoryview = lzf.decompress(bytes(body[8 : 8 + packed]), promised)
            starts = np.cumsum([0, *(records * layout[i].itemsize for i in range(len(dtypes)))])
            return {
                name: np.frombuffer(block, dtypes[places[name]], records, int(starts[places[name]]))
                for name in names
            }
        if len(body) < promised:
            raise _changed()
        table = np.frombuffer(body, layout, records)
        return {name: table[f"f{places[name]}"][:, 0] for name in names}

    return Fields({name: dtypes[i] for name, i in places.items()}, read)


def _obj_fields(sample: bytes) -> Fields:
    first = next((line for line in sample.split(b"\n") if _is_vertex(line)), b"")
    if len(first.split()) != 7:
        return Fields()
    places = {name: 4 + i for i, name in enumerate(COLOURS)}

    def read(data: bytes, records: int, names: Sequence[str]) -> Values:
        lines = [b"0 " + line.split(None, 1)[1] for line in data.split(b"\n") if _is_vertex(line)]
        if len(lines) != records:
            raise _changed()
        return _from_table(lines, 7, places, names)

    return Fields(dict.fromkeys(places, _DOUBLE), read)


def _is_vertex(line: bytes) -> bool:
    return line.lstrip().startswith((b"v ", b"v\t"))


def _text_fields(sample: bytes) -> Fields:
    sample = sample.removeprefix(b"\xef\xbb\xbf")
    whole = sample if len(sample) < SAMPLE_BYTES - 3 else sample[: sample.rfind(b"\n") + 1]
    lines = [line.strip() for line in whole.splitlines()]
    rows = list(islice((line for line in lines if _is_point(line)), _SAMPLE_LINES))
    if not rows:
        return Fields()
    delimiter = b";" if b";" in rows[0] else b"," if b"," in rows[0] else None
    columns = len(rows[0].split(delimiter))
    above = [line for line in lines[: lines.index(rows[0])] if line and not line.isdigit()]
    header = above[-1].lstrip(b"#/ ") if above else b""
    names = [word.strip(b" \"'").decode("latin-1").lower() for word in header.split(delimiter)]
    if len(names) != columns or not set(names).issuperset(_COORDINATES):
        names = _guessed(rows, columns, delimiter)
    places = _named(names)
    numeric = [all(map(is_number, column)) for column in zip(*(row.split(delimiter) for row in rows))]
    places = {name: i for name, i in places.items() if numeric[i]}

    def read(data: bytes, records: int, names: Sequence[str]) -> Values:
        lines = [line for line in data.removeprefix(b"\xef\xbb\xbf").splitlines() if _is_point(line.strip())]
        if len(lines) < records:
            raise _changed()
        return _from_table(lines[:records], columns, places, names, delimiter)

    return Fields(dict.fromkeys(places, _DOUBLE), read)


def _is_point(line: bytes) -> bool:
    """Tell a line with a point from comments, names of columns and a count."""
    words = re.split(rb"[\s,;]+", line, maxsplit=3)
    return not line.startswith((b"#", b"//")) and len(words) >= 3 and any(map(is_number, words[:3]))


def _guessed(rows: Sequence[bytes], columns: int, delimiter: bytes | None) -> list[str]:
    """Name the columns of text without names, by what is usual: x y z, intensity, r g b, normals."""
    names = [*_COORDINATES, *(f"column_{i + 1}" for i in range(3, columns))]
    try:
        table = parse_table(rows, columns, range(columns), lambda i: "", delimiter)
    except FormatError:
        return names
    for first in (3, 4):
        three = table[:, first : first + 3]
        if three.shape[1] < 3:
            break
        if (three == np.rint(three)).all() and three.min() >= 0 and 1 < three.max() <= 255:
            names[first : first + 3] = COLOURS
            names[3:first] = ["intensity"] * (first - 3)
            return names
    if columns == 4:
        names[3] = "intensity"
    elif columns >= 6 and (np.abs(np.linalg.norm(table[:, 3:6], axis=1) - 1.0) < 1e-2).all():
        names[3:6] = ("nx", "ny", "nz")
    return names
