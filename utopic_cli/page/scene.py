"""What the 3D view of a page draws: thinned, quantised points, poses to put them in, cameras.

The view's frame is the target's, its origin in the middle of the aligned scans and its unit half their
diagonal, so that the browser's single precision does for scans far from their origin too.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from utopic_cli.config import DEFAULT_COLOUR_MAP, ColourMapName
from utopic_cli.geometry.normals import estimate_normals, orient_normals
from utopic_cli.geometry.rigid import apply, invert
from utopic_cli.geometry.voxel import voxel_downsample
from utopic_cli.io.colour import colour_map
from utopic_cli.point_cloud import PointCloud
from utopic_cli.result import RegistrationResult

MOST_POINTS = 60_000
"""Points of a scan that the page draws at most."""

MOST_RIVALS = 3
"""Rival transformations that get a button."""

LEVELS = 254
"""Overlap, uncertainty and residual are drawn in steps of 1/254; the byte 255 says "unknown"."""

FAR_APART = 1.5
"""Before the alignment, scans whose middles are farther apart than this many times the sum of their
half diagonals would be two dots; they are drawn closer."""

SIDE_BY_SIDE = 1.05
"""How close, in the same measure."""

_FLAT = 0.3  # a scene whose height (z) is less than this share of its width lies on the ground
_AXES = np.eye(3)


@dataclass(frozen=True)
class DrawnCloud:
    """The points of one scan that the page draws.

    Attributes:
        points: (K, 3) float64, as the file has them.
        indices: (K,) int64, which of the scan's points they are, ascending.
        residual: (K,) float64 distance to the other scan's nearest point under the answer, file units;
            infinite beyond the threshold of a counterpart.
    """

    points: np.ndarray
    indices: np.ndarray
    residual: np.ndarray


@dataclass(frozen=True)
class Scene:
    """What the viewer needs.

    Attributes:
        data: JSON-ready.
        apart: distance of the scans' middles in the files (file units) if they are drawn closer
            together than that before the alignment, else None.
    """

    data: dict[str, Any]
    apart: float | None


def draw_clouds(
    result: RegistrationResult, source: PointCloud, target: PointCloud
) -> tuple[DrawnCloud, DrawnCloud]:
    """Choose the points to draw, and measure how far each is from the other scan (all of its points)."""
    transformation = result.T_target_source
    forward = _drawn(source, target, transformation, result.fit.threshold)
    return forward, _drawn(target, source, invert(transformation), result.fit.threshold)


def _drawn(cloud: PointCloud, other: PointCloud, transformation: np.ndarray, reach: float) -> DrawnCloud:
    # Drawn at random, not every n-th, which could fall in step with the rows of a range image; the
    # seed is fixed, so that the same result gives the same page.
    indices = _some(len(cloud), MOST_POINTS, np.random.default_rng(0))
    points = cloud.points[indices]
    # An unbalanced tree is built faster, and gives the same distances.
    tree = cKDTree(other.points, balanced_tree=False, compact_nodes=False)
    residual, _ = tree.query(apply(transformation, points), distance_upper_bound=reach)
    return DrawnCloud(points, indices, residual)


def _some(count: int, most: int, rng: np.random.Generator) -> np.ndarray:
    """Return at most ``most`` of ``count`` indices, ascending."""
    return np.arange(count) if count <= most else np.sort(rng.choice(count, most, replace=False))


def build_scene(
    result: RegistrationResult,
    source: DrawnCloud,
    target: DrawnCloud,
    colormap: ColourMapName = DEFAULT_COLOUR_MAP,
) -> Scene:
    """Put everything that the viewer draws into the frame of the view.

    Args:
        result: the answer, with overlap and uncertainty of every point of both scans.
        source: the points of the source to draw.
        target: the points of the target to draw.
        colormap: the colours of overlap, uncertainty and residual.
    """
    answer = result.T_target_source
    aligned = apply(answer, source.points)
    low, high = _box(np.concatenate([aligned, target.points]))
    origin, unit = (low + high) / 2.0, max(float(np.linalg.norm(high - low)) / 2.0, 1e-300)
    before, apart = _before(source.points, target.points)
    poses = [before, answer, *result.ambiguous_with[:MOST_RIVALS]]
    middles = [_middle(cloud.points) for cloud in (source, target)]
    frames = [_frame([apply(pose, source.points), target.points], origin, unit) for pose in poses]
    values = [
        (source, result.source_overlap, result.source_uncertainty),
        (target, result.target_overlap, result.target_uncertainty),
    ]
    reach = result.fit.threshold
    return Scene(
        data={
            "clouds": [
                {"count": len(cloud.points), **_quantised(cloud.points, middle, unit)}
                | {
                    "values": _encoded(
                        np.stack(
                            [
                                _levels(overlap[cloud.indices]),
                                _levels(uncertainty[cloud.indices]),
                                _levels(
                                    np.where(np.isfinite(cloud.residual), cloud.residual, np.nan) / reach
                                ),
                            ],
                            axis=1,
                        )
                    )
                }
                for (cloud, overlap, uncertainty), middle in zip(values, middles, strict=True)
            ],
            # Of the source before, after, and in its rival poses; the target stays.
            "poses": [_pose(pose, middles[0], origin, unit) for pose in poses],
            "target": _pose(np.eye(4), middles[1], origin, unit),
            "frames": frames,
            "turn": _numbers(_facing(np.concatenate([aligned, target.points]))),
            "map": _encoded(colour_map(np.linspace(0.0, 1.0, LEVELS + 1), colormap)),
        },
        apart=apart,
    )


def _before(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, float | None]:
    """Return where to draw the source before the alignment, and how far away it is if not there."""
    boxes = [_box(points) for points in (source, target)]
    middles = [(low + high) / 2.0 for low, high in boxes]
    sizes = sum(float(np.linalg.norm(high - low)) / 2.0 for low, high in boxes)
    way = middles[0] - middles[1]
    distance = float(np.linalg.norm(way))
    drawn = np.eye(4)
    if distance <= FAR_APART * sizes:
        return drawn, None
    drawn[:3, 3] = way * (SIDE_BY_SIDE * sizes / distance - 1.0)
    return drawn, distance


def _box(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of a box around (N, 3) points, a few stray ones left out."""
    low, high = np.percentile(points, (0.5, 99.5), axis=0)
    return low, high


def _middle(points: np.ndarray) -> np.ndarray:
    return (points.min(axis=0) + points.max(axis=0)) / 2.0


def _frame(clouds: Sequence[np.ndarray], origin: np.ndarray, unit: float) -> dict[str, Any]:
    """Return the middle and radius of what is to be seen, in the view's frame, stray points left out."""
    boxes = [_box(points) for points in clouds]  # of each alone: their points count the same
    low = np.min([box[0] for box in boxes], axis=0)
    high = np.max([box[1] for box in boxes], axis=0)
    middle = (low + high) / 2.0
    far = [np.percentile(np.linalg.norm(points - middle, axis=1), 99.5) for points in clouds]
    radius = max(float(max(far)) / unit, 1e-6)
    return {"middle": _numbers((middle - origin) / unit), "radius": _number(radius)}


def _pose(
    transformation: np.ndarray, middle: np.ndarray, origin: np.ndarray, unit: float
) -> dict[str, list[float]]:
    """Return a rotation as a quaternion (w, x, y, z), and where it puts the middle of a cloud."""
    x, y, z, w = Rotation.from_matrix(transformation[:3, :3]).as_quat(canonical=True)
    return {
        "turn": _numbers([w, x, y, z]),
        "place": _numbers((apply(transformation, middle) - origin) / unit),
    }


def _quantised(points: np.ndarray, middle: np.ndarray, unit: float) -> dict[str, Any]:
    """Return (K, 3) points as 16-bit steps from their middle, and the step in the view's unit."""
    step = max(float(np.abs(points - middle).max()), 1e-300) / 32767.0
    steps = np.rint((points - middle) / step).astype("<i2")
    return {"places": _encoded(steps), "step": _number(step / unit)}


def _levels(values: np.ndarray) -> np.ndarray:
    """Return values in [0, 1] as bytes; 255 where they are unknown (NaN)."""
    known = ~np.isnan(values)
    levels = np.rint(LEVELS * np.clip(np.where(known, values, 0.0), 0.0, 1.0))
    return np.where(known, levels, 255).astype(np.uint8)


def _facing(points: np.ndarray) -> np.ndarray:
    """Choose a first view of aligned scans: rows are right, up and towards the viewer.

    A flat scene lies on the ground and is seen from above at a slant; anything else is seen along
    the direction that most of its surface faces, y or z up.
    """
    low, high = _box(points)
    sides = high - low
    if sides[2] < _FLAT * sides[:2].min():
        return _looking(np.array([-0.45, -0.65, 0.61]), _AXES[2])
    size = max(float(np.linalg.norm(sides)) / 50.0, 1e-300)
    thinned, _ = voxel_downsample(np.clip(points, low, high), size)
    towards = _AXES[2]
    if len(thinned) > 20:
        mean = orient_normals(thinned, estimate_normals(thinned)).mean(axis=0)
        if np.linalg.norm(mean) > 0.02:  # a closed surface faces nowhere
            towards = mean / np.linalg.norm(mean)
    return _looking(towards, _AXES[1] if abs(towards[1]) < 0.75 else _AXES[2])


def _looking(towards: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the quaternion (w, x, y, z) that turns the world in front of a camera."""
    towards = towards / np.linalg.norm(towards)
    right = np.cross(up, towards)
    right /= np.linalg.norm(right)
    x, y, z, w = Rotation.from_matrix(np.stack([right, np.cross(towards, right), towards])).as_quat()
    return np.array([w, x, y, z])


def _encoded(array: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")


def _numbers(values: Sequence[float] | np.ndarray) -> list[float]:
    return [_number(value) for value in values]


def _number(value: float) -> float:
    """Return a number in as many digits as the browser's single precision has."""
    return float(f"{value:.8g}") + 0.0
