"""What a scan taken from one side saw past, as an orthographic image."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import maximum_filter

MOST_PIXELS = 2000
"""Most pixels of a depth map along a side."""

ROUNDS = ((45.0, 40), (15.0, 16), (6.0, 12))
"""Directions are tried in rounds about the best so far: within how many degrees, and how many."""

GRAZING = 0.05
"""A surface seen at a smaller cosine returns hardly anything."""


class DepthMap:
    """What a scan saw, as an orthographic image: the nearest surface along each line of sight.

    A scanner that saw a surface also saw that nothing stood before it. The line of sight is
    not in the file; ``find_direction`` tells it.

    Attributes:
        axes: (3, 3) rows: two across the line of sight, and the direction towards the scanner.
        facing: share of the points whose normals face it.
    """

    def __init__(self, points: np.ndarray, normals: np.ndarray, pitch: float) -> None:
        """Render (N, 3) points with (N, 3) oriented normals at ``pitch`` units a pixel."""
        towards = find_direction(points, normals)
        across, up = (part[0] for part in _across(towards[None]))
        self.axes = np.stack([across, up, towards])
        self.facing = float((normals @ towards > 0).mean())
        seen = points @ self.axes.T
        # However few points are spread however far, the image stays small.
        self.pitch = pitch = max(pitch, float(np.ptp(seen[:, :2], axis=0).max()) / MOST_PIXELS)
        self.corner = seen[:, :2].min(axis=0) - 2.0 * pitch
        column, row = np.floor((seen[:, :2] - self.corner) / pitch).astype(np.int64).T
        front = np.full((column.max() + 3, row.max() + 3), -np.inf)
        np.maximum.at(front, (column, row), seen[:, 2])
        # The nearest surface around each pixel: closes gaps between samples and spares steep walls.
        widened = maximum_filter(front, size=3, mode="constant", cval=-np.inf)
        self.front = np.where(np.isneginf(widened), np.inf, widened)  # nothing seen: nothing known

    def in_front(self, points: np.ndarray, margin: float) -> np.ndarray:
        """Tell which (..., 3) points the scanner would have seen before its surface -> (...) bool."""
        seen = points @ self.axes.T
        pixel = np.floor((seen[..., :2] - self.corner) / self.pitch).astype(np.int64)
        inside = ((pixel >= 0) & (pixel < self.front.shape)).all(axis=-1)
        pixel = np.where(inside[..., None], pixel, 0)  # the corner pixel is always empty
        return seen[..., 2] > self.front[pixel[..., 0], pixel[..., 1]] + margin


def find_direction(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Find the direction towards the scanner that took a scan from one side, from afar.

    The mean oriented normal points there roughly, since a scanner sees only surfaces that face it; of
    the directions about it, the best has most surfaces facing it and hides least of the scan.

    Args:
        points: (N, 3).
        normals: (N, 3) oriented unit normals.

    Returns:
        (3,) unit vector.
    """
    mean = normals.mean(axis=0)
    length = np.linalg.norm(mean)
    if not length > 0:
        return np.array([0.0, 0.0, 1.0])
    mean = mean / length
    cell = np.ptp(points, axis=0).max() / 12.0 + 1e-300
    evenly = np.lexsort(np.floor(points / cell).T)[:: max(1, len(points) // 1500)]
    points, normals = points[evenly], normals[evenly]
    best = mean
    for reach, count in ROUNDS:
        across, up = _across(best[None])
        number = np.arange(count)
        away = np.radians(reach) * np.sqrt((number + 0.5) / count)[:, None]
        around = (number * np.pi * (3.0 - np.sqrt(5.0)))[:, None]  # a spiral, evenly spread
        aside = np.cos(around) * across + np.sin(around) * up
        directions = np.concatenate([best[None], np.cos(away) * best + np.sin(away) * aside])
        facing, hidden = _seen(directions, points, normals)
        turned = np.arccos(np.clip(directions @ mean, -1.0, 1.0))
        best = directions[np.argmax(0.5 * facing - hidden - 0.02 * turned)]
    return best


def _seen(
    directions: np.ndarray, points: np.ndarray, normals: np.ndarray, cells: int = 48
) -> tuple[np.ndarray, np.ndarray]:
    """Tell how (N, 3) points look from (D, 3) directions.

    Returns:
        facing: (D,) share of the points that face the direction, not too grazingly.
        hidden: (D,) mean degree, 0 to 1, to which the points lie behind others, by more than the slope of
            their surface explains.
    """
    extent = float(np.linalg.norm(np.ptp(points, axis=0))) + 1e-300
    pitch = extent / cells
    column, row = (
        np.floor((seen - seen.min(axis=0)) / pitch).astype(np.int64)
        for seen in (points @ axes.T for axes in _across(directions))
    )
    height, cosine = points @ directions.T, normals @ directions.T  # (N, D)
    cell = (np.arange(len(directions)) * (cells + 2) + column) * (cells + 2) + row
    front = np.full(len(directions) * (cells + 2) ** 2, -np.inf)
    np.maximum.at(front, cell.ravel(), height.ravel())
    slope = np.sqrt(np.maximum(1.0 - cosine**2, 0.0)) / np.maximum(np.abs(cosine), 0.1)
    behind = (front[cell] - height - pitch * slope) / extent - 0.005
    return (cosine > GRAZING).mean(axis=0), np.clip(behind / 0.03, 0.0, 1.0).mean(axis=0)


def _across(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors (D, 3) at right angles to each direction and to each other."""
    helper = np.eye(3)[np.abs(directions).argmin(axis=1)]
    across = np.cross(directions, helper)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return across, np.cross(directions, across)
