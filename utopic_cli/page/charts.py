"""Histograms of both scans as SVG: no script needed to see them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

BINS = 20
_WIDTH, _HEIGHT = 320, 180
_LEFT, _RIGHT, _TOP, _BOTTOM = 38, 4, 10, 36
SIDES = ("source", "target")


def overlap_histogram(source: np.ndarray, target: np.ndarray) -> str:
    """Draw how the overlap of all points of each scan is spread.

    Args:
        source: (N,) in [0, 1].
        target: (M,) in [0, 1].
    """
    shares = [_shares(values, 1.0) for values in (source, target)]
    ticks = [(place / BINS, f"{place / BINS:g}") for place in range(0, BINS + 1, BINS // 4)]
    return _bars(shares, BINS, ticks, "overlap", "Share of each scan's points by overlap")


def residual_histogram(source: np.ndarray, target: np.ndarray, reach: float) -> str:
    """Draw how far points are from the other scan, with those that have no counterpart set apart.

    Args:
        source: (N,) distances, file units; infinite without a counterpart.
        target: (M,) likewise.
        reach: the largest distance of a counterpart.
    """
    shares = [
        np.append(
            _shares(values[np.isfinite(values)], reach, len(values)),
            [0.0, 0.0, np.mean(~np.isfinite(values))],
        )
        for values in (source, target)
    ]
    places = BINS + 3  # a gap, then those without
    ticks = [(place / places, f"{reach * place / BINS:.3g}") for place in range(0, BINS + 1, BINS // 2)]
    ticks.append((1.0, "none"))
    title = "Share of each scan's points by distance to the other scan"
    return _bars(shares, places, ticks, "distance, file units; none: no counterpart", title)


def _shares(values: np.ndarray, reach: float, count: int | None = None) -> np.ndarray:
    """Return the share of values in each of the bins from 0 to ``reach``."""
    known = values[np.isfinite(values)]
    counts, _ = np.histogram(np.clip(known, 0.0, reach), BINS, (0.0, reach))
    return counts / max(len(values) if count is None else count, 1)


def _bars(
    shares: Sequence[np.ndarray], places: int, ticks: Sequence[tuple[float, str]], axis: str, title: str
) -> str:
    """Draw the bars of both scans side by side over each of ``places`` places."""
    top = _ceiling(max(float(one.max()) for one in shares))
    width, height = _WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM
    floor = _TOP + height
    parts = []
    for level in (0.0, 0.5, 1.0):
        y = floor - height * level
        parts.append(f'<line class="rule" x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{y:g}" y2="{y:g}"/>')
        parts.append(f'<text x="{_LEFT - 5}" y="{y + 4:g}" text-anchor="end">{100 * level * top:g}%</text>')
    for share, text in ticks:
        x, anchor = (_LEFT + width * share, "middle") if share < 0.8 else (_LEFT + width * share + 3, "end")
        parts.append(f'<text x="{x:.1f}" y="{floor + 15}" text-anchor="{anchor}">{text}</text>')
    parts.append(f'<text x="{_LEFT + width / 2:g}" y="{_HEIGHT - 4}" text-anchor="middle">{axis}</text>')
    step = width / places
    for number, (side, values) in enumerate(zip(SIDES, shares, strict=True)):
        path = ""
        for place, value in enumerate(values):
            if value > 0:
                x, tall = _LEFT + step * (place + 0.08 + 0.42 * number), height * value / top
                path += f"M{x:.1f} {floor}v-{tall:.1f}h{0.42 * step:.1f}v{tall:.1f}z"
        parts.append(f'<path class="{side}" d="{path}"/>')
    body = "".join(parts)
    return f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{title}">{body}</svg>'


def _ceiling(largest: float) -> float:
    """Return the end of an axis of shares: a round number not below the largest."""
    return next((end for end in (0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.6, 0.8) if end >= largest), 1.0)
