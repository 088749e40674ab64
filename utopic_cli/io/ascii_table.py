"""Tables of numbers in text: parsed strictly, and written again with some columns replaced."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from itertools import chain

import numpy as np

from utopic_cli.io.records import FormatError, Motion

# Lines parsed at a time, which bounds the memory taken by token objects.
_CHUNK = 1 << 16
# What C libraries print for "not a number"; Python reads only the plain spelling.
_ODD_NAN = re.compile(rb"[+-]?(nan\(\w*\)|1\.#\w+)", re.IGNORECASE)
_DECIMAL_COMMA = re.compile(rb"[+-]?\d+,\d+(e[+-]?\d+)?", re.IGNORECASE)


def parse_table(
    lines: Sequence[bytes],
    columns: int,
    wanted: Sequence[int],
    label: Callable[[int], str],
    delimiter: bytes | None = None,
) -> np.ndarray:
    """Parse some columns of lines that all hold the same number of values.

    Args:
        lines: N lines without their ends.
        columns: how many values each must hold.
        wanted: which of them to parse, K column numbers; the others may be anything.
        label: what to call line i in an error.
        delimiter: between two values; None for any run of blanks.

    Returns:
        (N, K) float64.

    Raises:
        FormatError: a line has another number of values, or one is no number.
    """
    parts = [
        _parse_chunk(lines[first : first + _CHUNK], columns, wanted, first, label, delimiter)
        for first in range(0, len(lines), _CHUNK)
    ]
    return np.concatenate(parts) if parts else np.empty((0, len(wanted)))


def is_number(token: bytes) -> bool:
    """Tell whether a token reads as a number (NaN and infinity included)."""
    try:
        _number(token)
    except ValueError:
        return False
    return True


def describe_bad_number(token: bytes) -> str:
    """Say why a token is no number, with advice where the cause is known."""
    shown = token[:24].decode("ascii", "backslashreplace")
    if _DECIMAL_COMMA.fullmatch(token.strip()):
        return f"has '{shown}', a decimal comma; export it with decimal points"
    return f"has '{shown}', which is not a number; export the file again"


def replace_columns(
    lines: Iterable[bytes],
    positions: Iterable[Sequence[int]],
    rows: Iterable[bool],
    texts: Iterable[Sequence[bytes]],
    delimiter: bytes | None = None,
) -> list[bytes]:
    """Return lines with some of their tokens replaced.

    Args:
        lines: the lines, without line feed.
        positions: per line, which tokens to replace.
        rows: per line, whether to touch it at all.
        texts: per line, the new tokens.
        delimiter: between two tokens; None for runs of blanks (written as one blank or tab).
    """
    written = []
    for line, where, touched, new in zip(lines, positions, rows, texts):
        if not touched:
            written.append(line)
            continue
        tokens = line.split(delimiter)
        for position, text in zip(where, new):
            tokens[position] = text
        glue = delimiter or (b"\t" if b"\t" in line else b" ")
        end = b"\r" if line.endswith(b"\r") and not tokens[-1].endswith(b"\r") else b""
        written.append(glue.join(tokens) + end)
    return written


def move_lines(
    lines: list[bytes],
    places: Sequence[int],
    positions: Sequence[Sequence[int]],
    motion: Motion,
    dtypes: Sequence[np.dtype],
    delimiter: bytes | None = None,
) -> None:
    """Write moved coordinates, and normals where there are six columns, into lines of text.

    Args:
        lines: all lines; those at ``places`` are replaced.
        places: which line each record is.
        positions: per record, which tokens are x, y, z and the normal.
        motion: the moved records.
        dtypes: type of each of these columns.
        delimiter: see `replace_columns`.
    """
    new = [lines[i] for i in places]
    where = [row[:3] for row in positions]
    new = replace_columns(new, where, motion.rows.tolist(), texts_of(motion.points, dtypes[:3]), delimiter)
    if motion.normals is not None and motion.normal_rows is not None:
        where, rows = [row[3:] for row in positions], motion.normal_rows.tolist()
        new = replace_columns(new, where, rows, texts_of(motion.normals, dtypes[3:]), delimiter)
    for i, line in zip(places, new):
        lines[i] = line


def texts_of(values: np.ndarray, dtypes: Sequence[np.dtype]) -> Iterable[list[bytes]]:
    """Yield each row of (N, K) values as K tokens with the digits that type k reads back."""
    rounded = np.empty_like(values)
    with np.errstate(over="ignore", invalid="ignore"):
        for k, dtype in enumerate(dtypes):
            whole = dtype.kind in "iu"
            rounded[:, k] = np.rint(values[:, k]) if whole else values[:, k].astype(dtype)
    formats = [b"%.9g" if dtype.itemsize <= 4 and dtype.kind == "f" else b"%.17g" for dtype in dtypes]
    for row in rounded.tolist():
        yield [form % value for form, value in zip(formats, row)]


def _parse_chunk(
    lines: Sequence[bytes],
    columns: int,
    wanted: Sequence[int],
    first: int,
    label: Callable[[int], str],
    delimiter: bytes | None,
) -> np.ndarray:
    rows = [line.split(delimiter) for line in lines]
    if set(map(len, rows)) != {columns}:
        wrong = next(i for i, row in enumerate(rows) if len(row) != columns)
        found = len(rows[wrong])
        raise FormatError(
            f"{label(first + wrong)} has {found} value{'s' * (found != 1)} where {columns} belong;"
            " the file is damaged or cut short, export it again"
        )
    if list(wanted) != list(range(columns)):
        rows = [[row[k] for k in wanted] for row in rows]
    try:
        if any(b"_" in line for line in lines):  # Python would read 1_000
            raise ValueError
        flat = np.fromiter(map(float, chain.from_iterable(rows)), np.float64, len(rows) * len(wanted))
    except ValueError:
        flat = _parse_odd(rows, first, label)
    return flat.reshape(-1, len(wanted))  # (N, K)


def _parse_odd(rows: Sequence[Sequence[bytes]], first: int, label: Callable[[int], str]) -> np.ndarray:
    """Parse token by token, to accept odd spellings of NaN or to name the culprit."""
    values = []
    for i, row in enumerate(rows):
        for token in row:
            try:
                values.append(_number(token))
            except ValueError:
                raise FormatError(f"{label(first + i)} {describe_bad_number(token)}") from None
    return np.array(values)


def _number(token: bytes) -> float:
    token = token.strip()
    if _ODD_NAN.fullmatch(token):
        return float("nan")
    if b"_" in token:
        raise ValueError
    return float(token)
