"""What two scans share before either is sampled: where their middles are, one scale, one density.

No unit, radius or voxel size is asked for: the node spacing h follows from the clouds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from utopic_cli.errors import InputError
from utopic_cli.geometry.outliers import astray, scattered
from utopic_cli.geometry.voxel import voxel_downsample, voxel_index
from utopic_cli.point_cloud import PointCloud

DENSE_RATIO = 2.2
"""Node spacing over the voxel size of the dense cloud."""

FEWEST_DENSE_POINTS = 30
"""A scan that shrinks to fewer points than this at the pair's common spacing can't be aligned."""

MOST_SCATTERED = 0.02
"""Share of scattered points that does no harm: the network has seen as many in training."""

MOST_POINTS = 400_000
"""A larger cloud is thinned evenly to about this many points before anything else."""


@dataclass(frozen=True)
class Frame:
    """What sampling two scans starts from.

    Attributes:
        points: all points of source and target, normalised.
        trees: of these points.
        parts: what is sampled of them.
        centres: (3,) of source and target; see ``PreparedPair``.
        scale: file units per normalised unit.
        spacing: node spacing h in normalised units.
        most: sampled points per cloud.
    """

    points: tuple[np.ndarray, ...]
    trees: tuple[cKDTree, ...]
    parts: tuple[np.ndarray, ...]
    centres: tuple[np.ndarray, np.ndarray]
    scale: float
    spacing: float
    most: int


def find_frame(source: PointCloud, target: PointCloud, points: int, *, clean: bool = False) -> Frame:
    """Find centres, scale and spacing of a pair.

    Args:
        source: points in file units.
        target: points in file units.
        points: most sampled points per cloud.
        clean: leave scattered points out of the sampling where a scan has many of them.

    Raises:
        InputError: one scan is so much smaller than the other that nothing of it is left at a
            spacing that suits both.
    """
    kept = [~astray(cloud.points) for cloud in (source, target)]
    centres = [cloud.points[keep].mean(axis=0) for cloud, keep in zip((source, target), kept, strict=True)]
    centred = [cloud.points - centre for cloud, centre in zip((source, target), centres, strict=True)]
    parts = [part[keep] for part, keep in zip(centred, kept, strict=True)]
    scale = max(float(np.quantile(np.linalg.norm(part, axis=1), 0.99)) for part in parts)
    thinned = [_thin(part / scale) for part in parts]
    normalised = tuple(part / scale for part in centred)
    trees = tuple(cKDTree(part) for part in normalised)
    if clean:
        thinned = [
            _without_scattered(part, tree if len(part) == tree.n else None)
            for part, tree in zip(thinned, trees, strict=True)
        ]
    spacing = _common_spacing(thinned, points)
    _check_sizes(thinned, spacing, scale)
    return Frame(normalised, trees, tuple(thinned), (centres[0], centres[1]), scale, spacing, points)


def _without_scattered(points: np.ndarray, tree: cKDTree | None) -> np.ndarray:
    alone = scattered(points, tree)
    return points[~alone] if alone.mean() > MOST_SCATTERED else points


def _thin(points: np.ndarray) -> np.ndarray:
    """Thin a very large cloud by a fine grid, so that memory and time stay bounded."""
    if len(points) <= MOST_POINTS:
        return points
    size = 2.0 / 400.0
    for _ in range(8):
        thinned, _ = voxel_downsample(points, size)
        if len(thinned) <= MOST_POINTS:
            return thinned
        size *= 1.4
    return thinned


def _common_spacing(clouds: list[np.ndarray], most: int) -> float:
    """Find one node spacing for both clouds: the finest the denser-covered one allows.

    A cloud with more than ``most`` points gets the voxel size that leaves about ``most``
    nodes; a sparser cloud has the spacing of its own points. The coarser of the two holds.
    """
    return max(
        _voxel_size_for(points, most) if len(points) > most else _own_spacing(points) for points in clouds
    )


def _check_sizes(clouds: list[np.ndarray], spacing: float, scale: float) -> None:
    """Refuse a pair whose smaller scan is but a dot beside the larger one."""
    if min(voxel_index(points, spacing / DENSE_RATIO)[1] for points in clouds) >= FEWEST_DENSE_POINTS:
        return
    source, target = (scale * extent(points) for points in clouds)
    raise InputError(
        f"{sizes_in_words(source, target)}: "
        f"bring both to the same unit{units_in_words(size_ratio(source, target))}"
    )


def extent(points: np.ndarray) -> float:
    """Return the diagonal of a cloud's bounding box, points astray left out."""
    return float(np.linalg.norm(np.ptp(points[~astray(points)], axis=0)))


def size_ratio(source: float, target: float) -> float:
    """Return the larger of two extents over the smaller one."""
    return max(source, target) / max(min(source, target), 1e-300)


def sizes_in_words(source: float, target: float) -> str:
    """Say that two scans' extents differ: by which factor, which is the larger, and both."""
    larger, low, high = "target", source, target
    if source > target:
        larger, low, high = "source", target, source
    ratio = size_ratio(source, target)
    factor = f"{ratio:.0f}" if ratio < 1e5 else f"{ratio:.3g}"
    return (
        f"the scans' sizes differ by a factor of about {factor} "
        f"(the {larger} is the larger, {high:.4g} against {low:.4g} file units)"
    )


def units_in_words(ratio: float) -> str:
    """Guess which units were mixed up, in parentheses; empty if the ratio is that of none."""
    for factor, units in ((1000.0, "millimetres against metres"), (25.4, "millimetres against inches")):
        if factor / 2.0 < ratio < factor * 2.0:
            return f" ({units}?)"
    return ""


def _voxel_size_for(points: np.ndarray, most: int) -> float:
    """Return the voxel size that leaves at most, and nearly, ``most`` cells."""
    low, high = 1e-4, 2.0
    for _ in range(14):
        size = float(np.sqrt(low * high))
        if voxel_index(points, size)[1] > most:
            low = size
        else:
            high = size
        if high / low < 1.015:
            break
    return max(high, _own_spacing(points) if len(points) < 4 * most else 0.0)


def _own_spacing(points: np.ndarray) -> float:
    """Return the voxel size that would give a cloud's own density: 0.75 of the 8th neighbour's distance."""
    points = np.unique(points, axis=0)  # merged files hold places many times
    k = min(9, len(points))
    return float(0.75 * np.median(cKDTree(points).query(points, k=k)[0][:, -1]))
