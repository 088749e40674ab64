"""A plain LZF compressor with back references, so that the decompressor meets real streams."""

from __future__ import annotations


def compress(data: bytes) -> bytes:
    """Compress greedily, with a table of where each three bytes were last seen."""
    seen: dict[bytes, int] = {}
    out, literals = bytearray(), bytearray()

    def flush() -> None:
        for first in range(0, len(literals), 32):
            run = literals[first : first + 32]
            out.append(len(run) - 1)
            out.extend(run)
        literals.clear()

    position = 0
    while position < len(data):
        key = data[position : position + 3]
        before = seen.get(key, -1) if len(key) == 3 else -1
        seen[key] = position
        distance = position - before - 1
        if before < 0 or distance >= 1 << 13:
            literals.append(data[position])
            position += 1
            continue
        length = 3
        while (
            length < 264
            and data[position + length : position + length + 1]
            == data[before + length : before + length + 1]
            != b""
        ):
            length += 1
        flush()
        code = length - 2
        if code < 7:
            out.append((code << 5) | (distance >> 8))
        else:
            out += bytes([(7 << 5) | (distance >> 8), code - 7])
        out.append(distance & 255)
        position += length
    flush()
    return bytes(out)
