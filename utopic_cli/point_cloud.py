"""Points in memory: what every room works on once a scan file has been read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class PointCloud:
    """A set of points, with unit normals where they are known.

    Attributes:
        points: (N, 3) float64, finite, in the file's own units.
        normals: (N, 3) float64 unit vectors, or None.
    """

    points: np.ndarray
    normals: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.points)

    def transformed(self, transformation: np.ndarray) -> PointCloud:
        """Return the cloud moved by a (4, 4) rigid transformation; normals are rotated."""
        rotation, translation = transformation[:3, :3], transformation[:3, 3]
        normals = None if self.normals is None else self.normals @ rotation.T
        return PointCloud(self.points @ rotation.T + translation, normals)
