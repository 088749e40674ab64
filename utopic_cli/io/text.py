"""XYZ, TXT, PTS, ASC and CSV: one point a line, x y z and whatever else."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from utopic_cli.io.ascii_table import is_number, move_lines, parse_table
from utopic_cli.io.pose_rows import poses_in
from utopic_cli.io.records import FormatError, Motion, Records

_BOM = b"\xef\xbb\xbf"
_COORDINATES = ("x", "y", "z")
_NORMALS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"), ("normalx", "normaly", "normalz"))
_DECIMAL_COMMA = re.compile(rb"[+-]?\d*,\d+,?")
_PADDED_INTEGER = re.compile(rb"0\d+")  # as in the 05 of 1,05
_SAMPLE_LINES = 100
_UNIT_LENGTH = 1e-2  # tolerance on the length of what is taken for a normal
_DOUBLE = np.dtype("f8")  # text declares no types


@dataclass(frozen=True)
class _Text:
    lines: Sequence[bytes]
    end: bytes
    rows: Sequence[int]  # which lines are points
    columns: Sequence[int]  # x y z, then normals
    delimiter: bytes | None

    def rewrite(self, motion: Motion) -> bytes:
        lines = list(self.lines)
        positions = [self.columns] * len(self.rows)
        move_lines(lines, self.rows, positions, motion, [_DOUBLE] * 6, self.delimiter)
        return self.end.join(lines)


def read_text(data: bytes, *, whole: bool = True) -> Records:
    """Read points from text.

    Blanks, tabs, commas or semicolons separate the values. Lines starting with ``#`` or ``//``
    are comments; the first line may name the columns or, as in PTS, promise a number of points.
    Columns beyond the coordinates are kept; three that are named or look like normals (unit
    length in every row) turn with the points.

    Args:
        data: the file.
        whole: all of it; else its beginning, of which no promise is asked.

    Raises:
        FormatError: no points, rows of differing lengths, decimal commas, fewer rows than
            promised, or poses in the place of points.
    """
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise FormatError("is UTF-16 text; save it as UTF-8 or ASCII")
    if b"\0" in data:
        raise FormatError("holds binary data, not text; check what it is, or export it again")
    poses = poses_in(data)
    if poses is not None:
        raise FormatError(
            f"is {poses}, not points; name the scan here ('utopic transformation' reads poses in .txt files)"
        )
    end = b"\n" if b"\n" in data or b"\r" not in data else b"\r"
    lines = data.split(end)
    rows = [i for i, line in enumerate(lines) if is_content(line)]
    if not rows:
        raise FormatError("has no points; check what it is, or export it again")
    warnings: list[str] = []
    header = _names_before(lines, rows)
    if not any(is_number(token) for token in re.split(rb"[\s,;]+", _clean(lines[rows[0]])) if token):
        header = lines[rows.pop(0)]
    rows, promised = _without_count(lines, rows, whole)
    if promised is not None and len(rows) > promised:
        warnings.append(f"its first line promises {promised} points; {len(rows) - promised} more lines kept")
        rows = rows[:promised]
    if not rows:
        raise FormatError("has no points; check what it is, or export it again")

    first = _clean(lines[rows[0]])
    delimiter = _delimiter(first)
    tokens = first.split(delimiter)
    names = _names(header, delimiter)
    named = len(names) == len(tokens) and set(names).issuperset(_COORDINATES)
    columns = _columns(names) if named else [0, 1, 2]
    if len(tokens) < 3:
        raise FormatError(f"has {len(tokens)} values a line; a point takes at least x, y and z")
    content = [_clean(line) if i == 0 else line for i, line in enumerate(lines[r] for r in rows)]

    def parse(wanted: Sequence[int]) -> np.ndarray:
        return parse_table(content, len(tokens), wanted, lambda i: f"its line {rows[i] + 1}", delimiter)

    if whole and delimiter == b"," and _looks_like_decimal_commas(content):
        raise FormatError("seems to use commas both as decimal and between values; export it with points")
    values = parse(columns)  # (R, 3 or 6)
    if not named and len(tokens) >= 6 and all(map(is_number, tokens[3:6])):
        extra = _unit_vectors(parse)
        if extra is not None:
            columns, values = [*columns, 3, 4, 5], np.concatenate([values, extra], axis=1)
            warnings.append("columns 4 to 6 have unit length in every line and were taken for normals")
    normals = values[:, 3:] if len(columns) == 6 else None
    document = _Text(lines, end, rows, columns, delimiter)
    return Records(np.ascontiguousarray(values[:, :3]), normals, document, tuple(warnings))


def is_content(line: bytes) -> bool:
    """Tell whether a line is neither empty nor a comment."""
    line = _clean(line)
    return bool(line) and not line.startswith((b"#", b"//"))


def _clean(line: bytes) -> bytes:
    return line.removeprefix(_BOM).strip()


def mostly_numbers(start: bytes) -> bool:
    """Tell numbers, sound or not, from prose and tables of words.

    Args:
        start: the beginning of a text file.

    Returns:
        Whether most of its first lines hold three values or more, most of them numbers.
    """
    lines = [line for line in start.splitlines() if is_content(line)][:_SAMPLE_LINES]
    rows = [[token for token in re.split(rb"[\s,;]+", _clean(line)) if token] for line in lines]
    good = [len(row) >= 3 and 2 * sum(map(is_number, row)) > len(row) for row in rows]
    return 2 * sum(good) >= max(len(good), 1)  # of two lines one may name the columns


def _without_count(lines: list[bytes], rows: list[int], whole: bool) -> tuple[list[int], int | None]:
    """Split off a PTS count line, and check the promise."""
    text = _clean(lines[rows[0]]) if rows else b""
    if not text.isdigit():
        return rows, None
    promised, rows = int(text[:18]), rows[1:]
    if whole and len(rows) < promised:
        raise FormatError(
            f"its first line promises {promised} points but there are {len(rows)};"
            " the file is cut short, copy it again"
        )
    return rows, promised


def _names_before(lines: list[bytes], rows: list[int]) -> bytes:
    """Return the last comment before the points: it may name the columns."""
    comments = [line for line in lines[: rows[0]] if _clean(line)]
    return comments[-1] if comments else b""


def _names(header: bytes, delimiter: bytes | None) -> list[str]:
    text = _clean(header).lstrip(b"#/ ")
    return [name.strip().strip(b"\"'").decode("latin-1").lower() for name in text.split(delimiter)]


def _columns(names: list[str]) -> list[int]:
    """Return where x, y, z are, and the normals if they are named."""
    normals = next((triple for triple in _NORMALS if set(names).issuperset(triple)), ())
    return [names.index(name) for name in (*_COORDINATES, *normals)]


def _delimiter(line: bytes) -> bytes | None:
    """Tell what separates the values of a line; None for blanks."""
    if b";" in line:
        return b";"
    if b"," not in line:
        return None
    tokens = line.split()
    if len(tokens) >= 3 and all(_DECIMAL_COMMA.fullmatch(token) for token in tokens[:3]):
        shown = tokens[0][:24].decode("latin-1")
        raise FormatError(f"has '{shown}', a decimal comma; export it with decimal points")
    return b","


def _looks_like_decimal_commas(lines: list[bytes]) -> bool:
    """Tell whether 1,05,2,5,3,25 may stand for three numbers: integers, some zero-padded."""
    sample = [line.split(b",") for line in lines[:1000]]
    if any(len(row) < 6 or len(row) % 2 for row in sample) or b"." in b"".join(lines[:1000]):
        return False
    return any(_PADDED_INTEGER.fullmatch(token.strip()) for row in sample for token in row[1::2])


def _unit_vectors(parse: Callable[[Sequence[int]], np.ndarray]) -> np.ndarray | None:
    """Return columns 4 to 6, (R, 3), if they are unit vectors throughout."""
    try:
        extra = parse([3, 4, 5])
    except FormatError:
        return None
    lengths = np.linalg.norm(extra, axis=1)
    whole = (extra == np.rint(extra)).all()
    return extra if not whole and (np.abs(lengths - 1.0) < _UNIT_LENGTH).all() else None
