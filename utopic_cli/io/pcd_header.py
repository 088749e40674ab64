"""The header of a PCD file: its fields, their types, and the lines as they were."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from utopic_cli.io.records import FormatError, Motion

_KEYWORDS = ("VERSION", "FIELDS", "COLUMNS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT")
_SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
_COORDINATES = ("x", "y", "z")
_NORMALS = (("normal_x", "normal_y", "normal_z"), ("nx", "ny", "nz"))
_COUNT = re.compile(r"\d{1,18}")


@dataclass(frozen=True)
class PcdHeader:
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
        """Bytes before the first record."""
        return sum(map(len, self.lines))

    @property
    def record_size(self) -> int:
        """Bytes of a record that is not compressed."""
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


def parse_header(data: bytes) -> PcdHeader:
    """Parse a PCD header.

    Raises:
        FormatError: it never ends, or declares nonsense.
    """
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
    return PcdHeader(
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
