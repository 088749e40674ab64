"""A result in plain words: the verdict, and the facts a person asks for. Plain text, not yet HTML."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from utopic_cli.geometry.rigid import apply, invert, rotation_angle_deg
from utopic_cli.point_cloud import PointCloud
from utopic_cli.result import FreeMotion, RegistrationResult
from utopic_cli.result_display import rounded


@dataclass(frozen=True)
class Verdict:
    """What stands on top of the page.

    Attributes:
        kind: ``yes``, ``no`` or ``none``.
        title: the verdict itself.
        text: what it means.
    """

    kind: str
    title: str
    text: str


def verdict(result: RegistrationResult) -> Verdict:
    """Say whether to trust the answer, never more than the result does."""
    if result.confidence is None or math.isnan(result.confidence):
        text = "An answer was found, but nothing vouches for it: look at it before you use it."
        return Verdict("none", "No verdict", text)
    said = f"Confidence {percent(result.confidence)}: the estimated probability that it is right. "
    if result.trusted:
        return Verdict("yes", "Aligned and trusted", said)
    text = "The answer is below, but it may well be wrong: look at it, and at the reasons, before you use it."
    return Verdict("no", "Aligned, but do not trust it", said + text)


def percent(share: float) -> str:
    """Return a probability as a percentage that never claims certainty."""
    if share > 0.99:
        return "over 99%"
    return "under 1%" if share < 0.01 else f"{100 * share:.0f}%"


def facts(result: RegistrationResult, source: PointCloud, target: PointCloud) -> list[tuple[str, str]]:
    """Return names and texts of what a person wants to know first, lengths in file units."""
    transformation, fit = result.T_target_source, result.fit
    angle, axis = rotation_angle_deg(transformation[:3, :3]), _axis(transformation)
    middle = source.points.mean(axis=0)
    shift = apply(transformation, middle) - middle
    places = decimals(target)
    listed = [
        ("Source", f"{len(source):,} points; {_share(fit.overlap_ratio['source'])} have a counterpart"),
        ("Target", f"{len(target):,} points; {_share(fit.overlap_ratio['target'])} have a counterpart"),
        ("Residual", _residual(result)),
        ("Rotation", f"{angle:.3f}°" + (f" about the axis {vector(axis, 3)}" if angle > 0 else "")),
        (
            "Translation",
            f"the source's centroid moves by {float(np.linalg.norm(shift)):.{places}f} file units: "
            f"{vector(shift, places)}",
        ),
        ("Not determined", _not_determined(result, places)),
    ]
    listed += [
        (f"Rival pose {number}", rival_text(result, source, number))
        for number in range(1, len(result.ambiguous_with) + 1)
    ]
    return listed


def rival_text(result: RegistrationResult, source: PointCloud, number: int) -> str:
    """Say how far a rival pose, counted from one, is from the answer."""
    rival = result.ambiguous_with[number - 1]
    angle = rotation_angle_deg((rival @ invert(result.T_target_source))[:3, :3])
    middle = source.points.mean(axis=0)
    shift = float(np.linalg.norm(apply(rival, middle) - apply(result.T_target_source, middle)))
    return (
        f"fits nearly as well; {angle:.1f}° and, at the source's centroid, {length(shift)} file units "
        "from the answer"
    )


def length(value: float) -> str:
    """Return a length as a person reads it."""
    return f"{value:.4g}" if math.isfinite(value) else "–"


def decimals(cloud: PointCloud, digits: int = 5) -> int:
    """Return how many decimals of a coordinate make ``digits`` digits of the cloud's extent.

    Coordinates far from the origin need them all; those of a tiny object need more.
    """
    extent = float(np.ptp(cloud.points, axis=0).max())
    return int(np.clip(digits - 1 - math.floor(math.log10(extent)), 0, 15)) if extent > 0 else digits


def vector(values: np.ndarray, places: int) -> str:
    """Return three numbers in brackets with so many decimals, without negative zeros."""
    return "(" + ", ".join(f"{round(float(value), places) + 0.0:.{places}f}" for value in values) + ")"


def _axis(transformation: np.ndarray) -> np.ndarray:
    turn = Rotation.from_matrix(transformation[:3, :3]).as_rotvec()
    return turn / max(float(np.linalg.norm(turn)), 1e-300)


def _share(value: float) -> str:
    return f"{100 * value:.0f}%" if math.isfinite(value) else "–"


def _residual(result: RegistrationResult) -> str:
    fit = result.fit
    if not math.isfinite(fit.inlier_rmse):
        return "not measured: no point has a counterpart"
    spread = ", ".join(
        f"{'half' if name == 'p50' else name[1:] + '%'} under {length(rounded(value, 100 * fit.threshold))}"
        for name, value in fit.residual_percentiles.items()
        if name in ("p50", "p95")
    )
    rmse = length(rounded(fit.inlier_rmse, 100 * fit.threshold))
    return (
        f"{rmse} file units rms where the scans overlap ({spread}); "
        f"a counterpart is within {length(fit.threshold)}"
    )


def _not_determined(result: RegistrationResult, places: int) -> str:
    seen = result.observability
    if seen is None:
        return "not measured: too few points overlap with agreeing normals to tell"
    if not seen.free:
        return "nothing: the surfaces that overlap fix all six motions"
    return "; ".join(_motion(motion, places) for motion in seen.free)


def _motion(motion: FreeMotion, places: int) -> str:
    axis = vector(motion.axis, 3)
    if motion.kind != "rotation":
        return f"sliding along {axis}"
    through = "" if motion.point is None else f" through {vector(motion.point, places)}"
    return f"rotation about the axis {axis}{through}"
