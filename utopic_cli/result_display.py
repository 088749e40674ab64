"""A result in words: for the terminal, for ``repr`` and, as HTML, for notebooks."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from utopic_cli.result import FitMeasures, RegistrationResult

TRUSTED = "aligned and trusted"
ROUNDING = 1e-12  # of the size: lengths below it are what float64 leaves of 0
_SURE = 0.99
# Beside a coloured edge the notebook's own colours: they fit its light or dark page.
_STYLE = "border-left:4px solid {edge};padding:.2em 0 .2em .8em;max-width:60em"
_EDGES = {True: "#2a9d5c", False: "#d9822b"}


def headline(result: RegistrationResult) -> str:
    """Return the verdict in a line."""
    if result.confidence is None:
        return "aligned, but nothing says how well: do not trust it unseen"
    verdict = TRUSTED if result.trusted else "aligned, but do not trust it"
    # Never "100%": it is an estimate.
    said = "over 99%" if result.confidence > _SURE else f"{result.confidence:.0%}"
    return f"{verdict}; confidence {said}"


def one_line(result: RegistrationResult) -> str:
    """Return what ``repr`` shows: the verdict and the motion, not the arrays."""
    confidence = "None" if result.confidence is None else f"{result.confidence:.3f}"
    verdict = TRUSTED if result.trusted else "aligned, not trusted"
    points = f"{len(result.source_overlap)} -> {len(result.target_overlap)} points"
    return (
        f"<RegistrationResult: {verdict}, confidence={confidence}, {points}, "
        f"turned by {_angle_deg(result):.3f} degrees, rivals: {len(result.ambiguous_with)}>"
    )


def as_html(result: RegistrationResult) -> str:
    """Return what a notebook shows: verdict, reasons, matrix and measures; all text escaped."""
    fit = result.fit
    source, target = fit.overlap_ratio["source"], fit.overlap_ratio["target"]
    rows = [
        ("overlap", f"{source:.0%} of the source, {target:.0%} of the target"),
        ("turned by", f"{_angle_deg(result):.3f}°"),
    ]
    if math.isfinite(fit.inlier_rmse):
        rows.insert(1, ("residual", residual_in_words(fit)))
    if result.ambiguous_with:
        rows.append(("rivals", f"{len(result.ambiguous_with)}, see ambiguous_with"))
    matrix = "\n".join(
        "  ".join([*(f"{value + 0.0:9.6f}" for value in row[:3]), f"{row[3]:>12.6g}"])
        for row in result.T_target_source.tolist()
    )
    facts = "".join(f"<div><b>{name}</b> {html.escape(text)}</div>" for name, text in rows)
    return (
        f'<div style="{_STYLE.format(edge=_EDGES[result.trusted])}">'
        f"<div><b>{html.escape(headline(result))}</b></div>{_list(result.reasons)}{facts}"
        f"<div><code>T_target_source</code></div><pre>{matrix}</pre>{_list(result.warnings)}</div>"
    )


def residual_in_words(fit: FitMeasures) -> str:
    """Say how far the scans lie from each other; the threshold is about a hundredth of their size."""
    return f"{rounded(fit.inlier_rmse, 100 * fit.threshold):.4g} file units rms where they overlap"


def rounded(length: float, size: float) -> float:
    """Return a length, or 0 where it is but rounding in scans of such a size."""
    return length if length > ROUNDING * size else 0.0


def _list(texts: Iterable[str]) -> str:
    items = "".join(f"<li>{html.escape(text)}</li>" for text in texts)
    return f"<ul>{items}</ul>" if items else ""


def _angle_deg(result: RegistrationResult) -> float:
    """Return the angle of the rotation, well told apart from 0 and 180 degrees alike."""
    r = result.T_target_source[:3, :3].tolist()
    sine = math.sqrt((r[2][1] - r[1][2]) ** 2 + (r[0][2] - r[2][0]) ** 2 + (r[1][0] - r[0][1]) ** 2)
    return math.degrees(math.atan2(sine, r[0][0] + r[1][1] + r[2][2] - 1.0))
