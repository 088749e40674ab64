"""Transformations as files: text, NumPy or JSON."""

from __future__ import annotations

import io
import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from utopic_cli.errors import InputError, OutputError
from utopic_cli.io.ascii_table import parse_table
from utopic_cli.io.files import read_bytes
from utopic_cli.io.records import FormatError

SUFFIXES = (".txt", ".npy", ".json")
CONVENTION = "p_target = T_target_source @ p_source"
# How far the rotation may be from orthonormal: files with few digits are common.
_TOLERANCE = 1e-3
_LARGEST_FILE = 1 << 20  # bytes; sixteen numbers and some JSON around them


def format_transformation(transformation: np.ndarray, suffix: str) -> bytes:
    """Return a (4, 4) transformation as the bytes of a file.

    Args:
        transformation: (4, 4) float64, ``p_target = T_target_source @ p_source``.
        suffix: ``.txt`` (row-major, blanks between numbers, 17 digits), ``.npy`` or ``.json``.

    Raises:
        OutputError: the suffix is another one.
    """
    matrix = np.asarray(transformation, np.float64)
    suffix = suffix.lower()
    if suffix == ".txt":
        return "".join(" ".join(f"{value:.17g}" for value in row) + "\n" for row in matrix).encode()
    if suffix == ".npy":
        stream = io.BytesIO()
        np.save(stream, matrix, allow_pickle=False)
        return stream.getvalue()
    if suffix == ".json":
        content = {"convention": CONVENTION, "T_target_source": matrix.tolist()}
        return (json.dumps(content, indent=1) + "\n").encode()
    raise OutputError(f"a transformation can't be written as '{suffix}'; use {', '.join(SUFFIXES)}")


def read_transformation(path: str | os.PathLike[str]) -> np.ndarray:
    """Read a rigid transformation from .txt (4x4), .npy or .json (``T_target_source``).

    Returns:
        (4, 4) float64 with its rotation projected to the nearest exact one.

    Raises:
        InputError: the file can't be read, holds no (4, 4) matrix, or the matrix is not
            rigid within 1e-3 (it scales, shears or mirrors).
    """
    path = Path(path)
    readers = {".txt": _from_text, ".npy": _from_npy, ".json": _from_json}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"{path}: is no transformation file; use {', '.join(SUFFIXES)}")
    data = read_bytes(path)
    if len(data) > _LARGEST_FILE:
        raise InputError(f"{path}: is too large for a transformation; it should hold 4 rows of 4 numbers")
    try:
        return _rigid(reader(data))
    except FormatError as error:
        raise InputError(f"{path}: {error}") from None


def _from_text(data: bytes) -> np.ndarray:
    lines = [line for line in data.splitlines() if line.strip() and not line.lstrip().startswith(b"#")]
    if len(lines) != 4:
        raise FormatError(f"has {len(lines)} rows; a transformation is 4 rows of 4 numbers")
    return parse_table(lines, 4, range(4), lambda i: f"row {i + 1}")


def _from_npy(data: bytes) -> np.ndarray:
    stream = io.BytesIO(data)
    try:  # the header first: np.load would allocate whatever shape it promises
        version = np.lib.format.read_magic(stream)
        read_header = (
            np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        )
        shape, _, dtype = read_header(stream)
        if shape != (4, 4) or dtype.kind not in "fiu":
            raise FormatError(f"holds a {shape} array of {dtype}; a transformation is (4, 4) numbers")
        return np.load(io.BytesIO(data), allow_pickle=False).astype(np.float64)
    except (ValueError, EOFError, OSError) as error:
        raise FormatError(f"is not a NumPy array file ({_one_line(error)}); write it with np.save") from None


def _from_json(data: bytes) -> np.ndarray:
    try:
        content: Any = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise FormatError(f"is not JSON ({_one_line(error)}); write it again") from None
    if isinstance(content, dict):
        if "T_target_source" not in content:
            raise FormatError("has no 'T_target_source'; put the 4 rows of 4 numbers under that name")
        content = content["T_target_source"]
    rows = content if isinstance(content, list) else []
    numbers = [v for row in rows if isinstance(row, list) and len(row) == 4 for v in row]
    if len(rows) != 4 or len(numbers) != 16 or not all(type(v) in (int, float) for v in numbers):
        raise FormatError("'T_target_source' must be 4 rows of 4 numbers")
    try:
        return np.array(numbers, np.float64).reshape(4, 4)
    except OverflowError:
        raise FormatError("'T_target_source' holds a number that is too large") from None


def _rigid(matrix: np.ndarray) -> np.ndarray:
    """Return the nearest rigid transformation, or refuse what is not nearly one."""
    if not np.isfinite(matrix).all() or np.abs(matrix[3] - [0, 0, 0, 1]).max() > _TOLERANCE:
        raise FormatError("is no rigid transformation: the last row must be 0 0 0 1, and all numbers finite")
    rotation = matrix[:3, :3]
    if np.abs(rotation).max() > 2 or np.abs(rotation @ rotation.T - np.eye(3)).max() > _TOLERANCE:
        raise FormatError("is no rigid transformation: it scales or shears; give a rotation and translation")
    if np.linalg.det(rotation) < 0:
        raise FormatError("is no rigid transformation: it mirrors; give a rotation and translation")
    u, _, vt = np.linalg.svd(rotation)
    rigid = np.eye(4)
    rigid[:3, :3] = u @ vt
    rigid[:3, 3] = matrix[:3, 3]
    return rigid


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:80]
