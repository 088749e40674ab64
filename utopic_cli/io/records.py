"""What a reader hands over: every record's point, and a document that can be written again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

# Coordinates rounded to float32 may be off by this share of the extent and still serve:
# a hundredth of the point spacing of the densest scanners.
_ROUNDING_OF_EXTENT = 1e-5


class FormatError(Exception):
    """A file's content can't be used; the message is the reason, without the file's name."""


@dataclass(frozen=True)
class Motion:
    """Records moved by a rigid transformation, ready to be written.

    Attributes:
        transformation: (4, 4) float64.
        original: (R, 3) float64 points before.
        points: (R, 3) float64 points after; meaningful in ``rows`` only.
        rows: (R,) bool, records whose point is finite; the others stay as they are.
        normals: (R, 3) float64 normals after, at their own lengths, or None.
        normal_rows: (R,) bool, records whose normal is finite, or None.
    """

    transformation: np.ndarray
    original: np.ndarray
    points: np.ndarray
    rows: np.ndarray
    normals: np.ndarray | None
    normal_rows: np.ndarray | None

    def widened(self, dtypes: Sequence[np.dtype], as_text: bool) -> list[bool]:
        """Tell which columns have to become double to hold the moved points.

        Integers always; float32 where it would lose detail that the file had before.

        Args:
            dtypes: declared types of x, y, z and, if present, the normals (never widened).
            as_text: the file is text, whose digits may hold more than float32 does.
        """
        roomy = self._outgrows_float32(as_text)
        coordinates = [d.kind in "iu" or (roomy and d.itemsize < 8) for d in dtypes[:3]]
        return coordinates + [False] * (len(dtypes) - 3)

    def _outgrows_float32(self, as_text: bool) -> bool:
        if not self.rows.any():
            return False
        original = self.original[self.rows]
        extent = float(np.max(original.max(axis=0) - original.min(axis=0)))
        rounding = _float32_rounding(self.points[self.rows])
        had = 0.0 if as_text else _float32_rounding(original)
        return rounding > max(2.0 * had, _ROUNDING_OF_EXTENT * extent)


class Document(Protocol):
    """A file kept whole, so that it can be written again with its points moved."""

    def rewrite(self, motion: Motion) -> bytes:
        """Return the file with coordinates and normals replaced and all else kept."""
        ...


@dataclass(frozen=True)
class Records:
    """One file's records.

    Attributes:
        points: (R, 3) float64, one per record of the file, NaN where the file has none.
        normals: (R, 3) float64 as stored, or None.
        document: writes the file again.
        warnings: what was odd about it.
    """

    points: np.ndarray
    normals: np.ndarray | None
    document: Document
    warnings: tuple[str, ...] = ()

    @cached_property
    def finite(self) -> np.ndarray:
        """(R,) bool: records whose three coordinates are finite."""
        return np.isfinite(self.points).all(axis=1)

    def moved(self, transformation: np.ndarray) -> bytes:
        """Return the file's bytes with its points moved by a rigid (4, 4) transformation."""
        rotation, translation = transformation[:3, :3], transformation[:3, 3]
        with np.errstate(invalid="ignore"):  # records without a point stay NaN
            points = self.points @ rotation.T + translation
            normals = None if self.normals is None else self.normals @ rotation.T
        normal_rows = None if normals is None else np.isfinite(normals).all(axis=1)
        motion = Motion(transformation, self.points, points, self.finite, normals, normal_rows)
        return self.document.rewrite(motion)


def _float32_rounding(points: np.ndarray) -> float:
    """Return the distance between neighbouring float32 numbers at the largest coordinate."""
    largest = min(float(np.abs(points).max()), float(np.finfo(np.float32).max))
    return float(np.spacing(np.float32(largest)))
