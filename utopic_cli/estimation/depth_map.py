"""What a scan taken from one side saw past, as an orthographic image."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import maximum_filter

MOST_PIXELS = 2000
"""Most pixels of a depth map along a side."""


class DepthMap:
    """What a scan saw, as an orthographic image: the nearest surface along each line of sight.

    A scanner that saw a surface also saw that nothing stood before it. The line of sight is
    not in the file; the mean oriented normal points back at the scanner well enough, since a
    scanner sees only surfaces that face it.

    Attributes:
        axes: (3, 3) rows: two across the line of sight, and the direction towards the scanner.
        facing: share of the points whose normals face it.
    """

    def __init__(self, points: np.ndarray, normals: np.ndarray, pitch: float) -> None:
        """Render (N, 3) points with (N, 3) oriented normals at ``pitch`` units a pixel."""
        mean = normals.mean(axis=0)
        length = np.linalg.norm(mean)
        towards = mean / length if length > 0 else np.array([0.0, 0.0, 1.0])
        helper = np.eye(3)[np.abs(towards).argmin()]
        across = np.cross(towards, helper)
        across /= np.linalg.norm(across)
        self.axes = np.stack([across, np.cross(towards, across), towards])  # rows: x, y, towards the scanner
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
