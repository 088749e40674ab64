"""PCD: ascii, binary and binary_compressed; organised clouds, padding fields, any sizes."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from utopic_cli.io import lzf
from utopic_cli.io.ascii_table import move_lines, parse_table
from utopic_cli.io.columns import Column, widen, write_columns
from utopic_cli.io.records import FormatError, Motion, Records

_KEYWORDS = ("VERSION", "FIELDS", "COLUMNS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT")
_SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
_COORDINATES = ("x", "y", "z")
_NORMALS = (("normal_x", "normal_y", "normal_z"), ("nx", "ny", "nz"))
_COUNT = re.compile(r"\d{1,18}")


@dataclass(frozen=True)
class _Header:
    """A parsed header.

    Attributes:
        names, dtypes, counts: per field.
        points: promised number of points.
        encoding: ascii, binary or binary_compressed.
        viewpoint: translation and quaternion (w x y z) of the sensor, or None.
        lines: the header as it was, with line ends, the DATA line last.
        warnings: odd lines that were skipped.
    """

    names: tuple[str, ...]
    dtypes: tuple[np.dtype, ...]
    counts: tuple[int, ...]
    points: int
    encoding: str
    viewpoint: np.ndarray | None
    lines: tuple[bytes, ...]
    warnings: tuple[str, ...]

    @property
    def size(self) -> int:
        return sum(map(len, self.lines))

    @property
    def record_size(self) -> int:
        return sum(d.itemsize * c for d, c in zip(self.dtypes, self.counts))

    def wanted(self) -> list[int]:
        """Return which fields are x, y, z and, if whole, the normals."""
        place = {n: i for i, n in enumerate(self.names) if n != "_" and self.counts[i] == 1}
        if not place.keys() >= set(_COORDINATES):
            raise FormatError("its PCD points have no x, y and z; export them as points")
        normals = next((names for names in _NORMALS if place.keys() >= set(names)), ())
        return [place[name] for name in (*_COORDINATES, *normals)]

    def rewritten(self, motion: Motion, widened: Sequence[int]) -> bytes:
        """Return the header with the viewpoint moved and some fields declared double."""
        written = []
        for line in self.lines:
            words = line.split()
            keyword = words[0].upper() if words else b""
            if keyword == b"SIZE" or keyword == b"TYPE":
                for field in widened:
                    words[1 + field] = b"8" if keyword == b"SIZE" else b"F"
            elif keyword == b"VIEWPOINT" and self.viewpoint is not None:
                moved = _moved_viewpoint(self.viewpoint, motion.transformation)
                words = [words[0], *(repr(float(v)).encode() for v in moved)]
            else:
                written.append(line)
                continue
            written.append(b" ".join(words) + line[len(line.rstrip()) :])
        if widened:
            names = " ".join(self.names[i] for i in widened).encode("latin-1")
            written.insert(0, b"# " + names + b" widened to double, not to lose detail\n")
        return b"".join(written)


def read_pcd(data: bytes) -> Records:
    """Read a PCD file; the promised counts are checked against the bytes there are.

    Raises:
        FormatError: the header is unsound, or the data is not what it promises.
    """
    header = _parse_header(data)
    wanted = header.wanted()
    if header.encoding == "ascii":
        return _read_ascii(data, header, wanted)
    return _read_binary(data, header, wanted)


def _parse_header(data: bytes) -> _Header:
    values: dict[str, list[str]] = {}
    lines, warnings, position = [], [], 0
    while "DATA" not in values:
        stop = data.find(b"\n", position)
        if stop < 0:
            raise FormatError("its PCD header has no DATA line; the file is cut short or not a PCD")
        lines.append(data[position : stop + 1])
        position = stop + 1
        text = lines[-1].decode("latin-1").strip()
        words = text.split()
        keyword = words[0].upper() if words else "#"
        if keyword.startswith("#"):
            continue
        if keyword not in (*_KEYWORDS, "POINTS", "DATA"):
            warnings.append(f"PCD header line '{text[:60]}' is unknown and was skipped")
        elif keyword in values:
            raise FormatError(f"its PCD header has {keyword} twice; export it again")
        else:
            values["FIELDS" if keyword == "COLUMNS" else keyword] = words[1:]

    names = tuple(name.lower() for name in values.get("FIELDS", []))
    counts = tuple(_integers(values.get("COUNT", ["1"] * len(names)), "COUNT"))
    sizes = _integers(values.get("SIZE", []), "SIZE")
    types = values.get("TYPE", [])
    if not names or not len(names) == len(counts) == len(sizes) == len(types):
        raise FormatError(
            f"its PCD header has {len(names)} FIELDS, {len(sizes)} SIZE, {len(types)} TYPE and"
            f" {len(counts)} COUNT; they must be as many, export it again"
        )
    dtypes = []
    for kind, size in zip(types, sizes):
        if size not in _SIZES.get(kind.upper(), ()):
            raise FormatError(f"its PCD header has TYPE {kind[:8]} with SIZE {size}; export it again")
        dtypes.append(np.dtype(f"<{kind.lower()}{size}"))
    single = [name for name in names if name != "_"]
    if len(set(single)) != len(single):
        raise FormatError("its PCD header has a field twice; export it again")
    encoding = " ".join(values["DATA"]).lower()
    if encoding not in ("ascii", "binary", "binary_compressed"):
        raise FormatError(f"its PCD header says DATA {encoding[:40]}, which is unknown; export it as binary")
    return _Header(
        names, tuple(dtypes), counts, _point_count(values), encoding,
        _viewpoint(values.get("VIEWPOINT")), tuple(lines), tuple(warnings),
    )  # fmt: skip


def _point_count(values: dict[str, list[str]]) -> int:
    sizes = {}
    for key in ("WIDTH", "HEIGHT", "POINTS"):
        if key in values:
            numbers = _integers(values[key], key)
            if len(numbers) != 1:
                raise FormatError(f"its PCD header has {len(numbers)} numbers for {key}; export it again")
            sizes[key] = numbers[0]
    area = sizes["WIDTH"] * sizes.get("HEIGHT", 1) if "WIDTH" in sizes else None
    points = sizes.get("POINTS", area)
    if points is None:
        raise FormatError("its PCD header has neither POINTS nor WIDTH; export it again")
    if area is not None and area != points:
        raise FormatError(f"its PCD header says POINTS {points} but WIDTH x HEIGHT {area}; export it again")
    return points


def _integers(words: list[str], key: str) -> list[int]:
    if not all(_COUNT.fullmatch(word) for word in words):
        raise FormatError(f"its PCD header has a {key} that is no whole number; export it again")
    return [int(word) for word in words]


def _viewpoint(words: list[str] | None) -> np.ndarray | None:
    """Return (7,) translation and unit quaternion (w x y z), or None if absent or senseless."""
    try:
        viewpoint = np.array([float(word) for word in words or ()])
    except ValueError:
        return None
    if viewpoint.shape != (7,) or not np.isfinite(viewpoint).all() or not viewpoint[3:].any():
        return None
    return viewpoint


def _moved_viewpoint(viewpoint: np.ndarray, transformation: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    w, x, y, z = viewpoint[3:]
    rotation = Rotation.from_matrix(transformation[:3, :3]) * Rotation.from_quat([x, y, z, w])
    x, y, z, w = rotation.as_quat(canonical=True)
    position = transformation[:3, :3] @ viewpoint[:3] + transformation[:3, 3]
    return np.array([*position, w, x, y, z])


@dataclass(frozen=True)
class _BinaryPcd:
    header: _Header
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


def _read_binary(data: bytes, header: _Header, wanted: list[int]) -> Records:
    promised = header.points * header.record_size
    compressed = header.encoding == "binary_compressed"
    block: bytearray | memoryview
    if compressed:
        block, end = _unpack(data, header.size, promised)
    else:
        left = len(data) - header.size
        if promised > left:
            raise _truncated(header, left // header.record_size)
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
    if len(data) - start < 8:
        raise FormatError("its compressed data is missing; the file is cut short, copy it again")
    packed, unpacked = (int(n) for n in np.frombuffer(data, "<u4", 2, start))
    stream = data[start + 8 : start + 8 + packed]
    if len(stream) < packed:
        raise FormatError(
            f"it promises {packed} bytes of compressed data but there are {len(stream)};"
            " the file is cut short, copy it again"
        )
    if unpacked != promised or promised > packed * lzf.LARGEST_EXPANSION:
        raise FormatError(
            f"its PCD header promises {promised} bytes of points but its compressed data holds"
            f" {min(unpacked, packed * lzf.LARGEST_EXPANSION)}; export it again"
        )
    return lzf.decompress(stream, promised), start + 8 + packed


def _truncated(header: _Header, found: int) -> FormatError:
    return FormatError(
        f"its PCD header promises {header.points} points but there are {found};"
        " the file is cut short or damaged, copy it again"
    )


@dataclass(frozen=True)
class _AsciiPcd:
    data: bytes
    header: _Header
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


def _read_ascii(data: bytes, header: _Header, wanted: list[int]) -> Records:
    lines, span = _ascii_lines(data, header)
    positions = [sum(header.counts[:field]) for field in wanted]
    points = [lines[i] for i in span]
    values = parse_table(points, sum(header.counts), positions, lambda i: f"its PCD point {i}")  # (R, 3 or 6)
    normals = values[:, 3:] if len(wanted) == 6 else None
    document = _AsciiPcd(data, header, tuple(wanted), tuple(positions))
    return Records(np.ascontiguousarray(values[:, :3]), normals, document, header.warnings)


def _ascii_lines(data: bytes, header: _Header) -> tuple[list[bytes], list[int]]:
    """Return the body's lines and which of them are points."""
    lines = data[header.size :].split(b"\n")
    filled = [i for i, line in enumerate(lines) if line and not line.isspace()]
    if len(filled) < header.points:
        raise _truncated(header, len(filled))
    return lines, filled[: header.points]
