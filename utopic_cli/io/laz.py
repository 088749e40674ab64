"""The compressed records of LAZ files, through lazrs, which is optional.

lazrs makes room for whatever a file promises; so every promise is held against the file first.
"""

from __future__ import annotations

import io
import struct
from typing import Any

import numpy as np

from utopic_cli.io.las_header import LasHeader
from utopic_cli.io.records import FormatError

_AT_ONCE = 1 << 26  # bytes decompressed at a time: memory grows only as far as there is data
_MISSING = "is compressed (LAZ); to read it: pip install 'utopic-cli[las]'"
_LAYERED = 3  # the compressor of point formats 6 to 10
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}  # of an item of a record, by its kind
_EXTRA_BYTES = 14  # the kind of item with a layer for each byte


def decompress(data: bytes, header: LasHeader) -> bytearray:
    """Return the point records of a LAZ file.

    Raises:
        FormatError: lazrs is not installed, or the file is damaged.
    """
    try:
        import lazrs
    except ImportError:
        raise FormatError(_MISSING) from None
    block = bytearray()
    try:
        settings = _settings(data, header)
        vlr = lazrs.LazVlr(settings)
        if vlr.item_size() != header.record_size:
            raise FormatError(
                f"has LAZ records of {vlr.item_size()} bytes where its header says {header.record_size};"
                " it is damaged, copy it again"
            )
        _check_chunk_count(data, header)
        stream = io.BytesIO(data)
        stream.seek(header.points_at)
        _check_chunks(data, header, settings, lazrs.read_chunk_table(stream, vlr))
        stream.seek(header.points_at)
        decompressor = lazrs.LasZipDecompressor(stream, settings)
        left = header.count * header.record_size
        while left:
            part = bytearray(min(left, _AT_ONCE // header.record_size * header.record_size))
            decompressor.decompress_many(part)
            block += part
            left -= len(part)
    except (FormatError, MemoryError, KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:  # a panic in Rust is no Exception
        reason = " ".join(str(error).split())[:80]
        raise FormatError(
            f"its LAZ points can't be decompressed ({reason}); it is cut short or damaged, copy it again"
        ) from None
    return block


def compress(head: bytearray, block: bytearray, data: bytes, header: LasHeader) -> bytes:
    """Return a LAZ file with the settings of another one.

    Args:
        head: all that stands before the points; the places of what follows them are corrected.
        block: the point records.
        data: the other file, whose header, and what follows its points, are taken.
        header: of that file.
    """
    import lazrs

    stream = io.BytesIO()
    stream.write(head)
    vlr = lazrs.LazVlr(_settings(data, header))
    compressor = lazrs.LasZipCompressor(stream, vlr)
    if vlr.uses_variable_size_chunks():
        start = io.BytesIO(data)
        start.seek(header.points_at)
        chunks = [points * header.record_size for points, _ in lazrs.read_chunk_table(start, vlr) if points]
        at = 0
        for size in chunks:
            if at:
                compressor.finish_current_chunk()
            compressor.compress_many(np.frombuffer(block, np.uint8)[at : at + size])
            at += size
    else:
        compressor.compress_many(np.frombuffer(block, np.uint8))
    compressor.done()
    end = stream.seek(0, io.SEEK_END)
    header.shift_tail(head, end - header.tail_at)
    stream.seek(0)
    stream.write(head)
    stream.seek(end)
    stream.write(data[header.tail_at :])
    return stream.getvalue()


def _settings(data: bytes, header: LasHeader) -> bytes:
    vlr = header.find(b"laszip encoded", 22204)
    if vlr is None or vlr.size < 34:
        raise FormatError("says it is compressed but not how; the LAZ file is damaged, copy it again")
    return data[vlr.start : vlr.start + vlr.size]


def _check_chunk_count(data: bytes, header: LasHeader) -> None:
    """Refuse a promise of more chunks than there can be."""
    table_at = _integer(data, "<q", header.points_at)
    if table_at == -1:  # written to a stream: the place stands at the end
        table_at = _integer(data, "<q", len(data) - 8)
    chunks = _integer(data, "<I", table_at + 4)
    # Every chunk begins with a whole record.
    if chunks * header.record_size > len(data):
        raise FormatError(f"promises {chunks} LAZ chunks, more than it can hold; it is cut short or damaged")


def _check_chunks(data: bytes, header: LasHeader, settings: bytes, table: list[Any]) -> None:
    """Hold the length of each chunk against the file, and of its layers against the chunk."""
    (compressor,) = struct.unpack_from("<H", settings, 0)
    (items,) = struct.unpack_from("<H", settings, 32)
    kinds = [_integers(settings, "<HH", 34 + 6 * item) for item in range(items)]
    layers = sum(size if kind == _EXTRA_BYTES else _LAYERS.get(kind, 0) for kind, size in kinds)
    if sum(points for points, _ in table) < header.count:
        raise FormatError(
            f"has LAZ chunks for fewer points than the {header.count} it promises; it is damaged"
        )
    start = header.points_at + 8
    for number, (points, size) in enumerate(table, 1):
        if points == size == 0:  # some writers end with an empty one
            continue
        sizes_at = start + header.record_size + 4  # behind the first record and the number of points
        start += size
        whole = start <= len(data)
        if whole and compressor == _LAYERED:
            sizes = _integers(data, f"<{layers}I", sizes_at)
            whole = sizes_at + 4 * layers + sum(sizes) == start
        if not whole:
            raise FormatError(
                f"its LAZ chunk {number} is not whole; it is cut short or damaged, copy it again"
            )


def _integer(data: bytes, kind: str, place: int) -> int:
    return int(_integers(data, kind, place)[0])


def _integers(data: bytes, kind: str, place: int) -> tuple[int, ...]:
    if not 0 <= place <= len(data) - struct.calcsize(kind):
        raise FormatError("has no table of LAZ chunks where it says; it is cut short or damaged")
    return struct.unpack_from(kind, data, place)
