"""Scans with known answers: a folder of scan files and a ``gt.json`` that says how they fit.

Two layouts are read. Both hold column-vector matrices, ``p_target = T_target_source @ p_source``,
with lengths in the files' own units; keys not named here are ignored. Many pairs::

    {"pairs": [{"source": "a.ply", "target": "b.ply",
                "T_target_source": [[...], [...], [...], [0, 0, 0, 1]],
                "overlap_source": 0.62, "overlap_target": 0.55}, ...]}

and one pair, the same object on its own::

    {"source": "a.ply", "target": "b.ply", "T_target_source": [...], "overlap_source": ...}

File names are relative to the folder. The overlaps are shares of each scan's points that have
a counterpart in the other. They may carry a suffix that says at what distance, such as
``overlap_source_2p5mm`` with ``overlap_target_2p5mm``; where there are several, the first one
that both sides have counts. Without any they are measured, at 1 % of the pair's extent.

Matrices typed with few digits are accepted: a rotation that is orthonormal to 1e-4 is replaced
by the nearest one that is so exactly. A larger deviation is an error, not a rounding.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from utopic_cli.errors import InputError
from utopic_cli.geometry.rigid import apply, invert, is_rigid, nearest_rotation, rigid
from utopic_cli.point_cloud import PointCloud

RIGID_TOLERANCE = 1e-4
EXAMPLE = "docs/benchmarks.md has an example of gt.json"
COUNTERPART_SHARE_OF_EXTENT = 0.01


@dataclass(frozen=True)
class KnownPair:
    """Two scan files and how the first lies on the second.

    Attributes:
        index: position in gt.json, from 0.
        source: path of the scan that moves.
        target: path of the scan that stays.
        gt_T_target_source: (4, 4) float64, exactly rigid.
        overlap_ratio: keys ``source`` and ``target``, or None if gt.json does not say.
    """

    index: int
    source: Path
    target: Path
    gt_T_target_source: np.ndarray
    overlap_ratio: dict[str, float] | None


def read_ground_truth(directory: Path) -> tuple[KnownPair, ...]:
    """Read and check a folder's ``gt.json``.

    Raises:
        InputError: it is missing or unreadable, or an entry (named in the message) has no scan
            file, no rigid matrix or an overlap outside [0, 1].
    """
    path = directory / "gt.json"
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(
            f"{path}: can't be read ({error.strerror}); a folder of scans needs one, {EXAMPLE}"
        ) from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid JSON ({error})") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: the top level must be an object with 'pairs', or one pair; {EXAMPLE}")
    if "pairs" not in content:
        return (_pair(content, 0, directory, f"{path}: the pair"),)
    entries = content["pairs"]
    if not isinstance(entries, list) or not entries:
        raise InputError(f"{path}: 'pairs' must be a list with at least one pair; {EXAMPLE}")
    return tuple(
        _pair(entry, index, directory, f"{path}: pairs[{index}]") for index, entry in enumerate(entries)
    )


def measured_overlap(
    source: PointCloud, target: PointCloud, gt_T_target_source: np.ndarray, extent: float
) -> dict[str, float]:
    """Return the share of each cloud's points with a counterpart within 1 % of the extent."""
    reach = COUNTERPART_SHARE_OF_EXTENT * extent
    sides = {
        "source": (apply(gt_T_target_source, source.points), target.points),
        "target": (apply(invert(gt_T_target_source), target.points), source.points),
    }
    return {
        side: float(np.isfinite(cKDTree(other).query(points, distance_upper_bound=reach)[0]).mean())
        for side, (points, other) in sides.items()
    }


def _pair(entry: Any, index: int, directory: Path, where: str) -> KnownPair:
    if not isinstance(entry, dict):
        raise InputError(f"{where} must be an object with source, target and T_target_source; {EXAMPLE}")
    source, target = (_scan_file(entry, side, directory, where) for side in ("source", "target"))
    name = f"{where} ({source.name} -> {target.name})"
    return KnownPair(index, source, target, _rigid_matrix(entry, name), _overlap_ratio(entry, name))


def _scan_file(entry: dict[str, Any], side: str, directory: Path, where: str) -> Path:
    name = entry.get(side)
    if not isinstance(name, str) or not name:
        raise InputError(f"{where} does not name its {side} file; {EXAMPLE}")
    path = directory / name
    if not path.is_file():
        raise InputError(f"{where}: its {side} {name!r} is not a file in {directory}")
    return path


def _rigid_matrix(entry: dict[str, Any], where: str) -> np.ndarray:
    try:
        matrix = np.array(entry.get("T_target_source"), dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.empty(0)
    if matrix.shape != (4, 4):
        raise InputError(f"{where}: T_target_source must be 4 rows of 4 numbers; {EXAMPLE}")
    if not is_rigid(matrix, RIGID_TOLERANCE):
        raise InputError(
            f"{where}: T_target_source is no rigid transformation; its rotation must be orthonormal to "
            f"{RIGID_TOLERANCE:g}, without scale or mirror, and its last row 0 0 0 1"
        )
    return rigid(nearest_rotation(matrix[:3, :3]), matrix[:3, 3])


def _overlap_ratio(entry: dict[str, Any], where: str) -> dict[str, float] | None:
    prefix = "overlap_source"
    suffixes = [key[len(prefix) :] for key in entry if key.startswith(prefix)]
    for suffix in suffixes:
        if f"overlap_target{suffix}" in entry:
            ratio = {side: entry[f"overlap_{side}{suffix}"] for side in ("source", "target")}
            for side, value in ratio.items():
                number = isinstance(value, (int, float)) and not isinstance(value, bool)
                if not number or not 0.0 <= value <= 1.0:
                    raise InputError(f"{where}: overlap_{side}{suffix} is {value!r}; it must lie in [0, 1]")
            return {side: float(value) for side, value in ratio.items()}
    return None
