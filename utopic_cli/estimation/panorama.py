"""What a scan taken from within saw past: a room, a yard, a cave, seen all round from one standpoint."""

from __future__ import annotations

from functools import lru_cache
from itertools import product

import numpy as np
from scipy.spatial import cKDTree

FACES = 6
MOST_CELLS = 64
"""Most cells of a panorama along an edge of its cube."""

FACING = 0.85
"""Least share of points that show one standpoint the same side: a scanner sees no back."""

HIDDEN = 0.05
"""Most of a scan that may lie hidden behind the rest, seen from its standpoint; see ``_hidden``."""

FEWEST_POINTS = 2000
"""Fewer can't tell what hides what: between them one sees through any surface."""

GRID = 7
"""Places tried along each axis of the scan's box."""

STEPS = 6
"""Rounds in which the best places are moved, each by a smaller step."""


class Panorama:
    """The nearest surface in every direction from a standpoint, on the six faces of a cube."""

    def __init__(self, points: np.ndarray, standpoint: np.ndarray, pitch: float) -> None:
        """Render (N, 3) points seen from ``standpoint`` (3,) at ``pitch`` units a cell, half-way out."""
        self.standpoint = np.asarray(standpoint, dtype=np.float64)
        rays = points - self.standpoint
        wanted = 0.5 * np.pi * float(np.median(np.linalg.norm(rays, axis=1))) / pitch
        self.cells = int(np.clip(wanted, 8, MOST_CELLS))
        cell, distance = _cell(rays, self.cells)
        nearest = np.full(FACES * self.cells**2, np.inf)
        np.minimum.at(nearest, cell, distance)
        # The nearest surface around each cell: closes gaps between samples and spares what is seen grazingly.
        widened = nearest[_around(self.cells)].min(axis=1)
        self.nearest = np.where(np.isinf(widened), 0.0, widened)  # nothing seen: nothing known

    def in_front(self, points: np.ndarray, margin: float) -> np.ndarray:
        """Tell which (..., 3) points the scanner would have seen before its surface -> (...) bool."""
        cell, distance = _cell(points - self.standpoint, self.cells)
        return distance < self.nearest[cell] - margin


def find_standpoint(points: np.ndarray, normals: np.ndarray) -> np.ndarray | None:
    """Find the place within a scan's box from which all of it is seen.

    From there all surfaces show the same side, and nothing lies behind anything else. How far off
    the answer is depends on how much there is that hides: in a furnished room 3 % of its extent (median).

    Args:
        points: (N, 3).
        normals: (N, 3) unit normals, oriented alike across the surface; whether to or from the
            standpoint does not matter.

    Returns:
        (3,), or None where there is no such place (the scan was taken from outside, or merged of several), or
        where fewer than ``FEWEST_POINTS`` can't tell.
    """
    if len(points) < FEWEST_POINTS:
        return None
    middle = points.mean(axis=0)
    axes = np.linalg.eigh((points - middle).T @ (points - middle))[1]  # so a scan's pose makes no difference
    points, normals = (points - middle) @ axes, normals @ axes
    cell = np.ptp(points, axis=0).max() / 12.0 + 1e-300
    evenly = np.lexsort(np.floor(points / cell).T)
    few, many = (evenly[:: max(1, len(points) // count)] for count in (600, 2000))
    low, size = points.min(axis=0), np.ptp(points, axis=0)
    step = 0.84 * size / (GRID - 1)
    grid = np.array(list(product(range(GRID), repeat=3)), dtype=np.float64)
    places = low + 0.08 * size + grid * step
    facing, hidden = _seen(places, points[few], normals[few], cells=12, slack=0.05, clear=0.3)
    best = places[np.argsort(-(0.3 * facing - hidden), kind="stable")[:4]]
    moves = np.array(list(product((-1.0, 0.0, 1.0), repeat=3)))
    for number in range(STEPS):
        places = (best[:, None] + moves * step * 0.6 * 0.65**number).reshape(-1, 3)
        facing, hidden = _seen(places, points[many], normals[many], cells=24, slack=0.03, clear=0.1)
        order = np.argsort(-(0.3 * facing - hidden), kind="stable")
        best = places[order[:3]]
    if facing[order[0]] < FACING or hidden[order[0]] > HIDDEN:
        return None
    return middle + axes @ best[0]


def _seen(
    places: np.ndarray, points: np.ndarray, normals: np.ndarray, *, cells: int, slack: float, clear: float
) -> tuple[np.ndarray, np.ndarray]:
    """Tell how (N, 3) points look from (P, 3) places.

    Args:
        places: where to stand.
        points: of the scan.
        normals: of the scan.
        cells: along an edge of the cube that the rays are sorted into.
        slack: what is farther than the nearest point of its cell by this share, and by what the
            slope of its surface explains, is hidden ...
        clear: ... and by this share more, surely so.

    Returns:
        facing: (P,) share of the points that show the same side.
        hidden: (P,) mean degree, 0 to 1, to which the points are hidden.
    """
    rays = points - places[:, None]  # (P, N, 3)
    towards = np.einsum("pnd,nd->pn", rays, normals)
    front = (towards > 0).mean(axis=1)
    cell, distance = _cell(rays, cells)
    cell += np.arange(len(places))[:, None] * FACES * cells**2
    nearest = np.full(len(places) * FACES * cells**2, np.inf)
    np.minimum.at(nearest, cell.ravel(), distance.ravel())
    cosine = np.abs(towards) / np.maximum(distance, 1e-300)
    slope = np.sqrt(np.maximum(1.0 - cosine**2, 0.0)) / np.maximum(cosine, 0.1)
    allowed = 1.0 + slack + 0.5 * np.pi / cells * slope
    behind = distance / np.maximum(nearest[cell], 1e-300) / allowed - 1.0
    return np.maximum(front, 1.0 - front), np.clip(behind / clear, 0.0, 1.0).mean(axis=1)


def _cell(rays: np.ndarray, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Sort rays (..., 3) into the cells of a cube's faces -> (...) cell and (...) length."""
    size = np.abs(rays)
    axis = size.argmax(axis=-1)[..., None]
    ahead = np.take_along_axis(rays, axis, -1)
    reach = np.maximum(np.abs(ahead), 1e-300)
    aside = [np.take_along_axis(rays, (axis + turn) % 3, -1) / reach for turn in (1, 2)]
    row, column = (
        np.minimum(((part[..., 0] + 1.0) * 0.5 * cells).astype(np.int64), cells - 1) for part in aside
    )
    face = 2 * axis[..., 0] + (ahead[..., 0] < 0)
    return (face * cells + row) * cells + column, np.linalg.norm(rays, axis=-1)


@lru_cache(maxsize=8)
def _around(cells: int) -> np.ndarray:
    """Return the nine cells about each cell of a cube, itself included, across its edges -> (cells, 9)."""
    middle = (np.arange(cells) + 0.5) / cells * 2.0 - 1.0
    row, column = (part.ravel() for part in np.meshgrid(middle, middle, indexing="ij"))
    directions = np.empty((3, 2, cells**2, 3))
    for axis, side in product(range(3), range(2)):
        directions[axis, side][:, axis] = 1.0 - 2.0 * side
        directions[axis, side][:, (axis + 1) % 3] = row
        directions[axis, side][:, (axis + 2) % 3] = column
    whole = directions.reshape(-1, 3)
    whole = whole / np.linalg.norm(whole, axis=1, keepdims=True)
    return np.asarray(cKDTree(whole).query(whole, k=9)[1])
