"""Columns of numbers at known places of a byte block: read, overwritten, widened."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from utopic_cli.io.records import Motion


@dataclass(frozen=True)
class Column:
    """One number per record.

    Attributes:
        dtype: type and byte order as stored.
        count: number of records.
        offset: byte offset of the first record's number.
        stride: bytes from one record's number to the next.
        starts: (count,) int64 byte offsets where records differ in length; then ``offset``
            and ``stride`` mean nothing.
    """

    dtype: np.dtype
    count: int
    offset: int = 0
    stride: int = 0
    starts: np.ndarray | None = None

    def read(self, block: bytes | bytearray | memoryview) -> np.ndarray:
        """Return the (count,) float64 values."""
        if self.starts is None:
            return _as_float64(self._view(block))
        raw = np.frombuffer(block, np.uint8)
        stored = np.empty((self.count, self.dtype.itemsize), np.uint8)
        for byte in range(self.dtype.itemsize):
            stored[:, byte] = raw[self.starts + byte]
        return _as_float64(stored.view(self.dtype)[:, 0])

    def write(self, block: bytearray, values: np.ndarray, rows: np.ndarray) -> None:
        """Overwrite the numbers of the records in ``rows`` (bool), rounded to the stored type."""
        if self.dtype.kind in "iu":
            limits = np.iinfo(self.dtype)
            values = np.clip(np.rint(np.where(rows, values, 0)), limits.min, limits.max)
        with np.errstate(over="ignore"):
            stored = values[rows].astype(self.dtype)
        if self.starts is None:
            self._view(block)[rows] = stored
            return
        raw = np.frombuffer(block, np.uint8)
        stored = stored.view(np.uint8).reshape(-1, self.dtype.itemsize)
        for byte in range(self.dtype.itemsize):
            raw[self.starts[rows] + byte] = stored[:, byte]

    def places(self) -> np.ndarray:
        """Return the (count,) int64 byte offsets."""
        if self.starts is not None:
            return self.starts
        return self.offset + self.stride * np.arange(self.count, dtype=np.int64)

    def _view(self, block: bytes | bytearray | memoryview) -> np.ndarray:
        return np.ndarray((self.count,), self.dtype, block, self.offset, (self.stride,))


def widen(
    block: bytes | memoryview, columns: Sequence[Column], wide: Sequence[bool], order: str
) -> tuple[bytearray, list[Column]]:
    """Make room for double precision numbers.

    Args:
        block: the records.
        columns: the columns to keep track of.
        wide: which of them become float64.
        order: byte order of the new numbers, ``<`` or ``>``.

    Returns:
        The longer block, all other bytes in their order, and the columns at their new places;
        the widened ones hold zeros until written.
    """
    growing = [column for column, grows in zip(columns, wide) if grows]
    starts = np.concatenate([column.places() for column in growing])
    growth = np.concatenate([np.full(c.count, 8 - c.dtype.itemsize, np.int64) for c in growing])
    sorting = np.argsort(starts, kind="stable")
    starts, growth = starts[sorting], growth[sorting]
    shift_after = np.concatenate([[0], np.cumsum(growth)])  # by how many numbers grew before

    kept = np.ones(len(block), bool)
    for column in growing:
        places = column.places()
        for byte in range(column.dtype.itemsize):
            kept[places + byte] = False
    longer = bytearray(len(block) + int(shift_after[-1]))
    free = np.ones(len(longer), bool)
    for byte in range(8):
        free[starts + shift_after[:-1] + byte] = False
    np.frombuffer(longer, np.uint8)[free] = np.frombuffer(block, np.uint8)[kept]

    moved = []
    for column, grows in zip(columns, wide):
        places = column.places()
        places = places + shift_after[np.searchsorted(starts, places)]
        dtype = np.dtype(f"{order}f8") if grows else column.dtype
        moved.append(replace(column, dtype=dtype, starts=places))
    return longer, moved


def write_columns(block: bytearray, columns: Sequence[Column], motion: Motion) -> None:
    """Overwrite x, y, z and, where there are six columns, the normals of a block."""
    for axis, column in enumerate(columns[:3]):
        column.write(block, motion.points[:, axis], motion.rows)
    if motion.normals is not None and motion.normal_rows is not None:
        for axis, column in enumerate(columns[3:]):
            column.write(block, motion.normals[:, axis], motion.normal_rows)


def _as_float64(values: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore"):  # some bit patterns of NaN would warn
        return values.astype(np.float64)
