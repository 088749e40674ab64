"""LZF, the compression of PCD's ``binary_compressed`` data."""

from __future__ import annotations

import numpy as np

from utopic_cli.io.records import FormatError

# The longest copy, 264 bytes, takes 3 bytes of the stream.
LARGEST_EXPANSION = 88
_LITERAL_RUN = 32


def decompress(stream: bytes, size: int) -> bytearray:
    """Decompress an LZF stream to exactly ``size`` bytes.

    A control byte below 32 announces that many literal bytes plus one; any other is a copy:
    length in the upper three bits (7: one more byte follows), distance in the rest and the
    next byte.

    Raises:
        FormatError: the stream is damaged, or holds another number of bytes.
    """
    out = bytearray()
    position, end = 0, len(stream)
    try:
        while position < end:
            control = stream[position]
            position += 1
            if control < _LITERAL_RUN:
                stop = position + control + 1
                if stop > end:
                    raise IndexError
                out += stream[position:stop]
                position = stop
            else:
                length = control >> 5
                if length == 7:
                    length += stream[position]
                    position += 1
                length += 2
                start = len(out) - ((control & 31) << 8) - stream[position] - 1
                position += 1
                if start < 0:
                    raise IndexError
                piece = out[start : start + length]
                if len(piece) < length:  # the copy overlaps what it writes: a repeating pattern
                    piece = (piece * (length // len(piece) + 1))[:length]
                out += piece
            if len(out) > size:
                break
    except IndexError:
        raise FormatError("its compressed data is damaged or cut short; copy it again") from None
    if len(out) != size:
        raise FormatError(f"its compressed data does not unpack to the promised {size} bytes; copy it again")
    return out


def store(data: bytes | bytearray) -> bytes:
    """Return a valid LZF stream of literals only: 3 % longer than the data, and fast to write."""
    whole = len(data) // _LITERAL_RUN * _LITERAL_RUN
    runs = np.empty((whole // _LITERAL_RUN, _LITERAL_RUN + 1), np.uint8)
    runs[:, 0] = _LITERAL_RUN - 1
    runs[:, 1:] = np.frombuffer(data, np.uint8, whole).reshape(-1, _LITERAL_RUN)
    rest = bytes(data[whole:])
    return runs.tobytes() + (bytes([len(rest) - 1]) + rest if rest else b"")
