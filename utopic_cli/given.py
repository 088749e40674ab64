"""Scans as a caller gives them, files or arrays, and a result in their own numbering."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from utopic_cli.errors import InputError, UsageError
from utopic_cli.io.ply_writer import points_ply
from utopic_cli.io.records import Document, FormatError, Motion
from utopic_cli.io.scan import Scan, check_points, parse_scan, read_scan
from utopic_cli.point_cloud import PointCloud
from utopic_cli.result import RegistrationResult

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


@dataclass(frozen=True)
class Given:
    """A scan.

    Attributes:
        cloud: its finite points.
        kept: (N,) int64, the row or record each of them came from.
        records: how many there were.
        warnings: what the caller should know.
    """

    cloud: PointCloud
    kept: np.ndarray
    records: int
    warnings: tuple[str, ...]

    def spread(self, values: np.ndarray) -> np.ndarray:
        """Return values of the points as one for each record; NaN where its point was left out."""
        if len(values) == self.records:
            return values
        whole = np.full(self.records, np.nan, values.dtype)
        whole[self.kept] = values
        return whole


def take(scan: str | PathLike[str] | ArrayLike, name: str, seed: int) -> Given:
    """Read a file, or check an array (N, 3) as a file's points are.

    Args:
        scan: a path, or real numbers; rows that are not finite are left out.
        name: what to call it in an error.
        seed: of the points drawn from a mesh file.

    Raises:
        InputError: it can't be used.
    """
    if isinstance(scan, (str, PathLike)):
        read = read_scan(scan, seed=seed)
        return Given(read.cloud, read.kept, read.records, tuple(f"{name}: {said}" for said in read.warnings))
    points = _numbers(scan, name)
    kept = np.flatnonzero(np.isfinite(points).all(axis=1))
    dropped = len(points) - len(kept)
    finite = points[kept] if dropped else points
    try:
        check_points(finite, len(points), remedy="check what was put into the array")
    except FormatError as error:
        raise InputError(f"{name}: {error}") from error
    said = (f"{name}: {dropped} of {len(points)} points are NaN or infinite and were left out",)
    return Given(PointCloud(finite), kept, len(points), said if dropped else ())


def as_given(result: RegistrationResult, source: Given, target: Given) -> RegistrationResult:
    """Return a result whose arrays and indices are those of the scans as they were given."""
    pairs = result.correspondences
    return replace(
        result,
        source_overlap=source.spread(result.source_overlap),
        target_overlap=target.spread(result.target_overlap),
        source_uncertainty=source.spread(result.source_uncertainty),
        target_uncertainty=target.spread(result.target_uncertainty),
        correspondences=replace(
            pairs,
            source_indices=source.kept[pairs.source_indices],
            target_indices=target.kept[pairs.target_indices],
        ),
        warnings=(*result.warnings, *source.warnings, *target.warnings),
        _digests=(_digest(source), _digest(target)),
    )


def scan_of(scan: str | PathLike[str] | ArrayLike, name: str, seed: int) -> Scan:
    """Return a file, or an array (N, 3) as the file of its points, with what is needed to write it moved.

    Args:
        scan: a path, or real numbers.
        name: what to call an array: ``source`` makes it ``source.ply``.
        seed: of the points drawn from a mesh file.

    Raises:
        InputError: it can't be used.
    """
    if isinstance(scan, (str, PathLike)):
        return read_scan(scan, seed=seed)
    made = parse_scan(Path(f"{name}.ply"), points_ply(_numbers(scan, name)))
    return replace(made, document=replace(made.document, document=_Array(made.document.document)))


@dataclass(frozen=True)
class _Array:
    """An array as a document: a PLY that lies nowhere."""

    made: Document

    def rewrite(self, motion: Motion) -> bytes:
        return self.made.rewrite(motion)

    def fields(self, records: int) -> dict[str, np.ndarray]:
        """Its points are all there is to it."""
        return {}


def as_read(result: RegistrationResult, source: Scan, target: Scan) -> RegistrationResult:
    """Return a result of ``as_given`` whose arrays and indices are those of the scans' points again.

    Raises:
        UsageError: the scans' points are not those that were aligned.
    """
    changes: dict[str, Any] = {}
    pairs = result.correspondences
    said: set[str] = set()
    for side, (name, scan) in enumerate((("source", source), ("target", target))):
        values = [getattr(result, f"{name}_{field}") for field in ("overlap", "uncertainty")]
        if len(values[0]) != scan.records:
            raise UsageError(
                f"{scan.path}: has {scan.records} points, the result's {name} {len(values[0])};"
                " give the scans that were aligned, source first"
            )
        if result._digests and result._digests[side] != _digest(scan):
            raise UsageError(
                f"{scan.path}: its points are not those of the result's {name};"
                " give the scans that were aligned, source first"
            )
        changes |= {f"{name}_overlap": values[0][scan.kept], f"{name}_uncertainty": values[1][scan.kept]}
        place = np.searchsorted(scan.kept, getattr(pairs, f"{name}_indices"))
        pairs = replace(pairs, **{f"{name}_indices": place})
        said |= {f"{name}: {warning}" for warning in scan.warnings}
    kept = tuple(warning for warning in result.warnings if warning not in said)
    return replace(result, **changes, correspondences=pairs, warnings=kept)


def _digest(scan: Given | Scan) -> str:
    """Return a hash of the finite points and their places: the same for a file and its array."""
    digest = hashlib.sha256(scan.kept.astype("<i8").data)
    digest.update(np.ascontiguousarray(scan.cloud.points + 0.0, "<f8").data)  # -0 is 0
    return digest.hexdigest()


def _numbers(scan: Any, name: str) -> np.ndarray:
    """Return real numbers (N, 3) as float64."""
    kind = ""
    try:
        given = np.asarray(scan)
        kind = given.dtype.kind
        points = given.astype(np.float64) if kind in "fiub" else None
    except (TypeError, ValueError):
        points = None
    if points is None:
        raise InputError(f"{name}: {_no_numbers(scan, kind)}")
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{name}: an array of shape {points.shape}; expected (N, 3)")
    return points


def _no_numbers(scan: Any, kind: str) -> str:
    """Say what was given instead of a path or numbers, and what to give."""
    wanted = "give a path or an (N, 3) array of real numbers"
    if scan is None:
        return f"is None; {wanted}"
    if hasattr(scan, "points"):  # Open3D's clouds, PyVista's
        return f"is a {type(scan).__name__}, not an array; pass numpy.asarray(cloud.points)"
    if kind in ("U", "S"):
        return f"holds text, not numbers; {wanted}"
    if kind == "c":
        return f"holds complex numbers; {wanted}"
    return f"is neither a path nor real numbers, but of type {type(scan).__name__}; {wanted}"
