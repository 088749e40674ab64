"""A virtual range scanner: what of a dense surface sample is seen from far away."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from utopic_cli.point_cloud import PointCloud
from utopic_cli.synthesis.surface import bounding_box

STEEPEST = 10.0  # tangents of the viewing angle beyond this are treated as this


@dataclass(frozen=True)
class DepthMap:
    """A dense surface sample seen along an orthographic line of sight.

    Attributes:
        frame: (3, 3) float32 rows: right, up, and the direction towards the scanner.
        cell: edge length of a grid cell across the line of sight, in the points' unit.
        local: (N, 3) float32 the sample in the frame; the third coordinate is the height.
        cells: (N,) int32 the grid cell of each sample.
        front: (cells, 3) float32 front-most sample of each cell; height -inf where empty.
        occluder: (cells,) float32 height of the surface in and around each cell: the fourth
            highest of 3 x 3. It closes the holes that the sample leaves in the front layer,
            without growing that layer over what lies beside it.
    """

    frame: np.ndarray
    cell: float
    local: np.ndarray
    cells: np.ndarray
    front: np.ndarray
    occluder: np.ndarray

    def near_front(self, index: np.ndarray | slice) -> np.ndarray:
        """Cheap first cut: which samples (K,) of ``index`` can be visible, without normals."""
        lowest = self.occluder - self.cell * (1.5 + 1.1 * STEEPEST)
        return self.local[index, 2] >= lowest.take(self.cells[index])

    def seen(
        self, index: np.ndarray, normals: np.ndarray, minimum_cosine: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Tell which samples belong to the front surface and are not seen too grazingly.

        A sample is hidden if the front-most sample of its own cell rises above its tangent
        plane (which allows for any slope without letting a second layer through), or if it
        lies below the surface around its cell by more than its slope explains.

        Args:
            index: (K,) samples asked about.
            normals: (K, 3) their unit normals, of either sign, in the sample's own frame.
            minimum_cosine: surfaces seen at a smaller cosine return nothing.

        Returns:
            seen: (K,) bool.
            cosine: (K,) float32 of the viewing angle, not negative.
        """
        facing = normals @ self.frame.T
        facing *= np.where(facing[:, 2:] < 0, np.float32(-1.0), np.float32(1.0))
        cosine = facing[:, 2].copy()
        local, cells = self.local.take(index, axis=0), self.cells.take(index)
        bounded = np.clip(cosine, 1.0 / STEEPEST, 1.0)
        slope = np.sqrt(1.0 - bounded**2) / bounded
        rise = np.einsum("nd,nd->n", facing, self.front.take(cells, axis=0) - local)
        on_top = rise <= self.cell * (0.25 + 0.35 * bounded)
        on_top &= local[:, 2] >= self.occluder.take(cells) - self.cell * (1.5 + 1.1 * slope)
        return on_top & (cosine > minimum_cosine), cosine


def view_frame(direction: np.ndarray) -> np.ndarray:
    """Return (3, 3) rows right, up, and the unit ``direction`` (3,) towards the scanner."""
    towards = np.asarray(direction, dtype=np.float64) / np.linalg.norm(direction)
    helper = np.eye(3)[np.argmin(np.abs(towards))]
    right = np.cross(helper, towards)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(towards, right), towards])


def depth_map(points: np.ndarray, direction: np.ndarray, cell: float) -> DepthMap:
    """Project a dense sample along a line of sight.

    Args:
        points: (N, 3) samples of the whole surface, about 3 or more to a cell.
        direction: (3,) unit vector towards the scanner, far away.
        cell: edge length of a grid cell, in the points' unit.
    """
    frame = view_frame(direction).astype(np.float32)
    local = np.asarray(points, dtype=np.float32) @ frame.T
    low, high = bounding_box(local)
    across, up = (int(steps) + 1 for steps in (high - low)[:2] / cell)
    inverse = np.float32(1.0 / cell)
    cells = ((local[:, 0] - low[0]) * inverse).astype(np.int32) * np.int32(up)
    cells += np.minimum(((local[:, 1] - low[1]) * inverse).astype(np.int32), np.int32(up - 1))
    np.minimum(cells, across * up - 1, out=cells)
    height = np.full(across * up, -np.inf, dtype=np.float32)
    np.maximum.at(height, cells, local[:, 2])
    top = np.flatnonzero(local[:, 2] == height.take(cells))
    front = np.zeros((len(height), 3), dtype=np.float32)
    front[:, 2] = -np.inf
    front[cells.take(top)] = local.take(top, axis=0)
    padded = np.full((across + 2, up + 2), -np.inf, dtype=np.float32)
    padded[1:-1, 1:-1] = height.reshape(across, up)
    around = np.stack(
        [padded[i : i + across, j : j + up].ravel() for i in range(3) for j in range(3)], axis=1
    )  # (cells, 9)
    around.partition(5, axis=1)
    return DepthMap(frame, float(cell), local, cells, front, around[:, 5].copy())


def visible(
    points: np.ndarray,
    normals: np.ndarray,
    direction: np.ndarray,
    cell: float,
    minimum_cosine: float = 0.1,
) -> np.ndarray:
    """Tell which samples of a surface a scanner far away sees.

    Args:
        points: (N, 3) dense sample of the whole surface, about 3 or more points to a cell.
        normals: (N, 3) unit normals of either sign.
        direction: (3,) unit vector towards the scanner.
        cell: resolution of the visibility test, in the points' unit.
        minimum_cosine: surfaces seen at a more grazing angle return nothing.

    Returns:
        (N,) bool.
    """
    view = depth_map(points, direction, cell)
    return view.seen(np.arange(len(points)), np.asarray(normals, dtype=np.float32), minimum_cosine)[0]


def ray_noise(count: int, sigma: float, rng: np.random.Generator) -> np.ndarray:
    """Draw (count,) range errors: Gaussian, cut off at three sigma."""
    return np.clip(rng.standard_normal(count), -3.0, 3.0) * sigma


def range_scan(
    points: np.ndarray,
    normals: np.ndarray,
    direction: np.ndarray,
    rng: np.random.Generator,
    *,
    cell: float,
    count: int | None = None,
    noise: float = 0.0,
    minimum_cosine: float = 0.15,
) -> PointCloud:
    """Scan a surface once, from one side.

    Args:
        points: (N, 3) dense sample of the whole surface.
        normals: (N, 3) unit normals of either sign.
        direction: (3,) unit vector towards the scanner, far away.
        rng: source of randomness.
        cell: resolution of the visibility test, in the points' unit.
        count: most points to return; all visible ones if None.
        noise: standard deviation of the range error along the ray, in the points' unit.
        minimum_cosine: surfaces seen at a more grazing angle return nothing.

    Returns:
        The visible points in the object's frame, in random order, without normals.
    """
    seen = rng.permutation(np.flatnonzero(visible(points, normals, direction, cell, minimum_cosine)))[:count]
    towards = np.asarray(direction, dtype=np.float64) / np.linalg.norm(direction)
    error = ray_noise(len(seen), noise, rng)
    return PointCloud(points[seen].astype(np.float64) + error[:, None] * towards)
