"""The header and the variable length records of a LAS file, versions 1.0 to 1.4."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from utopic_cli.io.records import FormatError

# Bytes of a record by point format, without extra bytes.
_RECORD_SIZES = (20, 28, 26, 34, 57, 63, 30, 36, 38, 59, 67)
_SMALLEST_HEADER = 227
_VLR_HEADER = 54
_OCTREE = b"copc"
_TINIEST, _LARGEST = 1e-90, 1e90  # of a scale or offset that was ever meant
_SCALE, _OFFSET, _BOUNDS = 131, 155, 179  # places of three, three and six float64 in the header
_WAVEFORM, _EVLR = 227, 235  # places of file offsets (uint64), from versions 1.3 and 1.4 on
_EXTRA = [np.dtype(kind) for kind in ("u1", "i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f4", "<f8")]
_TIME = {1: 20, 3: 20, 4: 20, 5: 20, **dict.fromkeys(range(6, 11), 22)}  # place in a record by format
_COLOUR = {2: 20, 3: 28, 5: 28, 7: 30, 8: 30, 10: 30}
_NORMALS = (("normalx", "normaly", "normalz"), ("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"))


@dataclass(frozen=True)
class Vlr:
    """A variable length record: what it is, and where its content stands in the file."""

    user: bytes
    number: int
    start: int
    size: int


class Field(NamedTuple):
    """A number in every record: its type, and its place there."""

    dtype: np.dtype
    place: int


@dataclass(frozen=True)
class LasHeader:
    """A parsed header.

    Attributes:
        minor: the 4 of version 1.4.
        compressed: the records are LAZ.
        points_at: place of the first record in the file.
        point_format: 0 to 10.
        record_size: bytes of a record.
        count: promised number of records.
        scale, offset: (3,) float64; a coordinate is ``integer * scale + offset``.
        vlrs: the records between the header and the points.
        tail_at: place of what follows the points, or the file's size.
    """

    minor: int
    compressed: bool
    points_at: int
    point_format: int
    record_size: int
    count: int
    scale: np.ndarray
    offset: np.ndarray
    vlrs: tuple[Vlr, ...]
    tail_at: int

    @property
    def waveforms(self) -> bool:
        """Whether records carry the direction of a waveform."""
        return self.point_format in (4, 5, 9, 10)

    @property
    def octree(self) -> bool:
        """Whether it is COPC: points sorted into an octree that other records describe."""
        return any(vlr.user == _OCTREE for vlr in self.vlrs)

    def find(self, user: bytes, number: int) -> Vlr | None:
        """Return the first variable length record of a kind, or None."""
        return next((vlr for vlr in self.vlrs if vlr.user == user and vlr.number == number), None)

    def normals(self, data: bytes) -> list[Field]:
        """Return where the three parts of a normal are in a record, if extra bytes hold one."""
        found = {name: field for name, field in self._extra(data).items() if field.dtype.kind == "f"}
        names = next((triple for triple in _NORMALS if found.keys() >= set(triple)), ())
        return [found[name] for name in names]

    def fields(self, data: bytes) -> dict[str, Field]:
        """Return what a record says of a point besides its place, by name: the common ones, extra bytes."""
        form = self.point_format
        found = {"intensity": Field(np.dtype("<u2"), 12)}
        if form > 5:  # in the others it shares a byte with flags
            found["classification"] = Field(np.dtype("u1"), 16)
        if form in _TIME:
            found["gps_time"] = Field(np.dtype("<f8"), _TIME[form])
        if form in _COLOUR:
            places = range(_COLOUR[form], _COLOUR[form] + 6, 2)
            found |= {name: Field(np.dtype("<u2"), at) for name, at in zip(("red", "green", "blue"), places)}
        return {**found, **self._extra(data), **found}  # the common ones first, and not replaced

    def _extra(self, data: bytes) -> dict[str, Field]:
        """Return the extra bytes that are single numbers as they stand, by name in lower case."""
        vlr = self.find(b"LASF_Spec", 4)
        found: dict[str, Field] = {}
        place = _RECORD_SIZES[self.point_format]
        for start in range(vlr.start, vlr.start + vlr.size - 191, 192) if vlr else ():
            kind, options = data[start + 2], data[start + 3]
            if kind > 30:
                break
            name = data[start + 4 : start + 36].split(b"\0")[0].decode("latin-1").strip().lower()
            size = options if kind == 0 else _EXTRA[(kind - 1) % 10].itemsize * ((kind - 1) // 10 + 1)
            single = 1 <= kind <= 10 and not options & 0b11000  # no scale, no offset
            if single and name not in found and place + size <= self.record_size:
                found[name] = Field(_EXTRA[kind - 1], place)
            place += size
        return found

    def rewritten(
        self, data: bytes, scale: np.ndarray, offset: np.ndarray, low: np.ndarray, high: np.ndarray
    ) -> bytearray:
        """Return all that stands before the points, with another grid and other bounds."""
        head = bytearray(data[: self.points_at])
        for vlr in self.vlrs:
            if vlr.user == _OCTREE:  # it describes where the points were; the standard's word is superseded
                struct.pack_into("<16sH", head, vlr.start - _VLR_HEADER + 2, b"LASF_Spec", 7)
        struct.pack_into("<3d", head, _SCALE, *scale)
        struct.pack_into("<3d", head, _OFFSET, *offset)
        bounds = [bound for pair in zip(high, low) for bound in pair]
        struct.pack_into("<6d", head, _BOUNDS, *bounds)
        return head

    def shift_tail(self, head: bytearray, by: int) -> None:
        """Correct the places, in the rewritten start of a file, of what follows the points."""
        for place in _tail_places(self.minor):
            (start,) = struct.unpack_from("<Q", head, place)
            if start >= self.tail_at:
                struct.pack_into("<Q", head, place, start + by)


def parse_header(data: bytes, *, whole: bool = True) -> LasHeader:
    """Parse and check a LAS header against the bytes there are.

    Args:
        data: the file.
        whole: its records too; else its beginning alone.

    Raises:
        FormatError: it is no LAS file, of an unknown kind, or promises more than there is.
    """
    if data[:4] != b"LASF":
        raise FormatError("is no LAS file by its content; check what it is")
    if len(data) < _SMALLEST_HEADER:
        raise FormatError("is cut short within its LAS header; copy it again")
    major, minor = data[24], data[25]
    size, points_at, vlr_count = struct.unpack_from("<HII", data, 94)
    smallest = {3: 235, 4: 375}.get(minor, _SMALLEST_HEADER)
    if major != 1 or minor > 4:
        raise FormatError(f"is LAS {major}.{minor}; versions 1.0 to 1.4 are read")
    if not smallest <= size <= points_at <= len(data):
        raise FormatError("has a LAS header whose sizes can't be true; the file is cut short or damaged")
    compressed, point_format = bool(data[104] & 0x80), data[104] & 0x3F
    (record_size,) = struct.unpack_from("<H", data, 105)
    if point_format >= len(_RECORD_SIZES):
        raise FormatError(f"has LAS point format {point_format}; formats 0 to 10 are read")
    if record_size < _RECORD_SIZES[point_format]:
        raise FormatError(f"has LAS records of {record_size} bytes, too few for point format {point_format}")
    (count,) = struct.unpack_from("<I", data, 107)
    if minor >= 4:
        count = struct.unpack_from("<Q", data, 247)[0] or count
    scale = np.array(struct.unpack_from("<3d", data, _SCALE))
    offset = np.array(struct.unpack_from("<3d", data, _OFFSET))
    if not ((scale > _TINIEST) & (scale < _LARGEST) & (np.abs(offset) < _LARGEST)).all():  # NaN neither
        raise FormatError("has a LAS scale or offset that is no usable number; export it again")
    if count == 0:
        raise FormatError("has no points; check what it is, or export it again")
    starts = [struct.unpack_from("<Q", data, place)[0] for place in _tail_places(minor)]
    tail_at = min([start for start in starts if points_at < start <= len(data)], default=len(data))
    vlrs = _walk_vlrs(data, size, points_at, vlr_count)
    header = LasHeader(
        minor, compressed, points_at, point_format, record_size, count, scale, offset, vlrs, tail_at
    )
    if whole:
        check_count(header, len(data))
    return header


def check_count(header: LasHeader, size: int) -> None:
    """Compare the promised number of points with the size of the file, unless it is compressed.

    Raises:
        FormatError: it promises more.
    """
    left = size - header.points_at
    if not header.compressed and header.count * header.record_size > left:
        raise FormatError(
            f"its LAS header promises {header.count} points but there are at most"
            f" {left // header.record_size}; the file is cut short, copy it again"
        )


def _tail_places(minor: int) -> tuple[int, ...]:
    return (_WAVEFORM,) * (minor >= 3) + (_EVLR,) * (minor >= 4)


def _walk_vlrs(data: bytes, start: int, end: int, count: int) -> tuple[Vlr, ...]:
    vlrs: list[Vlr] = []
    for _ in range(count):
        if start + _VLR_HEADER > end:
            raise FormatError(f"promises {count} LAS records before its points but holds {len(vlrs)}")
        user = data[start + 2 : start + 18].split(b"\0")[0]
        number, size = struct.unpack_from("<HH", data, start + 18)
        start += _VLR_HEADER
        if start + size > end:
            raise FormatError(f"its LAS record {len(vlrs) + 1} reaches into the points; the file is damaged")
        vlrs.append(Vlr(user, number, start, size))
        start += size
    return tuple(vlrs)
