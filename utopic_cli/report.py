"""The JSON report of one registration: everything a later reader or program needs to know.

``report.json`` is a promise, versioned by ``schema_version``: keys are added, not renamed.
What could not be measured is null, never left out or guessed; ``not_measured`` says why.
"""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from utopic_cli import __version__
from utopic_cli.geometry.rigid import apply, rotation_angle_deg
from utopic_cli.io.scan import Scan
from utopic_cli.io.transformation import CONVENTION
from utopic_cli.result import FreeMotion, RegistrationResult

SCHEMA_VERSION = 1
NOT_OBSERVED = dict.fromkeys(
    ("unobservable", "covariance", "covariance_about"), "too few points overlap with agreeing normals to tell"
)


def build_report(
    source: Scan, target: Scan, result: RegistrationResult, timings_s: dict[str, float] | None = None
) -> dict[str, Any]:
    """Collect the report of one registration as JSON-ready data.

    Args:
        source: the scan that moves.
        target: the scan that stays.
        result: what the pipeline found.
        timings_s: seconds of steps outside the pipeline (reading), put before the pipeline's.

    Returns:
        Nested dictionaries, lists, strings, numbers and None; numbers that are not finite are None.
    """
    transformation, seen = result.T_target_source, result.observability
    report = {
        "schema_version": SCHEMA_VERSION,
        "utopic_cli": __version__,
        "convention": CONVENTION,
        "weights": {"name": result.weights_name, "sha256": result.weights_sha256},
        "source": _scan_entry(source),
        "target": _scan_entry(target),
        "T_target_source": transformation,
        "rotation_translation": {
            "quaternion": quaternion(transformation[:3, :3]),
            "translation": transformation[:3, 3],
        },
        "about_source_centroid": about_centroid(transformation, source.cloud.points),
        "confidence": result.confidence,
        "trusted": result.trusted,
        "reasons": result.reasons,
        "signals": result.signals,
        "ambiguous_with": result.ambiguous_with,
        "overlap_ratio": result.fit.overlap_ratio,
        "inlier_ratio": result.fit.inlier_ratio,
        "inlier_rmse": result.fit.inlier_rmse,
        "residual_percentiles": result.fit.residual_percentiles,
        "residual_threshold": result.fit.threshold,
        "unobservable": None if seen is None else [_motion_entry(motion) for motion in seen.free],
        "covariance": None if seen is None else seen.covariance,
        "covariance_about": None if seen is None else seen.centre,
        "not_measured": NOT_OBSERVED if seen is None else {},
        "overlap": {
            "source": _distribution(result.source_overlap),
            "target": _distribution(result.target_overlap),
        },
        "uncertainty": {
            "source": _distribution(result.source_uncertainty),
            "target": _distribution(result.target_uncertainty),
            "raw": result.raw_uncertainty,
        },
        "correspondences": len(result.correspondences),
        "timings_s": {**(timings_s or {}), **result.timings_s},
        "options": result.options,
        "warnings": (*all_warnings(source, target), *result.warnings),
    }
    return {key: _plain(value) for key, value in report.items()}


def report_bytes(report: dict[str, Any]) -> bytes:
    """Encode a report as indented JSON; ASCII, so that any file name survives."""
    return (json.dumps(report, indent=2, allow_nan=False) + "\n").encode("ascii")


def all_warnings(source: Scan, target: Scan) -> tuple[str, ...]:
    """Return the readers' warnings of both scans, each with its file's name."""
    return tuple(
        text if str(scan.path) in text else f"{scan.path}: {text}"
        for scan in (source, target)
        for text in scan.warnings
    )


def quaternion(rotation: np.ndarray) -> dict[str, float]:
    """Return a (3, 3) rotation as a unit quaternion with w >= 0, its parts named."""
    x, y, z, w = Rotation.from_matrix(rotation).as_quat(canonical=True)
    return {"w": w, "x": x, "y": y, "z": z}


def about_centroid(transformation: np.ndarray, points: np.ndarray) -> dict[str, Any]:
    """Describe a transformation as a rotation about the points' centroid and a shift of it.

    Far from the origin this says more than the matrix's last column, which is then large and
    depends on the rotation's last digits: ``p_target = R (p - centroid) + centroid + translation``.

    Args:
        transformation: (4, 4).
        points: (N, 3) of the source, file units.
    """
    centroid = points.mean(axis=0)
    rotation = transformation[:3, :3]
    vector = Rotation.from_matrix(rotation).as_rotvec()
    length = float(np.linalg.norm(vector))
    return {
        "centroid": centroid,
        "axis": vector / length if length > 0 else None,
        "angle_deg": rotation_angle_deg(rotation),
        "translation": apply(transformation, centroid) - centroid,
    }


def _motion_entry(motion: FreeMotion) -> dict[str, Any]:
    return {"kind": motion.kind, "axis": motion.axis, "point": motion.point}


def _scan_entry(scan: Scan) -> dict[str, Any]:
    points = scan.cloud.points
    sides = points.max(axis=0) - points.min(axis=0)
    return {
        "path": str(scan.path),
        "sha256": scan.sha256,
        "format": scan.format,
        "points": len(points),
        "records": scan.records,
        "units": "as in the file",
        "extent": {"x": sides[0], "y": sides[1], "z": sides[2], "diagonal": np.linalg.norm(sides)},
    }


def _distribution(values: np.ndarray) -> dict[str, float]:
    p10, p50, p90 = np.percentile(values.astype(np.float64), (10, 50, 90))
    return {"mean": float(np.mean(values, dtype=np.float64)), "p10": p10, "p50": p50, "p90": p90}


def _plain(value: Any) -> Any:
    """Turn arrays, tuples and NumPy numbers into what JSON has; NaN and infinity into None."""
    if isinstance(value, dict):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
