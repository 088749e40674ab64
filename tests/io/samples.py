"""Small scan files built independently of the readers, for the tests of this room."""

from __future__ import annotations

import numpy as np

from tests.io import lzf_reference

PLY_TYPES = {
    "i1": "char", "u1": "uint8", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint32",
    "f4": "float", "f8": "float64",
}  # fmt: skip


def bumpy_points(count: int = 80, seed: int = 1) -> np.ndarray:
    """(count, 3) float64 points on a bumpy sheet, exact in float32."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (count, 3))
    points[:, 2] = 0.3 * np.sin(3 * points[:, 0]) * points[:, 1]
    return points.astype(np.float32).astype(np.float64)


def unit_normals(count: int = 80, seed: int = 2) -> np.ndarray:
    """(count, 3) float64 unit vectors, rounded to float32."""
    normals = np.random.default_rng(seed).standard_normal((count, 3))
    return (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32).astype(np.float64)


def motion(angle: float = 0.7, translation: tuple[float, float, float] = (0.3, -0.2, 0.5)) -> np.ndarray:
    """A rigid (4, 4) transformation about a tilted axis."""
    axis = np.array([1.0, 2.0, 3.0]) / np.sqrt(14.0)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    T = np.eye(4)
    T[:3, :3] = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    T[:3, 3] = translation
    return T


def moved(points: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Points moved one by one, the slow and obvious way."""
    return np.array([T[:3, :3] @ p + T[:3, 3] for p in points])


def ply(
    columns: dict[str, tuple[str, np.ndarray]],
    encoding: str = "binary_little_endian",
    *,
    before: tuple[str, list[str], list[list]] | None = None,
    after: tuple[str, list[str], list[list]] | None = None,
    lists: list[list[int]] | None = None,
    extra_lines: tuple[str, ...] = (),
    end: str = "\n",
) -> bytes:
    """Write a PLY value by value.

    ``before``/``after`` are (element name, property lines, records); a record's entry is
    (code, value) or (code of length, code of entries, values). ``lists`` puts an uchar-int list
    after the second property of each vertex.
    """
    order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[encoding]
    count = len(next(iter(columns.values()))[1])
    header = ["ply", f"format {encoding} 1.0", *extra_lines]
    if before:
        header += [f"element {before[0]} {len(before[2])}", *before[1]]
    header += [f"element vertex {count}"]
    for i, (name, (code, _)) in enumerate(columns.items()):
        if i == 2 and lists is not None:
            header += ["property list uchar int ring"]
        header += [f"property {PLY_TYPES[code]} {name}"]
    if after:
        header += [f"element {after[0]} {len(after[2])}", *after[1]]
    header += ["end_header", ""]

    def number(code: str, value: float) -> bytes:
        value = np.array(value, (order or "<") + code)
        return value.tobytes() if order else f"{value.item()!r} ".encode()

    def record(entries: list) -> bytes:
        body = b""
        for entry in entries:
            if len(entry) == 2:
                body += number(*entry)
            else:
                length, code, values = entry
                body += number(length, len(values)) + b"".join(number(code, v) for v in values)
        return body if order else body + end.encode()

    body = b"".join(record(r) for r in before[2]) if before else b""
    for row in range(count):
        entries: list = [(code, values[row]) for code, values in columns.values()]
        if lists is not None:
            entries.insert(2, ("u1", "i4", lists[row]))
        body += record(entries)
    body += b"".join(record(r) for r in after[2]) if after else b""
    return end.join(header).encode() + body


def xyz_columns(points: np.ndarray, code: str = "f4") -> dict[str, tuple[str, np.ndarray]]:
    """The three coordinate columns of ``ply``."""
    return {name: (code, points[:, axis]) for axis, name in enumerate("xyz")}


def pcd(
    fields: list[tuple[str, str, np.ndarray]],
    encoding: str = "binary",
    *,
    width: int | None = None,
    viewpoint: str = "0 0 0 1 0 0 0",
) -> bytes:
    """Write a PCD; a field is (name, NumPy code, (N,) or (N, count) values)."""
    count = len(fields[0][2])
    columns = [(name, code, np.reshape(values, (count, -1))) for name, code, values in fields]
    width = width or count
    header = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        "FIELDS " + " ".join(name for name, _, _ in columns),
        "SIZE " + " ".join(code[1:] for _, code, _ in columns),
        "TYPE " + " ".join(code[0].upper() for _, code, _ in columns),
        "COUNT " + " ".join(str(values.shape[1]) for _, _, values in columns),
        f"WIDTH {width}",
        f"HEIGHT {count // width}",
        f"VIEWPOINT {viewpoint}",
        f"POINTS {count}",
        f"DATA {encoding}",
        "",
    ]
    head = "\n".join(header).encode()
    arrays = [np.asarray(values).astype("<" + code) for _, code, values in columns]
    if encoding == "ascii":
        rows = (" ".join(repr(v.item()) for a in arrays for v in a[i]) for i in range(count))
        return head + "".join(row + "\n" for row in rows).encode()
    if encoding == "binary":
        return head + b"".join(b"".join(a[i].tobytes() for a in arrays) for i in range(count))
    block = b"".join(a.tobytes() for a in arrays)
    stream = lzf_reference.compress(block)
    return head + np.array([len(stream), len(block)], "<u4").tobytes() + stream


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """A file with a few bytes changed, lost, doubled or put in."""
    damaged = bytearray(data)
    # Half of the damage goes to the start, where the promises are.
    reach = len(damaged) if rng.random() < 0.5 else min(len(damaged), 300)
    for _ in range(rng.integers(1, 4)):
        place = int(rng.integers(reach))
        kind = rng.integers(5)
        if kind == 0:
            damaged[place : place + 1] = rng.bytes(1)
        elif kind == 1:
            del damaged[place : place + int(rng.integers(1, 40))]
        elif kind == 2:
            damaged[place:place] = damaged[place : place + int(rng.integers(1, 40))]
        elif kind == 3:
            damaged[place : place + 1] = rng.choice([b"9", b"-", b"\n", b" ", b"99999999", b".", b","])
        else:
            damaged[place : place + 4] = rng.choice(
                [b"\xff\xff\xff\xff", b"\x00\x00\x00\x80", b"\0\0\xc0\x7f"]
            )
        reach = max(1, min(reach, len(damaged)))
    return bytes(damaged)
