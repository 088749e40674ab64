"""Robustness curves: one thing about a pair made worse step by step, everything else left alone.

The levels take turns, and all levels share their pairs: pair ``number`` is base pair
``number // levels`` at level ``number % levels``, disturbed by the same random draws scaled. What a
curve shows is therefore the parameter, not the luck of other shapes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from utopic_cli.benchmark.protocols import POINTS, CropProtocol, RangeProtocol
from utopic_cli.errors import UsageError
from utopic_cli.geometry import rigid
from utopic_cli.point_cloud import PointCloud
from utopic_cli.synthesis.crops import nearest_crop
from utopic_cli.synthesis.scan_pair import ScanPair, measure_overlap
from utopic_cli.synthesis.scanner import ray_noise
from utopic_cli.synthesis.settings import PairSettings, Range
from utopic_cli.synthesis.shapes import ShapeLibrary

BAND: Range = (0.5, 0.9)
SCAN_POINTS = 20_000
FLIGHT = 0.15
"""Flying outliers lie up to this share of the extent behind the surface, on their own ray."""

SHIFT = 0.5
"""Under ``rotation`` the source is shifted by up to this share of the extent along each axis."""

FAR = 500.0
"""Distance of PRNet's viewpoints, in radii."""

ASIDE = 75.0
"""Degrees that the target's viewpoint is at most away from opposite the source's: so wide that the mean
overlaps are the paper's."""

KEPT = (768, 700, 640, 600, 560)
"""Points that both crops of the overlap sweep keep of 1,024."""

QUOTED_OVERLAPS = (0.69, 0.58, 0.47, 0.40, 0.32)
"""The paper's approximate overlaps at these."""

CLEAN = replace(
    PairSettings(),
    points=(SCAN_POINTS, SCAN_POINTS),
    keep_above=1.0,
    noise=(0.0, 0.0),
    slant_probability=0.0,
    ramp_probability=0.0,
    hole_probability=0.0,
    outlier_probability=0.0,
    several_views_probability=0.0,
)
"""Range scans with nothing wrong with them; shapes are stretched and warped as in training."""


def with_noise(pair: ScanPair, sigma: float, rng: np.random.Generator) -> ScanPair:
    """Disturb both scans along their rays: Gaussian, cut off at three sigma (shares of the extent)."""
    clouds = []
    for cloud, direction in _sides(pair):
        error = ray_noise(len(cloud.points), sigma * pair.extent, rng)
        clouds.append(PointCloud(cloud.points + error[:, None] * direction))
    return replace(pair, source=clouds[0], target=clouds[1])


def with_density(pair: ScanPair, ratio: float, rng: np.random.Generator) -> ScanPair:
    """Leave one in ``ratio`` points of the source, chosen at random."""
    order = rng.permutation(len(pair.source.points))
    kept = order[: round(len(order) / ratio)]
    return replace(pair, source=PointCloud(pair.source.points[kept]))


def with_outliers(pair: ScanPair, share: float, rng: np.random.Generator) -> ScanPair:
    """Replace a share of the points of both scans.

    Half of them fly behind the surface on their own ray, half lie anywhere in the scan's bounding box.
    """
    clouds = []
    for cloud, direction in _sides(pair):
        points = cloud.points.copy()
        which = rng.permutation(len(points))[: round(share * len(points))]
        depth = rng.uniform(0.0, FLIGHT * pair.extent, len(points))
        anywhere = rng.uniform(points.min(axis=0), points.max(axis=0), points.shape)
        flying, stray = which[::2], which[1::2]
        points[flying] -= depth[flying, None] * direction
        points[stray] = anywhere[stray]
        clouds.append(PointCloud(points))
    return replace(pair, source=clouds[0], target=clouds[1])


def with_rotation(pair: ScanPair, degrees: float, rng: np.random.Generator) -> ScanPair:
    """Put the source where it belongs, then turn it about its centroid and shift it.

    The axis is random; the shift is up to ``SHIFT`` extents along each axis.
    """
    axis = rng.standard_normal(3)
    axis /= np.linalg.norm(axis)
    in_place = rigid.apply(pair.gt_T_target_source, pair.source.points)
    centroid = in_place.mean(axis=0)
    turn = _rotation(axis, np.radians(degrees))
    shift = rng.uniform(-SHIFT, SHIFT, 3) * pair.extent
    motion = rigid.rigid(turn, centroid - turn @ centroid + shift)
    moved = motion @ pair.gt_T_target_source
    return replace(
        pair,
        source=PointCloud(rigid.apply(motion, in_place)),
        gt_T_target_source=rigid.invert(motion),
        source_viewpoint=None if pair.source_viewpoint is None else moved[:3, :3] @ pair.source_viewpoint,
        object_points=None if pair.object_points is None else rigid.apply(moved, pair.object_points),
    )


@dataclass(frozen=True)
class Parameter:
    """What a robustness curve is drawn over.

    Attributes:
        words: what its axis says.
        form: how a level is written.
        levels: from harmless to bad.
        disturb: called with a clean pair, a level and a generator.
    """

    words: str
    form: str
    levels: tuple[float, ...]
    disturb: Callable[[ScanPair, float, np.random.Generator], ScanPair]


PARAMETERS = {
    "noise": Parameter(
        "sigma of the range noise, share of the extent", "{:g}", (0.0, 0.005, 0.01, 0.02, 0.03), with_noise
    ),
    "density": Parameter(
        "points of the target to one of the source", "{:g} : 1", (1.0, 2.0, 5.0, 10.0), with_density
    ),
    "outliers": Parameter("share of outliers", "{:.0%}", (0.0, 0.05, 0.1, 0.2, 0.3), with_outliers),
    "rotation": Parameter("rotation, degrees", "{:g}", (0.0, 30.0, 60.0, 90.0, 135.0, 180.0), with_rotation),
}


@dataclass(frozen=True)
class CurveProtocol(RangeProtocol):
    """``noise``, ``density``, ``outliers``, ``rotation``: clean range scans, disturbed in one way.

    Overlap means that of the scans before they are disturbed.

    Attributes:
        name: a key of ``PARAMETERS``.
    """

    bands: tuple[Range, ...] = (BAND,)
    pairs: PairSettings = field(default_factory=lambda: CLEAN)
    name: str = "noise"

    def __post_init__(self) -> None:
        """Refuse unknown parameters.

        Raises:
            UsageError: there is no such curve.
        """
        if self.name not in PARAMETERS:
            raise UsageError(f"there is no curve {self.name!r}; choose {', '.join(PARAMETERS)}")

    @property
    def parameter(self) -> Parameter:
        """What the curve is drawn over."""
        return PARAMETERS[self.name]

    @property
    def groups(self) -> tuple[str, ...]:
        """The levels, as they are written."""
        return tuple(self.parameter.form.format(level) for level in self.parameter.levels)

    @property
    def cleans(self) -> bool:
        """Scattered points are left out before sampling: outliers are one of the curves."""
        return True

    def settings(self) -> dict[str, Any]:
        """Return the definition, JSON-ready."""
        return {
            **super().settings(),
            "levels": list(self.parameter.levels),
            "level_means": self.parameter.words,
        }

    def pair(self, library: ShapeLibrary, seed: int, number: int) -> ScanPair:
        """Make pair ``number`` of the test set ``seed``.

        Raises:
            DegeneratePair: the shapes have no such pair of views.
        """
        base, level = divmod(number, len(self.groups))
        clean = super().pair(library, seed, base)
        rng = np.random.default_rng([seed, base, 1])
        return self.parameter.disturb(clean, self.parameter.levels[level], rng)


@dataclass(frozen=True)
class SweepProtocol(CropProtocol):
    """``overlap-sweep``: PRNet's crops, keeping fewer and fewer of 1,024 points.

    Each cloud keeps the points nearest to a far viewpoint; the target's is drawn uniformly from the
    directions up to ``ASIDE`` degrees from opposite the source's. Otherwise as ``modelnet``. A pair's
    overlap is the share of a crop's points that the other crop has too; of independent samples it is
    measured between the clouds.
    """

    name: str = "overlap-sweep"
    keep: float = 1.0
    sampling: str = "shared"
    rotations: str = "euler45"

    @property
    def groups(self) -> tuple[str, ...]:
        """How many points are kept."""
        return tuple(f"{count} points" for count in KEPT)

    def settings(self) -> dict[str, Any]:
        """Return the definition, JSON-ready."""
        definition = super().settings()
        del definition["keep"]
        return {
            **definition,
            "levels": list(KEPT),
            "level_means": f"points kept of {POINTS}",
            "viewpoints_from_opposite_deg": ASIDE,
            "quoted_overlaps": list(QUOTED_OVERLAPS),
        }

    def pair(self, library: ShapeLibrary, seed: int, number: int) -> ScanPair:
        """Make pair ``number`` of the test set ``seed``.

        Raises:
            DegeneratePair: no shape of many tried can be used.
        """
        base, level = divmod(number, len(KEPT))
        rng = np.random.default_rng([seed, base, 1])
        return cropped(super().pair(library, seed, base), KEPT[level], rng)

    def group(self, number: int) -> str:
        """Name the group of a pair."""
        return self.groups[number % len(KEPT)]


def cropped(pair: ScanPair, count: int, rng: np.random.Generator) -> ScanPair:
    """Keep the ``count`` points of both clouds nearest to far viewpoints, about on opposite sides.

    Args:
        pair: two whole clouds of an object of radius about 1.
        count: at most the points of either.
        rng: draws the viewpoints; the same state gives the same ones for any count.
    """
    first, across = rng.standard_normal((2, 3))
    first /= np.linalg.norm(first)
    across -= (across @ first) * first
    along = rng.uniform(np.cos(np.radians(ASIDE)), 1.0)  # uniform over the cap
    views = np.stack([first, np.sqrt(1.0 - along**2) * across / np.linalg.norm(across) - along * first])
    back = rigid.invert(pair.gt_T_target_source)  # viewpoints are drawn in the target's frame
    kept = [
        nearest_crop(pair.source.points, rigid.apply(back, FAR * views[:1])[0], count),
        nearest_crop(pair.target.points, FAR * views[1], count),
    ]
    source, target = pair.source.points[kept[0]], pair.target.points[kept[1]]
    if pair.shared is None:
        in_place = rigid.apply(pair.gt_T_target_source, source)
        overlap, shared = measure_overlap(in_place, target, pair.extent, rng), None
    else:
        both = np.isin(pair.shared[:, 0], kept[0]) & np.isin(pair.shared[:, 1], kept[1])
        shared = np.stack([np.searchsorted(kept[side], pair.shared[both, side]) for side in (0, 1)], axis=1)
        overlap = dict.fromkeys(("source", "target"), len(shared) / count)
    return replace(
        pair, source=PointCloud(source), target=PointCloud(target), overlap_ratio=overlap, shared=shared
    )


def _sides(pair: ScanPair) -> list[tuple[PointCloud, np.ndarray]]:
    """Both scans with the direction towards their scanner."""
    sides = []
    for cloud, direction in (
        (pair.source, pair.source_viewpoint),
        (pair.target, pair.target_viewpoint),
    ):
        if direction is None:
            raise ValueError("the scan was not seen from one side")
        sides.append((cloud, direction))
    return sides


def _rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """Return the (3, 3) rotation about a unit axis, right-handed."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
